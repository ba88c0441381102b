"""The figures of a report beside those of a run: errors, consistency, whiteness."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fkgen.problem import Signal, Spec
from fkgen.study.campaigns.results import Campaign
from fkgen.study.page.trials import Trials
from fkgen.study.reports.plots import BAND, BLUE, GREY, LARGEST, ORANGE, label_of, panels, styled
from fkgen.study.reports.whiteness import LAGS, Correlations
from fkgen.trials.errors import error_signals

Array = NDArray[np.floating]

_TAIL = 0.025
_HEIGHT, _LOW = 1.7, 1.4


@styled
def draw_errors(spec: Spec, time: tuple[Array, str], error: Array, sd: Array) -> Figure:
    """Errors (T, ne) within three of the deviations (T, ne) that the filter states."""

    def draw_one(axis: Axes, i: int, signal: Signal) -> None:
        band = 3.0 * sd[:, i]
        area = (time[0], -band, band)
        axis.fill_between(*area, color=BLUE, alpha=BAND, lw=0, label=r"$\pm 3\sigma$")
        axis.plot(time[0], error[:, i], ".", ms=2.5, color=BLUE, label="true less filtered")
        axis.axhline(0.0, color="black", lw=0.6)
        known = np.abs(error[np.isfinite(error[:, i]), i])
        reach = max(3.0 * float(np.nanmedian(band)), float(np.max(known, initial=0.0)))
        axis.set_ylim(-1.1 * reach or -1.0, 1.1 * reach or 1.0)
        axis.set_ylabel(label_of(signal))
        if i == 0:
            axis.legend(ncols=2, loc="lower right", bbox_to_anchor=(1.0, 0.98))

    return _by_state(spec, time[1], draw_one)


@styled
def draw_ensemble(spec: Spec, trials: Trials, time: tuple[Array, str]) -> Figure:
    """Root mean square of the errors of all trials, and what the filter says it is."""
    rms, claimed = trials.rms, trials.claimed

    def draw_one(axis: Axes, i: int, signal: Signal) -> None:
        axis.plot(time[0], rms[:, i], color=BLUE, lw=1.2, label="rms error over trials")
        axis.plot(
            time[0], claimed[:, i], color=ORANGE, lw=1.2, ls="--", label="stated by the filter"
        )
        settled = np.concatenate([rms[1:, i], claimed[1:, i]])
        top = float(np.max(settled[np.isfinite(settled)], initial=0.0))
        low = float(np.min(settled[settled > 0.0], initial=np.inf))
        if top > 20.0 * low:
            axis.set_yscale("log")
        else:
            axis.set_ylim(0.0, 1.15 * top or 1.0)
        axis.set_ylabel(label_of(signal))
        if i == 0:
            axis.legend(ncols=2, loc="lower right", bbox_to_anchor=(1.0, 0.98))

    return _by_state(spec, time[1], draw_one)


def _by_state(spec: Spec, label: str, draw_one: Callable[..., None]) -> Figure:
    signals = list(enumerate(error_signals(spec.model.states)))[:LARGEST]
    draws = [partial(draw_one, i=i, signal=signal) for i, signal in signals]
    return panels([_HEIGHT] * len(draws), draws, label)


@styled
def draw_consistency(found: Campaign, trials: Trials, time: tuple[Array, str]) -> Figure:
    """Normalised squares of the error over time, and every statistic that should be one."""
    figure = Figure(figsize=(9.0, 4.6), layout="constrained")
    above, below = figure.subplots(2, 1, height_ratios=(1.0, 1.1))
    _draw_nees(above, trials, *time)
    named = [("NEES", found.nees), ("NIS", found.nis)]
    values = [(name, float(each.value), float(each.standard_error)) for name, each in named]
    rows = zip(found.outputs, *found.sensor_nis, strict=True)
    values += [(f"NIS of {n.replace('_', ' ')}", float(v), float(e)) for n, v, e in rows]
    values = [each for each in values if np.isfinite(each[1])][: 2 + LARGEST]
    names, means, errors = zip(*values, strict=True) if values else ((), (), ())
    below.axvline(1.0, color="black", lw=0.8, ls=":")
    three = 3.0 * np.array(errors)
    below.errorbar(means, range(len(names)), xerr=three, fmt="o", ms=4, color=BLUE, capsize=2)
    below.set_yticks(range(len(names)), names)
    below.invert_yaxis()
    below.set_ylim(len(names) - 0.5, -0.5)
    below.set_xlabel("mean square per degree of freedom, with three standard errors")
    below.tick_params(labelsize=8)
    return figure


def _draw_nees(axis: Axes, trials: Trials, time: Array, label: str) -> None:
    from scipy.special import gammaincinv  # noqa: PLC0415 - scipy.stats would take a second

    M, _, n = trials.found.error.shape
    half = 0.5 * M * n
    low, high = (float(gammaincinv(half, q)) / half for q in (_TAIL, 1.0 - _TAIL))
    axis.axhspan(low, high, color=BLUE, alpha=BAND, lw=0, label="95 % of a filter that is right")
    axis.axhline(1.0, color="black", lw=0.8, ls=":")
    nees = trials.nees
    axis.plot(time, nees, color=BLUE, lw=1.0, label=f"mean over {M} trials")
    top = float(np.max(nees[np.isfinite(nees)], initial=1.0))
    axis.set_ylim(0.0, max(_LOW, 1.1 * min(top, 10.0)))
    axis.set_ylabel("NEES")
    axis.set_xlabel(label)
    axis.margins(x=0.0)
    axis.tick_params(labelsize=8)
    axis.legend(ncols=2, loc="lower right", bbox_to_anchor=(1.0, 0.98))


@styled
def draw_whiteness(spec: Spec, found: Correlations) -> Figure:
    """Correlations by lag, a panel for each row, with the band of white innovations."""
    rows = [*zip(spec.model.outputs, found.value, found.bound.tolist(), strict=True)][:LARGEST]

    def draw_one(axis: Axes, signal: Signal, values: Array, bound: float) -> None:
        axis.axhspan(-bound, bound, color=GREY, alpha=BAND, lw=0)
        axis.axhline(0.0, color="black", lw=0.6)
        axis.vlines(np.arange(1, len(values) + 1), 0.0, values, color=BLUE, lw=3.0)
        reach = max(3.0 * bound, 1.2 * float(np.max(np.abs(values), initial=0.0)))
        axis.set_ylim(-min(1.0, reach), min(1.0, reach))
        axis.set_xlim(0.0, LAGS + 1.0)
        axis.set_xticks(range(0, LAGS + 1, 5))
        axis.set_ylabel(signal.name.replace("_", " "))

    draws = [partial(draw_one, signal=s, values=v, bound=b) for s, v, b in rows]
    return panels([_HEIGHT] * len(draws), draws, "lag in measurements of the row")
