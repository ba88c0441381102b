"""Figures 1 to 8 of the paper: deviations of the filtered state under pulses and steps."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from song_hu import HORIZON, LAST, MODELS, START, Floats, spec

import fkgen
from fkgen.profiles import pulse, step

COLOURS = ("#1f5a94", "#d9741a", "#4c9a6a")


def sensor_figures() -> Figure:
    """Figures 1 to 4: a unit fault of both sensors at once."""
    panels = {}
    for name in MODELS:
        once, lasting = _profiles(np.ones(2), START - 1)
        panels[name] = [
            fkgen.fault_effect(spec(name), fault).state_deviation for fault in (once, lasting)
        ]
    return _drawn(panels, 1, "fault of both sensors, size 1 each")


def input_figures() -> Figure:
    """Figures 5 to 8: a unit anomaly of the input, of which plant and filter know."""
    panels = {}
    for name in MODELS:
        once, lasting = _profiles(np.ones(1), START - 2)
        panels[name] = [
            fkgen.fault_effect(spec(name), input=fault).state_deviation for fault in (once, lasting)
        ]
    return _drawn(panels, 5, "anomaly of the input, size 1")


def _profiles(size: Floats, start: int) -> tuple[Floats, Floats]:
    """The pulse at START and the step from START to LAST, in samples of fkgen."""
    return pulse(HORIZON, start, size), step(HORIZON, start, size, stop=start + LAST - START + 1)


def _drawn(panels: dict[str, list[Floats]], first: int, what: str) -> Figure:
    figure = Figure(figsize=(12.0, 11.0), layout="constrained")
    axes = figure.subplots(len(panels), 2, sharex=True)
    for row, (name, deviations) in enumerate(panels.items()):
        for axis, deviation in zip(axes[row], deviations, strict=True):
            _panel(axis, deviation)
        axes[row][0].set_ylabel(f"model {name}")
        axes[row][0].set_title(f"figure {first + row}: {MODELS[name][3]}", loc="left", fontsize=10)
    handles, labels = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
    for axis, kind in zip(axes[-1], ("pulse", f"step, k = {START} to {LAST}"), strict=True):
        axis.set_xlabel(f"k; {kind}")
    figure.suptitle(f"Deviation of the filtered state: {what}, from k = {START}; cov X[0] = I")
    return figure


def _panel(axis: Axes, deviation: Floats) -> None:
    k = np.arange(1, len(deviation) + 1)  # as the paper counts
    for i, colour in enumerate(COLOURS):
        axis.plot(k, deviation[:, i], color=colour, lw=1.3, label=f"$X_{i + 1}$")
    axis.axhline(0.0, color="black", lw=0.5)
    axis.spines[["top", "right"]].set_visible(False)
    axis.margins(x=0.0)
    axis.tick_params(labelsize=8)
