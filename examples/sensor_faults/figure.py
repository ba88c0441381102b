"""Figure 1 of the paper, drawn again: errors over those of the genie, sample by sample."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from errors import Errors
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from section_vi import GENIE, IMM, LINEAR, NAIVE_MEAN, ONE_STEP, Study

LINES = {  # name in the legend, colour, line style as in the paper, width
    NAIVE_MEAN: ("kf with the mean noise", "#8a8a8a", "-.", 1.2),
    LINEAR: ("linear_optimal (23)", "#d9741a", "--", 1.8),
    ONE_STEP: ("one_step", "#1f5a94", "-", 1.8),
    IMM: ("imm", "#a02c5d", ":", 2.0),
}
HIGHEST = 1.8
COINCIDE = 0.02
"""Largest distance of two lines that look like one."""


def draw(results: Sequence[tuple[Study, Mapping[str, Errors]]], stated: Sequence[str]) -> Figure:
    """Draw one panel per study.

    Parameters
    ----------
    results : sequence of (Study, errors by name)
        What to draw.
    stated : sequence of str
        What the paper says of each.
    """
    figure = Figure(figsize=(13.0, 4.6), layout="constrained")
    axes = figure.subplots(1, len(results), sharey=True)
    for axis, (study, errors), statement in zip(axes, results, stated, strict=True):
        panel(axis, errors)
        axis.set_title(f"{study.title}\n{statement}", fontsize="medium", loc="left")
    axes[0].set_ylabel("mean squared error / that of the genie")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(LINES), frameon=False)
    return figure


def panel(axis: Axes, errors: Mapping[str, Errors]) -> None:
    """Draw the ratios over time, from sample 1 on."""
    over = {name: errors[name].over_time(errors[GENIE]) for name in LINES}
    last = len(over[LINEAR])
    for name, (label, colour, style, width) in LINES.items():
        axis.plot(np.arange(1, last + 1), over[name], style, color=colour, lw=width, label=label)
    for upper, lower in ((NAIVE_MEAN, LINEAR), (ONE_STEP, IMM)):
        if np.abs(over[upper] - over[lower]).max() < COINCIDE:
            text = f"{LINES[upper][0]} and {LINES[lower][0]} coincide"
            height = over[lower][last // 4 :].min() - 0.012
            axis.text(last, height, text, ha="right", va="top", fontsize="small")
    axis.axhline(1.0, color="black", lw=0.6)
    axis.text(last, 1.008, "genie", ha="right", va="bottom", fontsize="small")
    axis.set_xlim(1, last)
    axis.set_ylim(0.95, HIGHEST)
    axis.set_xlabel("sample k")
    axis.grid(axis="y", lw=0.4, alpha=0.6)
    axis.spines[["top", "right"]].set_visible(False)
