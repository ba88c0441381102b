"""Two filters from spec to compiled C, for a simulated motor and a real drive: ``fkgen demo``."""

from __future__ import annotations

import time
from collections.abc import Generator, Iterator
from pathlib import Path

import numpy as np

from fkgen import pipeline
from fkgen.backend.render import cost
from fkgen.errors import OutputError
from fkgen.oracle.plants.actuator import LinearSystem, simulate
from fkgen.problem import Spec, load
from fkgen.runtime.compiled import CompiledFilter
from fkgen.runtime.compiler import find_compiler
from fkgen.runtime.results import Run
from fkgen.study.records.filtering import Selection, run_table
from fkgen.study.records.table import Table, read_table
from fkgen.study.reports.plots import draw, save
from fkgen.study.reports.starters import resource

_MOTOR, _CAR = "examples/dc_motor/unknown_rate.toml", "examples/car_speed/spec.toml"
_RATE, _SAMPLES, _REPEATS = 0.7, 500, 5


def play(folder: Path) -> Iterator[str]:
    """Write generated C and pictures into a folder; yield what was done, line by line."""
    find_compiler()  # the one thing that may be missing: say so at once
    if folder.exists() and not folder.is_dir():
        raise OutputError(str(folder), given="a file", expected="a folder, or nothing yet")
    yield f"Two filters from spec file to compiled C and pictures in {folder}; about five seconds"
    yield ""
    yield "1. A motor whose input fails at a rate nobody knows (mme, a bank of five filters)"
    spec = load(resource(_MOTOR))
    built = yield from _built(spec, folder)
    table = _motor_record(spec)
    run = yield from _filtered(spec, built, table, folder)
    rates = [rate[0] for rate in spec.filter.options.hypotheses]
    last = run["mode_probability"][-1]
    best = int(np.argmax(last))
    yield (
        f"   simulated with success rate {_RATE:g}; after {_SAMPLES} samples the filter gives "
        f"{rates[best]:g} the probability {last[best]:.3f}"
    )
    yield ""
    yield "2. The speed of a car, a real drive, with half of the wheel samples missing (kf)"
    spec = load(resource(_CAR))
    built = yield from _built(spec, folder)
    table = read_table(resource("examples/car_speed/record.csv"), spec)
    run = yield from _filtered(spec, built, table, folder)
    error, covered = _speed_error(table, run)
    yield f"   rms error {error:.4f} m/s against the reference, over {covered} instants"
    yield ""
    yield f"C code and pictures are in {folder}; next: fkgen new mkf -o motor.toml"


def _built(spec: Spec, folder: Path) -> Generator[str, None, CompiledFilter]:
    """Prove, generate, write, compile."""
    start = time.perf_counter()
    design = pipeline.validate(spec)
    yield f"   proved ({time.perf_counter() - start:.1f} s): {len(design.claims)} claims"
    for claim in design.claims:
        yield f"     {claim.claim} (off by {claim.error:.0e}, allowed {claim.tolerance:.0e})"
    source = pipeline.generate(design)
    target = source.write(folder / spec.name)
    yield f"   generated: {len(source.files)} files in {target}; one step: {cost(source.program)}"
    start = time.perf_counter()
    built = pipeline.compile(source)
    yield f"   compiled ({time.perf_counter() - start:.1f} s)"
    return built


def _filtered(
    spec: Spec, built: CompiledFilter, table: Table, folder: Path
) -> Generator[str, None, Run]:
    """Run a record, time it, draw it."""
    keep = ["filtered_state", "filtered_covariance", "innovation", "nis", "mode_probability"]
    selection = Selection((), tuple(name for name in keep if name in built.ports))
    run = run_table(built, table, selection)
    seconds = np.inf
    for _ in range(_REPEATS):
        start = time.perf_counter()
        run_table(built, table, Selection((), ("filtered_state",)))
        seconds = min(seconds, time.perf_counter() - start)
    samples = len(table.time)
    yield f"   filtered: {samples} samples, {1e9 * seconds / samples:.0f} ns each"
    picture = folder / f"{spec.name}.png"
    save(draw(spec, table, run), picture, force=True)
    yield f"   drawn: {picture}"
    return run


def _motor_record(spec: Spec) -> Table:
    """The motor at 1 V, with a tenth of the measurements missing."""
    system = LinearSystem.from_spec(spec, _SAMPLES, None, (_RATE,))
    u = np.ones((_SAMPLES, spec.model.nu))
    y = simulate(system, u, np.random.default_rng(7), missing=0.1)
    return Table(
        file="simulation",
        lines=tuple(range(_SAMPLES)),
        time_name="",
        time_text=(),
        time=np.arange(_SAMPLES, dtype=float),
        y=y,
        u=u,
        params={},
        notes=(),
    )


def _speed_error(table: Table, run: Run) -> tuple[float, int]:
    """Root mean square of filtered minus reference speed, and at how many instants there is one."""
    reference = resource("examples/car_speed/reference.csv")
    times, speed = np.loadtxt(reference, delimiter=",", skiprows=1).T
    covered = table.time <= times[-1]
    error = run["filtered_state"][covered, 0] - np.interp(table.time[covered], times, speed)
    return float(np.sqrt(np.mean(error**2))), int(covered.sum())
