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
from fkgen.problem import Spec
from fkgen.study.comparisons.comparison import compare
from fkgen.study.comparisons.ranking import Comparison
from fkgen.study.effects.report import numbers_of
from fkgen.study.records.files import refuse_existing, refuse_format, write_whole
from fkgen.study.records.table import read_columns, read_table
from fkgen.trials.simulation import Simulation, simulate

STEPS = 200


@dataclass(frozen=True, slots=True, kw_only=True)
class _Circumstances:
    """What both commands are told."""

    steps: int | None
    seed: int
    record: Path | None
    inputs: str
    profile: Path | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Draw(_Circumstances):
    """One trial, as the command line asks for it."""

    trial: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Wish(_Circumstances):
    """A comparison, as the command line asks for it."""

    families: str
    runs: int
    skip: int | None
    false_alarm: float


def drawn(spec: Spec, wish: Draw) -> str:
    """One trial as a CSV text: what a filter is told, then the truth.

    Columns are the measurements, inputs and parameters by name, then ``true.<state>`` and the fault
    indicators: ``gamma`` and ``delta`` of sensors, ``gamma.<input>`` of actuators.
    """
    steps, given = _circumstances(spec, wish)
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
    steps, given = _circumstances(specs[0], wish)
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
        from fkgen.study.comparisons.report import draw_comparison  # noqa: PLC0415 - slow to import
        from fkgen.study.reports.plots import rendered  # noqa: PLC0415

        write_whole(plot, rendered(draw_comparison(found), plot), force=force)
    return found


def _circumstances(spec: Spec, wish: _Circumstances) -> tuple[int, dict[str, Any]]:
    """Number of samples; inputs, parameters, missing rows and soft faults."""
    signals: dict[str, NDArray[Any]] = {**_faults(spec, wish.profile)}
    lengths = {len(values): wish.profile for values in signals.values()}
    constant, params = numbers_of("--u", wish.inputs, spec.model.nu), {}
    if wish.record is not None:
        if constant is not None:
            raise DataError("--u", given="inputs beside --record", expected="one of the two")
        table = read_table(wish.record, spec)
        lengths[len(table.lines)] = wish.record
        signals["present"], params = np.isfinite(table.y), table.params
        signals |= {"u": table.u} if spec.model.nu else {}
    elif spec.model.nu and constant is None:
        names = ", ".join(signal.name for signal in spec.model.inputs)
        raise DataError("--u", given="nothing", expected=f"numbers for {names}, or a --record")
    most = min(lengths, default=STEPS)
    steps = most if wish.steps is None else wish.steps
    if lengths and steps > most:
        expected = f"at most {most}: {lengths[most]} has no more samples"
        raise DataError("--steps", given=str(steps), expected=expected)
    given: dict[str, Any] = {name: values[:steps] for name, values in signals.items()}
    given["params"] = {name: values[:steps] for name, values in params.items()}
    return steps, {"u": constant} | given


def _faults(spec: Spec, path: Path | None) -> dict[str, NDArray[np.float64]]:
    """Soft faults of sensors and inputs from a file that names at least one of them."""
    if path is None:
        return {}
    names = [[s.name for s in signals] for signals in (spec.model.outputs, spec.model.inputs)]
    columns = read_columns(path, names[0] + names[1])
    parts = [[columns[name] for name in each] for each in names]
    sides = zip(("sensor", "input"), parts, strict=True)
    return {key: np.stack(part, axis=1) for key, part in sides if part}


def _columns(spec: Spec, found: Simulation) -> dict[str, list[float]]:
    model, steps = spec.model, len(found.y[0])
    columns: dict[str, NDArray[np.floating[Any]]] = {}
    for signals, values in ((model.outputs, found.y[0]), (model.inputs, found.u)):
        columns |= {signal.name: values[:, i] for i, signal in enumerate(signals)}
    columns |= {name: np.broadcast_to(v, (steps,)) for name, v in found.params.items()}
    columns |= {f"true.{s.name}": found.state[0, :, i] for i, s in enumerate(model.states)}
    if found.gamma is not None and found.delta is not None:
        columns |= {"gamma": found.gamma[0], "delta": found.delta[0]}
    elif found.mode is not None:
        columns["mode"] = found.mode[0]
    if found.arrival is not None:
        columns["arrival"] = found.arrival[0].astype(float)
    if found.gamma is not None and found.delta is None:
        columns |= {f"gamma.{s.name}": found.gamma[0, :, i] for i, s in enumerate(model.inputs)}
    return {name: values.tolist() for name, values in columns.items()}
