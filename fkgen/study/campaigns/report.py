"""Campaigns and sweeps as pictures, and what the command does."""

from __future__ import annotations

import sys
from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import CenteredNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from fkgen.errors import DataError, OutputError
from fkgen.problem import Spec, load
from fkgen.study.campaigns.campaign import montecarlo
from fkgen.study.campaigns.results import Campaign
from fkgen.study.campaigns.sweep import Axis, Sweep, sweep
from fkgen.study.campaigns.tally import SIGMAS
from fkgen.study.comparisons.ranking import Estimate
from fkgen.study.records.files import refuse_targets
from fkgen.study.records.table import numbers_of
from fkgen.study.reports.plots import BAND, BLUE, GREY, ORANGE, SHADES, save, styled

#: What a picture of a campaign may show.
PARTS = ("coverage", "calibration", "roc")
_FEW = 4  # states whose bars are told apart in a narrow panel
_DARK = 0.6  # share of the largest value from which on a cell is dark
_COLOURS = SHADES[:6]
_WELL = SHADES[2]  # where a filter is consistent


def campaigned(
    spec: Spec,
    *,
    inputs: str,
    truth: Path | None,
    over: Sequence[str],
    plot: Path | None,
    force: bool,
    checkpoint: Path | None,
    **options: object,
) -> Campaign | Sweep:
    """What ``fkgen montecarlo`` does; progress is shown on a terminal."""
    refuse_targets(None, plot, force=force)
    given: dict[str, object] = {"u": numbers_of("--u", inputs, spec.model.nu), **options}
    given |= {"truth": None if truth is None else load(truth), "progress": sys.stderr.isatty()}
    found: Campaign | Sweep
    if not over:
        found = montecarlo(spec, checkpoint=checkpoint, **given)  # type: ignore[arg-type]
    elif checkpoint is not None:
        expected = "one of the two: a checkpoint holds one campaign"
        raise DataError("--checkpoint", given="a file beside --sweep", expected=expected)
    else:
        pairs = [text.partition("=") for text in over]
        keys = {key.strip(): values for key, _, values in pairs}
        if len(keys) < len(pairs):
            raise DataError("--sweep", given="a key twice", expected="each key once")
        if plot is not None and len(keys) > 2:
            given_, expected = f"a picture of {len(keys)} sweeps", "one or two, or no --plot"
            raise OutputError(str(plot), given=given_, expected=expected)
        found = sweep(spec, keys, **given)  # type: ignore[arg-type]
    if plot is not None:
        save(draw_sweep(found) if isinstance(found, Sweep) else draw(found), plot, force=force)
    return found


@styled
def draw(found: Campaign, parts: Collection[str] = PARTS) -> Figure:
    """Draw how often errors are within 1, 2 and 3 sigma, and what probabilities of modes tell."""
    draws = [_draw_coverage] if "coverage" in parts else []
    if len(found.calibration.value):
        draws += [_draw_calibration] if "calibration" in parts else []
        draws += [_draw_roc] if "roc" in parts else []
    wide = draws == [_draw_coverage] and len(found.states) > _FEW
    width = 9.0 if wide else (5.0, 9.0, 13.0)[len(draws) - 1]
    figure = Figure(figsize=(width, 4.2), layout="constrained")
    for axis, draw_panel in zip(
        figure.subplots(1, len(draws), squeeze=False)[0], draws, strict=True
    ):
        draw_panel(axis, found)
    of = f"{found.trials} trials of {found.steps} samples"
    figure.suptitle(f"{found.name}: {of}", x=0.01, ha="left", fontsize=10)
    return figure


def _draw_coverage(axis: Axes, found: Campaign) -> None:
    from scipy.special import erf  # noqa: PLC0415 - scipy takes long to import

    nominal = 100.0 * erf(np.array(SIGMAS) / np.sqrt(2.0))
    at, width = np.arange(len(SIGMAS)), 0.8 / len(found.states)
    for i, name in enumerate(found.states):
        place = at + (i - 0.5 * (len(found.states) - 1)) * width
        value, error = (100.0 * each[i] for each in found.coverage)
        colour = _COLOURS[i % len(_COLOURS)]
        axis.bar(place, value, 0.9 * width, yerr=error, color=colour, label=name)
    axis.hlines(nominal, at - 0.45, at + 0.45, color="black", lw=1.0, ls=":", label="if normal")
    axis.set_xticks(at, [f"{k} sigma" for k in SIGMAS])
    axis.set_ylabel("errors within (%)")
    axis.set_ylim(0.0, 118.0)
    axis.legend(ncols=4 if len(found.states) <= _FEW else 7, loc="upper left")


def _draw_calibration(axis: Axes, found: Campaign) -> None:
    axis.plot([0.0, 1.0], [0.0, 1.0], color="black", lw=0.8, ls=":")
    every = zip(found.predicted.value, *found.calibration, strict=True)
    for i, (p, value, error) in enumerate(every):
        colour = _COLOURS[i % len(_COLOURS)]
        axis.errorbar(p, value, yerr=error, fmt="o-", ms=4, lw=1.0, color=colour, label=f"mode {i}")
    axis.set_xlabel("probability of a mode")
    axis.set_ylabel("how often it is the true one")
    axis.legend()


def _draw_roc(axis: Axes, found: Campaign) -> None:
    axis.plot([0.0, 1.0], [0.0, 1.0], color="black", lw=0.8, ls=":")
    roc = found.roc
    every = zip(roc.false_alarm.value, roc.detection.value, *roc.area, strict=True)
    for i, (x, y, area, error) in enumerate(every):
        if not np.isfinite(area):
            continue
        label = f"mode {i}, area {Estimate(area, error)}".replace("+-", "\N{PLUS-MINUS SIGN}")
        line, colour = (np.append(x, 0.0), np.append(y, 0.0)), _COLOURS[i % len(_COLOURS)]
        axis.plot(*line, "o-", ms=4, lw=1.0, color=colour, label=label)
    axis.set_xlabel("declared where another mode is true: false alarms")
    axis.set_ylabel("declared where the mode is true: detections")
    axis.legend(loc="lower right")


@styled
def draw_sweep(found: Sweep) -> Figure:
    """Draw curves over one key or a map over two, and where the filter stays consistent."""
    if len(found.axes) == 1:
        figure = Figure(figsize=(7.0, 5.6), layout="constrained")
        above, below = figure.subplots(2, 1, sharex=True)
        _draw_curves(above, below, found)
    else:
        figure = Figure(figsize=(6.6, 4.8), layout="constrained")
        _draw_map(figure, figure.subplots(), found)
    ran = found.campaigns[0]
    of = f"{ran.trials} trials of {ran.steps} samples each"
    figure.suptitle(f"{found.name}: {of}", x=0.01, ha="left", fontsize=10)
    return figure


def _draw_curves(above: Axes, below: Axes, found: Sweep) -> None:
    (axis,) = found.axes
    x, well = np.array(axis.values), found.consistent
    edges = _edges(x, axis)
    for axes in (above, below):
        for i in np.flatnonzero(well):
            label = "consistent" if i == np.flatnonzero(well)[0] else None
            axes.axvspan(edges[i], edges[i + 1], color=_WELL, alpha=BAND, lw=0, label=label)
        for value in x[[not isinstance(each, Campaign) for each in found.cells]]:
            axes.axvline(value, color=GREY, lw=1.0, ls="--", label="no such plant")
        if axis.factor:
            axes.set_xscale("log")
            axes.set_xticks(x, [axis.label(value) for value in x], minor=False)
            axes.minorticks_off()
        axes.tick_params(labelsize=8)
    for name, colour in (("nees", BLUE), ("nis", ORANGE)):
        above.plot(x, found.values(name), "o-", ms=4, color=colour, label=name.upper())
    above.axhline(1.0, color="black", lw=0.8, ls=":")
    above.set_ylabel("per degree of freedom")
    ran = found.campaigns[0]
    for name, values, colour in zip(ran.states, found.values("rmse").T, _COLOURS * 9, strict=False):
        below.plot(x, values, "o-", ms=4, color=colour, label=name)
    below.set_ylabel("rmse")
    below.set_xlabel(axis.key)
    above.legend(ncols=3)
    below.legend(ncols=3)


def _edges(x: np.ndarray, axis: Axis) -> np.ndarray:
    """Limits between values, which are ordered, half way."""
    scale = np.log(x) if axis.factor else x
    if len(x) == 1:
        edges = np.array([scale[0] - 0.1, scale[0] + 0.1])
    else:
        middle = 0.5 * (scale[1:] + scale[:-1])
        edges = np.array([2 * scale[0] - middle[0], *middle, 2 * scale[-1] - middle[-1]])
    return np.asarray(np.exp(edges) if axis.factor else edges)


def _draw_map(figure: Figure, axes: Axes, found: Sweep) -> None:
    down, across = found.axes
    values = np.log2(found.values("nees"))
    image = axes.imshow(values, cmap="RdBu_r", norm=CenteredNorm(), origin="lower", aspect="auto")
    for (i, j), each in np.ndenumerate(found.cells):
        text = f"{each.nees.value:.3g}" if isinstance(each, Campaign) else "no such\nplant"
        dark = np.abs(values[i, j]) > _DARK * np.nanmax(np.abs(values))
        colour = "white" if dark else "black"
        axes.text(j, i, text, ha="center", va="center", fontsize=7, color=colour)
        if found.consistent[i, j]:
            axes.add_patch(_frame(j, i))
    bar = figure.colorbar(image, ax=axes)
    bar.set_label("NEES per degree of freedom, as a power of 2")
    axes.set_xticks(range(len(across.values)), list(map(across.label, across.values)))
    axes.set_yticks(range(len(down.values)), list(map(down.label, down.values)))
    axes.tick_params(labelsize=8)
    axes.set_xlabel(across.key)
    axes.set_ylabel(down.key)
    axes.set_title("green frames: every verdict is consistent")


def _frame(j: int, i: int) -> Rectangle:
    return Rectangle((j - 0.46, i - 0.45), 0.92, 0.9, fill=False, edgecolor="#2e7d4f", lw=2.5)
