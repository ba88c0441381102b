"""The track with its stretches taken out, their predictions, and the modes of the ship."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from prepare import REMOVED, Floats, Record, stretches

import fkgen

BLUE, ORANGE, GREY, RED, GREEN, LIGHT = (
    "#1f5a94",
    "#d9741a",
    "#8a8a8a",
    "#b3261e",
    "#3f8f4f",
    "#cfdcea",
)
COLOURS = {"imm": BLUE, "kf": ORANGE}
TWO_SIGMA = 5.99  # 95 % of a chi-square variable with two degrees of freedom
SAILS_FROM = 3150.0  # s: before that ship A lies at its berth for most of the time
AROUND = 60.0  # s shown before and after a stretch


def draw(ship: Record, results: dict[str, fkgen.Run]) -> Figure:
    """Draw one panel per stretch, and the probabilities of the modes below."""
    figure = Figure(figsize=(10.0, 8.0), layout="constrained")
    grid = figure.add_gridspec(2, len(REMOVED), height_ratios=(2.2, 1.0))
    for at, (start, end) in enumerate(REMOVED):
        axis = figure.add_subplot(grid[0, at])
        stretch(axis, ship, results, (start, end))
        axis.set_title(f"{start:.0f} to {end:.0f} s", loc="left")
        if at == 0:
            axis.set_ylabel("north (m)")
            axis.legend(frameon=False, fontsize="small")
    modes(figure.add_subplot(grid[1, :]), ship, results["imm"])
    return figure


def stretch(
    axis: Axes, ship: Record, results: dict[str, fkgen.Run], span: tuple[float, float]
) -> None:
    """Draw the reports around a stretch, the hidden ones, and what two filters predict."""
    near = (ship.t >= span[0] - AROUND) & (ship.t <= span[1] + AROUND) & ship.reported
    hidden = stretches(ship.t) & near
    axis.plot(*ship.y[near & ~hidden, :2].T, ".", color=GREY, ms=5, label="report")
    axis.plot(*ship.y[hidden, :2].T, "x", color=RED, ms=5, label="report, taken out")
    gap = np.flatnonzero((ship.t >= span[0]) & (ship.t < span[1]))
    for name, out in results.items():
        path = out.filtered_state[gap[0] - 1 : gap[-1] + 1, :2]
        axis.plot(*path.T, color=COLOURS[name], lw=1.5, label=name)
        P = out.filtered_covariance[gap[-1], :2, :2]
        axis.add_patch(_ellipse(path[-1], P, COLOURS[name]))
    axis.set_aspect("equal", adjustable="datalim")
    axis.set_xlabel("east (m)")
    axis.spines[["top", "right"]].set_visible(False)


def _ellipse(centre: Floats, P: Floats, colour: str) -> Ellipse:
    """95 % of the positions at the end of a stretch."""
    values, vectors = np.linalg.eigh(P)
    width, height = 2.0 * np.sqrt(TWO_SIGMA * values)
    angle = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
    return Ellipse(
        (float(centre[0]), float(centre[1])), width, height, angle=angle, fill=False,
        color=colour, lw=1.2, ls="--",
    )  # fmt: skip


def modes(axis: Axes, ship: Record, imm: fkgen.Run) -> None:
    """Draw the probabilities of the modes on top of each other."""
    labels = ("straight", "to the left", "to the right")
    axis.stackplot(
        ship.t, imm.mode_probability.T, colors=(LIGHT, GREEN, ORANGE), labels=labels, lw=0
    )
    for start, end in REMOVED:
        axis.axvspan(start, end, color=RED, alpha=0.15, lw=0)
    axis.set_ylim(0.0, 1.0)
    axis.set_xlim(SAILS_FROM, ship.t[-1])
    axis.set_xlabel("time (s); red: taken out")
    axis.set_ylabel("mode probability")
    axis.legend(loc="lower left", ncols=3, framealpha=0.9)
