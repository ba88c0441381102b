"""Two filters from spec to compiled C, for a simulated motor and a real drive: ``fkgen demo``."""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from timeit import repeat

import numpy as np

from fkgen import pipeline
from fkgen.backend.render import cost
from fkgen.errors import OutputError
from fkgen.oracle.plants.actuator import LinearSystem, simulate
from fkgen.problem import Spec, load
from fkgen.runtime.compiler import find_compiler
from fkgen.runtime.results import Run
from fkgen.study.records.filtering import Selection, run_table
from fkgen.study.records.record import Table
from fkgen.study.records.table import read_table
from fkgen.study.reports.plots import draw, save
from fkgen.study.reports.starters import resource

_MOTOR = "1. A motor whose input fails at a rate nobody knows (mme, a bank of five filters)"
_CAR = "2. The speed of a car, a real drive, with half of the wheel samples missing (kf)"
_RATE, _SAMPLES = 0.7, 500
_QUICK = Selection((), ("filtered_state",))


def play(folder: Path) -> Iterator[str]:
    """Write generated C and pictures into a folder; yield what was done, line by line."""
    find_compiler()  # the one thing that may be missing: say so at once
    if folder.exists() and not folder.is_dir():
        raise OutputError(str(folder), given="a file", expected="a folder, or nothing yet")
    yield f"Two filters from spec file to compiled C and pictures in {folder}; about five seconds"
    for title, file, record, verdict in (
        (_MOTOR, "examples/dc_motor/unknown_rate.toml", _motor_record, _motor_rate),
        (_CAR, "examples/car_speed/spec.toml", _drive, _speed_error),
    ):
        yield ""
        yield title
        spec = load(resource(file))
        start = time.perf_counter()
        design = pipeline.validate(spec)
        yield f"   proved ({time.perf_counter() - start:.1f} s): {len(design.claims)} claims"
        for claim in design.claims:
            yield f"     {claim.claim} (off by {claim.error:.0e}, allowed {claim.tolerance:.0e})"
        source = pipeline.generate(design)
        target = source.write(folder / spec.name)
        step = cost(source.program)
        yield f"   generated: {len(source.files)} files in {target}; one step: {step}"
        start = time.perf_counter()
        built = pipeline.compile(source)
        yield f"   compiled ({time.perf_counter() - start:.1f} s)"
        table = record(spec)
        run = run_table(built, table, Selection((), built.ports))
        seconds = min(repeat(partial(run_table, built, table, _QUICK), number=1, repeat=5))
        samples = len(table.time)
        yield f"   filtered: {samples} samples, {1e9 * seconds / samples:.0f} ns each"
        picture = folder / f"{spec.name}.png"
        save(draw(spec, table, run), picture, force=True)
        yield f"   drawn: {picture}"
        yield verdict(spec, table, run)
    yield ""
    yield f"C code and pictures are in {folder}; next: fkgen new mkf -o motor.toml"


def _motor_record(spec: Spec) -> Table:
    """The motor at 1 V, with a tenth of the measurements missing."""
    system = LinearSystem.from_spec(spec, _SAMPLES, None, (_RATE,))
    u, k = np.ones((_SAMPLES, spec.model.nu)), np.arange(_SAMPLES)
    y = simulate(system, u, np.random.default_rng(7), missing=0.1)
    return Table(file="simulation", time=k.astype(float), y=y, u=u)


def _motor_rate(spec: Spec, table: Table, run: Run) -> str:
    last = run["mode_probability"][-1]
    best = int(np.argmax(last))
    return (
        f"   simulated with success rate {_RATE:g}; after {len(table.y)} samples the filter gives "
        f"{spec.filter.options.hypotheses[best][0]:g} the probability {last[best]:.3f}"
    )


def _drive(spec: Spec) -> Table:
    return read_table(resource("examples/car_speed/record.csv"), spec)


def _speed_error(spec: Spec, table: Table, run: Run) -> str:  # noqa: ARG001 - as for the motor
    """Filtered less reference speed, at the instants at which there is one."""
    reference = resource("examples/car_speed/reference.csv")
    times, speed = np.loadtxt(reference, delimiter=",", skiprows=1).T
    covered = table.time <= times[-1]
    error = run["filtered_state"][covered, 0] - np.interp(table.time[covered], times, speed)
    rms, count = float(np.sqrt(np.mean(error**2))), int(covered.sum())
    return f"   rms error {rms:.4f} m/s against the reference, over {count} instants"
