"""What the commands ``fkgen simulate`` and ``fkgen compare`` do."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import DataError
from fkgen.problem import Spec
from fkgen.study.comparisons.comparison import compare
from fkgen.study.comparisons.ranking import Comparison
from fkgen.study.records.files import refuse_targets
from fkgen.study.records.filtering import csv_text
from fkgen.study.records.table import constants_or_record, profile_of
from fkgen.trials.simulation import Simulation, simulate

STEPS = 200


def drawn(spec: Spec, *, seed: int, trial: int, **circumstances: Any) -> str:
    """One trial as a CSV text: what a filter is told, then the truth.

    Columns are the measurements, inputs and parameters by name, then ``true.<state>`` and the fault
    indicators: ``gamma`` and ``delta`` of sensors, ``gamma.<input>`` of actuators.
    """
    steps, given = _circumstances(spec, **circumstances)
    columns = _columns(spec, simulate(spec, 1, steps, seed, first=trial, **given))
    texts = [["" if math.isnan(v) else v for v in values.tolist()] for values in columns.values()]
    return csv_text(list(columns), texts)


def compared(
    specs: tuple[Spec, ...],
    *,
    families: str,
    plot: Path | None,
    force: bool,
    steps: int | None,
    record: Path | None,
    inputs: str,
    profile: Path | None,
    **sizes: Any,
) -> Comparison:
    """Compare, and draw the figure if one is asked for; progress is shown on a terminal."""
    refuse_targets(None, plot, force=force)
    samples, given = _circumstances(
        specs[0], steps=steps, record=record, inputs=inputs, profile=profile
    )
    names = tuple(name.strip() for name in families.split(",") if name.strip())
    shown = sys.stderr.isatty()
    found = compare(specs, names or None, steps=samples, progress=shown, **sizes, **given)
    if plot is not None:
        from fkgen.study.comparisons.report import draw_comparison  # noqa: PLC0415 - slow to import
        from fkgen.study.reports.plots import save  # noqa: PLC0415

        save(draw_comparison(found), plot, force=force)
    return found


def _circumstances(
    spec: Spec, *, steps: int | None, record: Path | None, inputs: str, profile: Path | None
) -> tuple[int, dict[str, Any]]:
    """Number of samples; inputs, parameters, missing rows and soft faults."""
    signals: dict[str, NDArray[Any] | None] = {}
    lengths: dict[int, Path] = {}
    params: dict[str, NDArray[Any]] = {}
    if profile is not None:
        sensor, signals["input"] = profile_of(spec, profile)
        signals["sensor"], lengths[len(sensor)] = sensor, profile
    constants, table = constants_or_record(spec, inputs, record)
    if table is not None and record is not None:
        lengths[len(table.lines)] = record
        signals |= {"present": np.isfinite(table.y), "u": table.u if spec.model.nu else None}
        params = table.params
    elif spec.model.nu and constants is None:
        names = ", ".join(signal.name for signal in spec.model.inputs)
        raise DataError("--u", given="nothing", expected=f"numbers for {names}, or a --record")
    most = min(lengths, default=STEPS)
    wanted = most if steps is None else steps
    if lengths and wanted > most:
        expected = f"at most {most}: {lengths[most]} has no more samples"
        raise DataError("--steps", given=str(wanted), expected=expected)
    given = {name: None if v is None else v[:wanted] for name, v in signals.items()}
    return wanted, {
        "u": constants,
        **given,
        "params": {name: values[:wanted] for name, values in params.items()},
    }


def _columns(spec: Spec, found: Simulation) -> dict[str, NDArray[np.floating[Any]]]:
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
    return columns
