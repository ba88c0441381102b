"""What the commands ``fkgen simulate`` and ``fkgen compare`` do."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import DataError
from fkgen.problem import Signal, Spec
from fkgen.study.comparisons.comparison import compare
from fkgen.study.comparisons.ranking import Comparison
from fkgen.study.records.files import refuse_targets
from fkgen.study.records.filtering import csv_text
from fkgen.study.records.table import constants_or_record, profile_of
from fkgen.trials.simulation import Simulation, simulate

Array = NDArray[Any]
STEPS = 200


def drawn(spec: Spec, *, trial: int, **options: Any) -> str:
    """One trial as a CSV text: what a filter is told, then the truth.

    Columns are the measurements, inputs and parameters by name, then ``true.<state>`` and the fault
    indicators: ``gamma`` and ``delta`` of sensors, ``gamma.<input>`` of actuators.
    """
    columns = _columns(spec, simulate(spec, 1, first=trial, **_circumstances(spec, **options)))
    texts = [["" if math.isnan(v) else v for v in values.tolist()] for values in columns.values()]
    return csv_text(list(columns), texts)


def compared(
    specs: tuple[Spec, ...], *, families: str, plot: Path | None, force: bool, **options: Any
) -> Comparison:
    """Compare, and draw the figure if one is asked for; progress is shown on a terminal."""
    refuse_targets(None, plot, force=force)
    given = _circumstances(specs[0], **options)
    names = tuple(name.strip() for name in families.split(",") if name.strip())
    found = compare(specs, names or None, progress=sys.stderr.isatty(), **given)
    if plot is not None:
        from fkgen.study.comparisons.report import draw_comparison  # noqa: PLC0415 - slow to import
        from fkgen.study.reports.plots import save  # noqa: PLC0415

        save(draw_comparison(found), plot, force=force)
    return found


def _circumstances(
    spec: Spec,
    *,
    steps: int | None,
    record: Path | None,
    inputs: str,
    profile: Path | None,
    **sizes: Any,
) -> dict[str, Any]:
    """Number of samples, inputs, parameters, missing rows and soft faults, beside other sizes."""
    signals: dict[str, Any] = {}
    lengths: dict[int, Path] = {}
    if profile is not None:
        signals["sensor"], signals["input"] = profile_of(spec, profile)
        lengths[len(signals["sensor"])] = profile
    constants, table = constants_or_record(spec, inputs, record)
    params = {} if table is None else table.params
    if table is not None and record is not None:
        lengths[len(table.lines)] = record
        signals |= {"present": np.isfinite(table.y), "u": table.u if spec.model.nu else None}
    elif spec.model.nu and constants is None:
        names = ", ".join(signal.name for signal in spec.model.inputs)
        raise DataError("--u", given="nothing", expected=f"numbers for {names}, or a --record")
    most = min(lengths, default=STEPS)
    wanted = most if steps is None else steps
    if lengths and wanted > most:
        expected = f"at most {most}: {lengths[most]} has no more samples"
        raise DataError("--steps", given=str(wanted), expected=expected)
    first = {name: None if each is None else each[:wanted] for name, each in signals.items()}
    over = {name: values[:wanted] for name, values in params.items()}
    return {"u": constants, "params": over, "steps": wanted, **first, **sizes}


def _columns(spec: Spec, found: Simulation) -> dict[str, Array]:
    def named(signals: Sequence[Signal], values: Array, prefix: str = "") -> dict[str, Array]:
        return {f"{prefix}{signal.name}": values[:, i] for i, signal in enumerate(signals)}

    model, y = spec.model, found.y[0]
    columns = named(model.outputs, y) | named(model.inputs, found.u)
    columns |= {name: np.broadcast_to(each, len(y)) for name, each in found.params.items()}
    columns |= named(model.states, found.state[0], "true.")
    if found.gamma is not None and found.delta is not None:
        columns |= {"gamma": found.gamma[0], "delta": found.delta[0]}
    elif found.gamma is not None:
        columns |= named(model.inputs, found.gamma[0], "gamma.")
    elif found.mode is not None:
        columns["mode"] = found.mode[0]
    if found.arrival is not None:
        columns["arrival"] = found.arrival[0].astype(float)
    return columns
