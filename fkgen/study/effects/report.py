"""Draw the effect of a fault: error per state in its one-sigma band, and what the NIS sees.

Tables, JSON and a picture of the effect of a fault: what ``fkgen fault-effect`` does.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fkgen.errors import DataError
from fkgen.problem import Signal, Spec
from fkgen.runtime.record import choice
from fkgen.study.effects.effect import FaultEffect
from fkgen.study.effects.fault_effect import fault_effect
from fkgen.study.effects.profiles import drift, from_csv, pulse, ramp, step
from fkgen.study.records.files import refuse_existing, refuse_format, write_whole
from fkgen.study.records.table import read_columns, read_table
from fkgen.study.reports.jsonable import finite_or_none
from fkgen.study.reports.plots import axis_label

_BLUE, _ORANGE, _GREY, _BAND = "#1f5a94", "#d9741a", "#6b6b6b", 0.18
_WIDTH, _HEIGHT = 9.0, 1.9
_LARGEST = 12  # panels of states


def draw(spec: Spec, effect: FaultEffect, *, fraction: float, false_alarm: float) -> Figure:
    """One panel per state, then the power of the NIS test (or the change of the NIS).

    Parameters
    ----------
    spec : Spec
        Names and units.
    effect : FaultEffect
    fraction : float
        Share of the peak at which the effect counts as over.
    false_alarm : float
        Of the NIS test.
    """
    states = spec.model.states[:_LARGEST]
    panels = len(states) + 1
    figure = Figure(figsize=(_WIDTH, _HEIGHT * panels), layout="constrained")
    axes = figure.subplots(panels, 1, sharex=True)
    over = effect.settled(fraction)
    for i, signal in enumerate(states):
        _draw_state(axes[i], effect, i, int(over[i]))
        axes[i].set_ylabel(axis_label(signal), fontsize=9)
    how = {"paired": f"mean of {effect.runs} pairs", "mean": "mean over lost commands"}
    text = f"{spec.name}: {spec.filter.family}, error that the fault makes"
    axes[0].set_title(f"{text}, {how.get(effect.kind, effect.kind)}", loc="left", fontsize=10)
    axes[0].legend(frameon=False, ncols=3, fontsize=8, loc="upper right")
    _draw_visibility(axes[-1], effect, false_alarm)
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
        axis.margins(x=0.0)
        axis.tick_params(labelsize=8)
    axes[-1].set_xlabel("sample", fontsize=9)
    figure.align_ylabels(axes)
    return figure


def _draw_state(axis: Axes, effect: FaultEffect, i: int, over: int) -> None:
    error, sd = effect.error_deviation[:, i], effect.state_sd[:, i]
    time = np.arange(len(error))
    axis.fill_between(time, -sd, sd, color=_BLUE, alpha=_BAND, lw=0, label=r"$\pm\sigma$ of x(k|k)")
    spread = 2.0 * effect.standard_error[:, i]
    if spread.any():
        axis.fill_between(time, error - spread, error + spread, color=_ORANGE, alpha=0.3, lw=0)
    axis.plot(time, error, color=_BLUE, lw=1.4, label="error by the fault")
    axis.axhline(0.0, color="black", lw=0.6)
    if 0 < over < len(error):
        axis.axvline(over, color=_ORANGE, lw=1.0, ls="--", label="over")
        axis.annotate(
            f"{over}",
            (over, 0.04),
            xycoords=("data", "axes fraction"),
            xytext=(3, 0),
            textcoords="offset points",
            fontsize=8,
            color=_ORANGE,
        )
    reach = 1.15 * max(float(np.abs(error).max()), min(float(np.median(sd)), 1e3)) or 1.0
    axis.set_ylim(-reach, reach)


def _draw_visibility(axis: Axes, effect: FaultEffect, false_alarm: float) -> None:
    time = np.arange(len(effect.noncentrality))
    if not effect.gaussian:
        axis.plot(time, effect.noncentrality, color=_BLUE, lw=1.4)
        axis.axhline(0.0, color="black", lw=0.6)
        axis.set_ylabel("change of NIS", fontsize=9)
        return
    axis.plot(time, effect.power(false_alarm), color=_BLUE, lw=1.4)
    axis.axhline(false_alarm, color=_GREY, lw=0.8, ls=":")
    axis.set_ylim(-0.03, 1.03)
    axis.set_ylabel("power of NIS", fontsize=9)
    text = f"probability that the NIS of the sample exceeds its bound; false alarms {false_alarm:g}"
    axis.set_title(text, loc="left", fontsize=8, color=_GREY)


Array = NDArray[np.float64]

_SHAPES = ("pulse", "step", "ramp", "drift")

_KINDS = {
    "exact": "exact: the same in every run, whatever the noise is",
    "mean": "the mean over lost commands, which decide how much of the fault arrives",
    "paired": "the mean of {runs} simulated pairs of runs, with and without the fault, same noise",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Wish:
    """The options of the command, under their names; see its help."""

    sensor: str | None = None
    driven: str | None = None
    shape: str = "step"
    amplitude: float = 1.0
    start: int = 0
    stop: int | None = None
    length: int = 10
    steps: int = 100
    profile: Path | None = None
    record: Path | None = None
    inputs: str = ""
    mode: str = "both"
    fraction: float = 0.01
    false_alarm: float = 1e-3
    runs: int = 256


@dataclass(frozen=True, eq=False)
class Answer:
    """The effect, and how to tell it."""

    spec: Spec
    wish: Wish
    effect: FaultEffect
    notes: tuple[str, ...]

    def table(self) -> tuple[Sequence[str], list[Sequence[str]]]:
        """One row per state: peak of the error, where, in standard deviations, and its end."""
        head = ("state", "unit", "largest error", "at sample", "in sd", "at the end", "over at")
        effect = self.effect
        rows: list[Sequence[str]] = []
        over = effect.settled(self.wish.fraction)
        size = np.abs(effect.error_deviation)
        for i, signal in enumerate(self.spec.model.states):
            k = int(np.argmax(size[:, i]))
            sd = effect.state_sd[k, i]
            share = f"{size[k, i] / sd:.3g}" if sd > 0.0 else "-"
            last = f"{effect.error_deviation[-1, i]:.4g}"
            end = str(over[i]) if over[i] < len(size) else "later"
            peak = f"{effect.error_deviation[k, i]:.4g}"
            rows.append((signal.name, signal.unit, peak, str(k), share, last, end))
        return head, rows

    def sentences(self) -> list[str]:
        """What the table does not say."""
        effect, wish = self.effect, self.wish
        lines = [
            "The error is that of the state less its estimate; it is over at the first sample from",
            f"which on it stays below {wish.fraction:g} of its peak.",
            f"These numbers are {_KINDS[effect.kind].format(runs=effect.runs)}.",
        ]
        if effect.state_deviation.any() and not effect.error_deviation.any():
            names = [signal.name for signal in self.spec.model.states]
            moved = np.abs(effect.state_deviation).max(axis=0)
            sizes = ", ".join(f"{n} {size:.4g}" for n, size in zip(names, moved, strict=True))
            lines.append(
                f"The estimate moves as the state does, by up to {sizes}: no test sees it."
            )
            return lines
        if not effect.gaussian:
            k = int(np.argmax(effect.noncentrality))
            lines.append(f"The NIS changes most at sample {k}: {effect.noncentrality[k]:+.3g}.")
            return lines
        power = effect.power(wish.false_alarm)
        k = int(np.argmax(power))
        shown = int(np.count_nonzero(power > 0.5))
        lines.append(
            f"The NIS finds it at sample {k} with probability {power[k]:.3g}, and at {shown} of "
            f"{len(power)} samples with more than one half (false alarms {wish.false_alarm:g})."
        )
        return lines

    def to_json(self) -> str:
        """All samples; what is not finite becomes null."""
        effect = self.effect
        arrays = {
            name: finite_or_none(getattr(effect, name))
            for name in (
                *("state_deviation", "error_deviation", "innovation_deviation"),
                *("noncentrality", "state_sd", "standard_error"),
            )
        }
        over = effect.settled(self.wish.fraction)
        length = len(effect.noncentrality)
        facts = {
            "name": self.spec.name,
            "family": self.spec.filter.family,
            "kind": effect.kind,
            "runs": effect.runs,
            "states": [signal.name for signal in self.spec.model.states],
            "outputs": [signal.name for signal in self.spec.model.outputs],
            "fraction": self.wish.fraction,
            "settled": [int(k) if k < length else None for k in over],
            "power": effect.power(self.wish.false_alarm).tolist() if effect.gaussian else None,
        }
        return json.dumps(facts | arrays)


def answer(spec: Spec, wish: Wish, *, plot: Path | None = None, force: bool = False) -> Answer:
    """Ask, and draw if a picture is wanted.

    Raises
    ------
    DataError, OutputError
        If a name, a profile or a file does not fit; nothing is written then.
    """
    if plot is not None:
        refuse_format(plot)
        refuse_existing(plot, force=force, hint=", or --force to replace it")
    notes: list[str] = []
    u, y, params, steps = _record(spec, wish, notes)
    sensor, anomaly = _faults(spec, wish, steps)
    effect = fault_effect(spec, sensor, anomaly, wish.mode, params=params, u=u, y=y, runs=wish.runs)
    effect.settled(wish.fraction)  # refuses a share that is none, before anything is written
    if plot is not None:
        from fkgen.study.effects.report import draw  # noqa: PLC0415 - slow to import
        from fkgen.study.reports.plots import rendered  # noqa: PLC0415 - slow to import

        figure = draw(spec, effect, fraction=wish.fraction, false_alarm=wish.false_alarm)
        write_whole(plot, rendered(figure, plot), force=force)
        notes.append(f"{plot}: written")
    return Answer(spec, wish, effect, tuple(notes))


def numbers_of(option: str, text: str, count: int) -> Array | None:
    """Numbers separated by commas, one per signal; None if the option was left out.

    Raises
    ------
    DataError
    """
    if not text.strip():
        return None
    try:
        values = np.array([float(part) for part in text.split(",")])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        expected = f"{count} finite numbers, separated by commas"
        raise DataError(option, given=repr(text), expected=expected)
    return values


def _record(
    spec: Spec, wish: Wish, notes: list[str]
) -> tuple[Array | None, Array | None, dict[str, Array] | None, int]:
    """Inputs, measurements, parameters and length of the record on which the fault falls."""
    constant = numbers_of("--u", wish.inputs, spec.model.nu)
    if wish.record is not None:
        if constant is not None:
            raise DataError("--u", given="inputs beside --record", expected="one of the two")
        table = read_table(wish.record, spec)
        notes += table.notes
        return table.u, table.y, table.params, len(table.lines)
    steps = wish.steps
    if wish.profile is not None:
        names = [s.name for s in (*spec.model.outputs, *spec.model.inputs)]
        steps = len(next(iter(read_columns(wish.profile, names).values())))
    return None if constant is None else np.tile(constant, (steps, 1)), None, None, steps


def _faults(spec: Spec, wish: Wish, steps: int) -> tuple[Array | None, Array | None]:
    """What is added to y and to u."""
    outputs, inputs = spec.model.outputs, spec.model.inputs
    if wish.profile is not None:
        if wish.sensor or wish.driven:
            expected = "the names of the columns of the file only"
            raise DataError(
                "--profile", given="a file beside --sensor or --input", expected=expected
            )
        names = [signal.name for signal in (*outputs, *inputs)]
        both = from_csv(wish.profile, names)
        return both[:, : len(outputs)], both[:, len(outputs) :] if inputs else None
    if not wish.sensor and not wish.driven:
        shown = ", ".join(signal.name for signal in outputs)
        expected = f"--sensor NAME ({shown}), --input NAME, or --profile FILE"
        raise DataError("the fault", given="nothing", expected=expected)
    return (
        _profile(wish, steps, _row("--sensor", wish.sensor, outputs)),
        _profile(wish, steps, _row("--input", wish.driven, inputs)),
    )


def _row(option: str, name: str | None, signals: Sequence[Signal]) -> Array | None:
    """A unit vector for the signal of this name."""
    if not name:
        return None
    names = [signal.name for signal in signals]
    if name not in names:
        raise DataError(option, given=repr(name), expected=choice(name, names))
    return np.asarray(np.eye(len(names))[names.index(name)])


def _profile(wish: Wish, steps: int, row: Array | None) -> Array | None:
    if row is None:
        return None
    size = wish.amplitude * row
    match wish.shape:
        case "pulse":
            return pulse(steps, wish.start, size)
        case "step":
            return step(steps, wish.start, size, stop=wish.stop)
        case "ramp":
            return ramp(steps, wish.start, size, length=wish.length, stop=wish.stop)
        case "drift":
            return drift(steps, wish.start, size, stop=wish.stop)
    raise DataError("--shape", given=repr(wish.shape), expected=choice(wish.shape, _SHAPES))
