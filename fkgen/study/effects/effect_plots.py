"""Draw the effect of a fault: error per state in its one-sigma band, and what the NIS sees."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fkgen.spec import Spec
from fkgen.study.effects.effect import FaultEffect
from fkgen.study.plots import axis_label

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
