"""The effect of a fault as ``fkgen fault-effect`` tells it: table, sentences, JSON, picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fkgen.errors import DataError
from fkgen.problem import Signal, Spec
from fkgen.runtime.record import choice
from fkgen.study.effects.detectability import unit_vector
from fkgen.study.effects.effect import FaultEffect
from fkgen.study.effects.fault_effect import fault_effect
from fkgen.study.effects.profiles import drift, pulse, ramp, step
from fkgen.study.records.files import refuse_targets
from fkgen.study.records.reading import Reading
from fkgen.study.records.record import Table
from fkgen.study.records.table import Say, constants_or_record, profile_of
from fkgen.study.reports import plots
from fkgen.study.reports.jsonable import Answer
from fkgen.study.reports.plots import BAND, BLUE, GREY, ORANGE
from fkgen.trials.errors import error_signals

Array = NDArray[np.float64]

_KINDS = {
    "exact": "exact: the same in every run, whatever the noise is",
    "mean": "the mean over lost commands, which decide how much of the fault arrives",
    "paired": "the mean of {runs} simulated pairs of runs, with and without the fault, same noise",
}
_BY_SAMPLE = (
    *("state_deviation", "error_deviation", "innovation_deviation"),
    *("noncentrality", "state_sd", "standard_error"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """The options of the command, under their names; see its help."""

    sensor: str | None
    driven: str | None
    shape: str
    amplitude: float
    start: int
    stop: int | None
    length: int
    steps: int
    profile: Path | None
    record: Reading | None
    inputs: str
    mode: str
    fraction: float
    false_alarm: float
    runs: int


def report_of(spec: Spec, options: Options, *, plot: Path | None, force: bool, say: Say) -> Answer:
    """Find the effect, and draw if a picture is wanted; whatever does not fit is a `UserError`."""
    refuse_targets(None, plot, force=force)
    constants, table = constants_or_record(spec, options.inputs, options.record, say)
    u, y, params, notes = None, None, None, list[str]()
    if table is not None:
        u, y, params = table.u, table.y, table.params
    sensor, anomaly = _faults(spec, options, options.steps if y is None else len(y))
    if constants is not None:
        length = len(next(each for each in (sensor, anomaly) if each is not None))
        u = np.tile(constants, (length, 1))
    effect = fault_effect(
        spec, sensor, anomaly, options.mode, params=params, u=u, y=y, runs=options.runs
    )
    over = effect.settled(options.fraction)  # refuses a share that is none, before it draws
    if plot is not None:
        plots.save(draw(spec, effect, over, options.false_alarm, table), plot, force=force)
        notes.append(f"{plot}: written")
    head = ("state", "unit", "largest error", "at sample", "in sd", "at the end", "over at")
    errors = error_signals(spec.model.states)
    rows = [_row(each, effect, i, int(over[i])) for i, each in enumerate(errors)]
    sentences = (
        "The error is that of the state less its estimate; it is over at the first sample from",
        f"which on it stays below {options.fraction:g} of its peak.",
        f"These numbers are {_KINDS[effect.kind].format(runs=effect.runs)}.",
        _seen(spec, effect, options.false_alarm),
    )
    facts = {
        "name": spec.name,
        "family": spec.filter.family,
        "kind": effect.kind,
        "runs": effect.runs,
        "states": [signal.name for signal in errors],
        "outputs": [signal.name for signal in spec.model.outputs],
        "fraction": options.fraction,
        "settled": [int(k) if k < len(effect.degrees) else None for k in over],
        "power": effect.power(options.false_alarm) if effect.gaussian else None,
    } | {name: getattr(effect, name) for name in _BY_SAMPLE}
    return Answer(head, rows, sentences, facts, notes, indent=None)


def _row(state: Signal, effect: FaultEffect, i: int, over: int) -> Sequence[str]:
    error, sd = effect.error_deviation[:, i], effect.state_sd[:, i]
    k = int(np.argmax(np.abs(error)))
    share = f"{abs(error[k]) / sd[k]:.3g}" if sd[k] > 0.0 else "-"
    end = str(over) if over < len(error) else "later"
    return (state.name, state.unit, f"{error[k]:.4g}", str(k), share, f"{error[-1]:.4g}", end)


def _seen(spec: Spec, effect: FaultEffect, false_alarm: float) -> str:
    if effect.state_deviation.any() and not effect.error_deviation.any():
        largest = np.abs(effect.state_deviation).max(axis=0)
        moved = zip(error_signals(spec.model.states), largest, strict=True)
        sizes = ", ".join(f"{state.name} {size:.4g}" for state, size in moved)
        return f"The estimate moves as the state does, by up to {sizes}: no test sees it."
    if not effect.gaussian:
        k = int(np.argmax(effect.noncentrality))
        return f"The NIS changes most at sample {k}: {effect.noncentrality[k]:+.3g}."
    power = effect.power(false_alarm)
    k, shown = int(np.argmax(power)), int(np.count_nonzero(power > 0.5))
    return (
        f"The NIS finds it at sample {k} with probability {power[k]:.3g}, and at {shown} of "
        f"{len(power)} samples with more than one half (false alarms {false_alarm:g})."
    )


def _faults(spec: Spec, options: Options, steps: int) -> tuple[Array | None, Array | None]:
    """What is added to y and to u: a file, or one signal of each."""
    outputs, inputs = spec.model.outputs, spec.model.inputs
    if options.profile is not None:
        if options.sensor or options.driven:
            expected = "the names of the columns of the file only"
            given = "a file beside --sensor or --input"
            raise DataError("--profile", given=given, expected=expected)
        return profile_of(spec, options.profile)
    if not options.sensor and not options.driven:
        shown = ", ".join(signal.name for signal in outputs)
        expected = f"--sensor NAME ({shown}), --input NAME, or --profile FILE"
        raise DataError("the fault", given="nothing", expected=expected)
    return (
        _profile("--sensor", options.sensor, outputs, options, steps),
        _profile("--input", options.driven, inputs, options, steps),
    )


def _profile(
    which: str, name: str | None, signals: Sequence[Signal], options: Options, steps: int
) -> Array | None:
    if not name:
        return None
    size = options.amplitude * unit_vector(which, name, [signal.name for signal in signals])
    shapes: dict[str, Callable[..., Array]] = {
        "pulse": pulse,
        "step": partial(step, stop=options.stop),
        "ramp": partial(ramp, stop=options.stop, length=options.length),
        "drift": partial(drift, stop=options.stop),
    }
    if options.shape not in shapes:
        expected = choice(options.shape, list(shapes))
        raise DataError("--shape", given=repr(options.shape), expected=expected)
    return shapes[options.shape](steps, options.start, size)


@plots.styled
def draw(
    spec: Spec,
    effect: FaultEffect,
    over: NDArray[np.int64],
    false_alarm: float,
    table: Table | None = None,
) -> Figure:
    """One panel per state, then the power of the NIS test (or the change of the NIS).

    They run over the times of ``table``, the record, where it has some.
    """
    time, label = np.arange(float(len(effect.degrees))), "sample"
    if table is not None and table.time_name:
        time, label = table.time[: len(time)], table.time_label
    draws = [
        partial(_draw_state, spec=spec, effect=effect, time=time, i=i, over=int(over[i]))
        for i in range(len(error_signals(spec.model.states)[: plots.LARGEST]))
    ]
    draws.append(partial(_draw_visibility, effect=effect, time=time, false_alarm=false_alarm))
    return plots.panels([plots.HEIGHT] * len(draws), draws, label)


def _draw_state(
    axis: Axes, *, spec: Spec, effect: FaultEffect, time: Array, i: int, over: int
) -> None:
    """Error within one standard deviation of the estimate (and of the mean), and where it ends."""
    error, sd = effect.error_deviation[:, i], effect.state_sd[:, i]
    spread = 2.0 * effect.standard_error[:, i]
    axis.fill_between(time, -sd, sd, color=BLUE, alpha=BAND, lw=0, label=r"$\pm\sigma$ of x(k|k)")
    if spread.any():
        axis.fill_between(time, error - spread, error + spread, color=ORANGE, alpha=0.3, lw=0)
    axis.plot(time, error, color=BLUE, lw=1.4, label="error by the fault")
    axis.axhline(0.0, color="black", lw=0.6)
    if 0 < over < len(error):
        axis.axvline(time[over], color=ORANGE, lw=1.0, ls="--", label="over")
        where = ("data", "axes fraction"), "offset points"
        axis.annotate(
            f"{time[over]:.6g}", (time[over], 0.04), (3, 0), *where, fontsize=8, color=ORANGE
        )
    reach = 1.15 * max(float(np.abs(error).max()), min(float(np.median(sd)), 1e3)) or 1.0
    axis.set_ylim(-reach, reach)
    axis.set_ylabel(plots.label_of(error_signals(spec.model.states)[i]))
    if i == 0:
        how = {"paired": f"mean of {effect.runs} pairs", "mean": "mean over lost commands"}
        text = f"{spec.name}: {spec.filter.family}, error that the fault makes"
        axis.set_title(f"{text}, {how.get(effect.kind, effect.kind)}", fontsize=10)
        axis.legend(ncols=3, loc="upper right")


def _draw_visibility(axis: Axes, *, effect: FaultEffect, time: Array, false_alarm: float) -> None:
    seen = effect.power(false_alarm) if effect.gaussian else effect.noncentrality
    axis.plot(time, seen, color=BLUE, lw=1.4)
    if not effect.gaussian:
        axis.axhline(0.0, color="black", lw=0.6)
        axis.set_ylabel("change of NIS")
        return
    axis.axhline(false_alarm, color=GREY, lw=0.8, ls=":")
    axis.set_ylim(-0.03, 1.03)
    axis.set_ylabel("power of NIS")
    text = f"probability that the NIS of the sample exceeds its bound; false alarms {false_alarm:g}"
    axis.set_title(text, color=GREY)
