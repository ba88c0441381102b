"""What the commands ``fkgen simulate`` and ``fkgen compare`` do."""

from __future__ import annotations

import csv
import io
import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import DataError
from fkgen.spec import Spec
from fkgen.study.comparison import compare
from fkgen.study.files import refuse_existing, refuse_format, write_whole
from fkgen.study.simulation import Simulation, simulate
from fkgen.study.table import read_table
from fkgen.study.verdict import Comparison

STEPS = 200


@dataclass(frozen=True, slots=True, kw_only=True)
class Draw:
    """One trial, as the command line asks for it."""

    steps: int | None
    seed: int
    trial: int
    record: Path | None
    inputs: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Wish:
    """A comparison, as the command line asks for it."""

    families: str
    runs: int
    steps: int | None
    seed: int
    skip: int | None
    false_alarm: float
    record: Path | None
    inputs: str


def drawn(spec: Spec, wish: Draw) -> str:
    """One trial as a CSV text: what a filter is told, then the truth.

    Columns are the measurements, inputs and parameters by name, then ``true.<state>`` and the fault
    indicators: ``gamma`` and ``delta`` of sensors, ``gamma.<input>`` of actuators.
    """
    steps, given = _circumstances(spec, wish.steps, wish.record, wish.inputs)
    found = simulate(spec, 1, steps, wish.seed, first=wish.trial, **given)
    columns = _columns(spec, found)
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    for row in zip(*columns.values(), strict=True):
        writer.writerow("" if math.isnan(value) else value for value in row)
    return out.getvalue()


def compared(specs: tuple[Spec, ...], wish: Wish, *, plot: Path | None, force: bool) -> Comparison:
    """Compare, and draw the figure if one is asked for; progress is shown on a terminal."""
    if plot is not None:
        refuse_existing(plot, force=force, hint=", or --force to replace it")
        refuse_format(plot)
    steps, given = _circumstances(specs[0], wish.steps, wish.record, wish.inputs)
    families = tuple(name.strip() for name in wish.families.split(",") if name.strip())
    found = compare(
        specs,
        families or None,
        runs=wish.runs,
        steps=steps,
        seed=wish.seed,
        skip=wish.skip,
        false_alarm=wish.false_alarm,
        progress=sys.stderr.isatty(),
        **given,
    )
    if plot is not None:
        from fkgen.study.comparison_plot import draw_comparison  # noqa: PLC0415 - slow to import
        from fkgen.study.plots import rendered  # noqa: PLC0415

        write_whole(plot, rendered(draw_comparison(found), plot), force=force)
    return found


def _circumstances(
    spec: Spec, steps: int | None, record: Path | None, inputs: str
) -> tuple[int, dict[str, Any]]:
    """Number of samples, and inputs, parameters and missing rows."""
    u = _constants(inputs)
    if spec.model.nu and u is None and record is None:
        names = ", ".join(signal.name for signal in spec.model.inputs)
        raise DataError("--u", given="nothing", expected=f"numbers for {names}, or a --record")
    if record is None:
        return STEPS if steps is None else steps, {"u": u}
    if u is not None:
        raise DataError("--u", given="inputs beside a record", expected="one of the two")
    table = read_table(record, spec)
    length = len(table.lines) if steps is None else steps
    if not 0 < length <= len(table.lines):
        expected = f"1 to {len(table.lines)}: {record} has no more samples"
        raise DataError("--steps", given=str(length), expected=expected)
    return length, {
        "u": table.u[:length] if spec.model.nu else None,
        "params": {name: values[:length] for name, values in table.params.items()},
        "present": np.isfinite(table.y[:length]),
    }


def _constants(text: str) -> list[float] | None:
    if not text.strip():
        return None
    try:
        return [float(number) for number in text.split(",")]
    except ValueError:
        raise DataError("--u", given=repr(text), expected="numbers: 1.5,0,...") from None


def _columns(spec: Spec, found: Simulation) -> dict[str, list[float]]:
    model, steps = spec.model, len(found.y[0])
    columns: dict[str, NDArray[np.floating[Any]]] = {}
    for signals, values in ((model.outputs, found.y[0]), (model.inputs, found.u)):
        columns |= {signal.name: values[:, i] for i, signal in enumerate(signals)}
    columns |= {name: np.broadcast_to(v, (steps,)) for name, v in found.params.items()}
    columns |= {f"true.{s.name}": found.state[0, :, i] for i, s in enumerate(model.states)}
    if found.gamma is not None and found.delta is not None:
        columns |= {"gamma": found.gamma[0], "delta": found.delta[0]}
    elif found.gamma is not None:
        columns |= {f"gamma.{s.name}": found.gamma[0, :, i] for i, s in enumerate(model.inputs)}
    return {name: values.tolist() for name, values in columns.items()}
