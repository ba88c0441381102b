"""One run of the target: what was lost, what was declared lost, and where the estimates go."""

from __future__ import annotations

import losses
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import fkgen

SHOWN, SEED, RUN = slice(0, 200), 7, 3
BLUE, ORANGE, GREEN, RED, GREY = "#1f5a94", "#d9741a", "#3f8f4f", "#b3261e", "#8a8a8a"
COLOURS = {losses.KNOWN: GREEN, losses.LLR: BLUE, losses.ENERGY: ORANGE}


def draw() -> Figure:
    """Filter one record with three filters and draw it."""
    study = losses.STUDIES[0]
    records = losses.simulate(study, RUN + 1, SEED)
    specs = losses.filters(study)
    runs = {name: fkgen.build(specs[name]).run(losses.seen(name, records)[RUN]) for name in COLOURS}
    state, measured, lost = (
        each[RUN, SHOWN] for each in (records.state, records.measured[..., 0], records.lost)
    )
    k = np.arange(SHOWN.stop)
    figure = Figure(figsize=(9.0, 8.5), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True, height_ratios=(3.0, 1.8, 0.8))
    axes[0].plot(k, state, color="black", lw=3.0, alpha=0.25, label="position")
    axes[0].plot(k[~lost], measured[~lost], ".", color=GREY, ms=4, label="sample, good")
    axes[0].plot(k[lost], measured[lost], "x", color=RED, ms=5, label="sample, lost")
    for name, colour in COLOURS.items():
        estimate = runs[name].filtered_state[SHOWN, 0]
        axes[0].plot(k, estimate, color=colour, lw=1.2, label=name)
        axes[1].plot(k, estimate - state, color=colour, lw=1.0, label=name)
    axes[0].set_ylabel("position (m)")
    axes[0].set_title("A lost sample is noise about zero, and says nothing of it", loc="left")
    axes[0].legend(frameon=False, ncols=2, loc="best")
    axes[1].set_ylim(-12.0, 12.0)
    axes[1].set_ylabel("error (m)")
    _ticks(axes[2], {
        "energy": (np.flatnonzero(runs[losses.ENERGY].fault_declared[SHOWN] > 0.5), ORANGE),
        "llr": (np.flatnonzero(runs[losses.LLR].fault_declared[SHOWN] > 0.5), BLUE),
        "lost": (np.flatnonzero(lost), RED),
    })  # fmt: skip
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
        axis.margins(x=0.0)
    axes[-1].set_xlabel("sample")
    return figure


def _ticks(axis: Axes, rows: dict[str, tuple[np.ndarray, str]]) -> None:
    """A tick for each sample that was lost, or declared so."""
    for at, (samples, colour) in enumerate(rows.values()):
        axis.eventplot(samples, colors=colour, lineoffsets=at, linelengths=0.8, linewidths=1.2)
    axis.set_yticks(range(len(rows)), list(rows))
    axis.set_ylabel("declared")
