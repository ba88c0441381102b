"""Small extended filters: operations, steps, time to generate, flash and stack, beside goals."""

from __future__ import annotations

import itertools
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from harness import clock, models
from harness.report import Table, times, verdict
from harness.settings import Settings
from rivals import contenders

import fkgen
from fkgen.proof import agreement
from fkgen.target.boards import board
from fkgen.target.toolchain import toolchain
from fkgen.target.verify import STEPS, on_host, tried

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "models"))

import extended as cases

_SAMPLES = 4000
#: Inputs of the drawn record: the unicycle drives in a circle, the body turns, the cell discharges.
_INPUTS = {"robot": (1.0, 0.2), "attitude": (0.1, -0.2, 0.3), "battery": (0.5,)}
_BY_HAND = 1.10  # Operations beside those of a form arranged by hand
_SECONDS = 5.0  # To generate one
#: The measure of steps: dense, in straight lines, in the form of the update that "auto" takes.
_DENSE = {"form": "straight", "update": "short"}
_SMALL: dict[str, Any] = {"scalar": "float", "optimise": "size"}


@dataclass(frozen=True)
class _Goal:
    """What one filter may take."""

    title: str
    step: float  # Times the step of the dense kf
    flash: int  # Bytes
    stack: int


_GOALS = {
    "robot": _Goal("unicycle, range and bearing: n3 p2", 0.28, 2000, 200),
    "attitude": _Goal("attitude and gyro bias: n6 p6", 4.2, 12000, 900),
    "battery": _Goal("battery: n3 p1", 0.56, 3000, 250),
}


def steps(settings: Settings) -> Table:
    """Operations and times, in double."""
    table = Table(
        "Extended filters: operations and steps",
        [
            *("filter", "operations", "by hand", "ratio", "limit"),
            *("step / dense kf", "most of it", "joseph", "generate, s", "most s"),
        ],
        "Double, gcc -O3. Operations of a step with every row present, beside a form arranged by "
        "hand (tests/models/hand_forms.py). Steps beside that of kf n6 p3 dense in straight lines "
        "in the update that `auto` chooses (short), and in Joseph's; measurements are drawn from "
        "the model. Generating: spec to C text with every proof.",
    )
    for name, goal in _GOALS.items():
        spec = replace(cases.spec_of(name), name=name)
        start = time.perf_counter()
        source = fkgen.generate(fkgen.validate(spec))
        seconds = time.perf_counter() - start
        by_hand = cases.arranged(name)[1]
        ratio = source.program.flops / by_hand
        short, joseph = _beside_dense(spec, settings)
        table.add(
            *(goal.title, source.program.flops, by_hand, times(ratio)),
            f"{_BY_HAND} ({verdict(ratio, _BY_HAND)})",
            *(times(short), f"{goal.step} ({verdict(short, goal.step)})", times(joseph)),
            *(f"{seconds:.2f}", f"{_SECONDS} ({verdict(seconds, _SECONDS)})"),
        )
    return table


def _beside_dense(spec: fkgen.Spec, settings: Settings) -> tuple[float, float]:
    """A step beside that of the dense filter with the short update, and with Joseph's."""
    dense = models.dense(6, 3)
    joseph = {**models.with_code(dense, **{**_DENSE, "update": "joseph"}), "name": "joseph6"}
    y, u = models.record(dense, _SAMPLES)
    record = fkgen.simulate(spec, 1, _SAMPLES, seed=1, u=_INPUTS[spec.name])
    rivals: dict[str, tuple[Any, models.Array, models.Array]] = {
        "short": (contenders.of_fkgen(models.with_code(dense, **_DENSE), settings.folder), y, u),
        "joseph": (contenders.of_fkgen(joseph, settings.folder), y, u),
        spec.name: (contenders.of_spec(spec, settings.folder), record.y[0], record.u[0]),
    }
    calls = {}
    for name, (contender, *given) in rivals.items():
        run = contenders.library(contender, settings.folder / f"extended-{name}", level="-O3")
        arrays = [np.ascontiguousarray(each) for each in given]
        calls[name] = lambda run=run, arrays=arrays: run(*arrays)
    taken = clock.take_turns(calls, settings.rounds, settings.seconds)
    return taken.ratio(spec.name, "short"), taken.ratio(spec.name, "joseph")


def sizes(settings: Settings) -> Table:
    """Flash and stack on a Cortex-M4F in float at -Os, for each form of the update."""
    del settings
    table = Table(
        "Extended filters on a Cortex-M4F",
        ["filter", "update, form", "flash B", "most of it", "stack B", "most of that"],
        'Float, arm-none-eabi-gcc -Os (`code.optimise = "size"`). Flash: init and step with all '
        "that they call, memcpy of the C library too, and constants. Stack: as used by the "
        f"emulated processor in {STEPS} steps. `auto` takes factors (ud) in float.",
    )
    where = board("cortex-m4f")
    for name, goal in _GOALS.items():
        for update, form in itertools.product(("short", "joseph", "ud"), ("straight", "auto")):
            spec = cases.spec_of(name)
            code = replace(spec.code, **_SMALL, update=update, form=form)
            spec = replace(spec, code=code)
            source, record = fkgen.generate(fkgen.validate(spec)), agreement.trial(spec, STEPS)
            _, found = tried(where, toolchain(where), source, record, on_host(source, record))
            table.add(
                *(goal.title, f"{update}, {form}", found.flash),
                f"{goal.flash} ({verdict(found.flash, goal.flash)})",
                *(found.stack, f"{goal.stack} ({verdict(found.stack, goal.stack)})"),
            )
    return table
