"""Figure 2 of the paper, drawn again: injected fault, actual and reported one-sigma."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import simulation as sim
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from outcome import Outcome

ACTUAL, REPORTED, WITHOUT = "#a02c5d", "#1f5a94", "#8a8a8a"
FROM = 600


def draw(outcomes: Mapping[str, Outcome]) -> Figure:
    """Draw the fault and three filters."""
    figure = Figure(figsize=(12.0, 6.4), layout="constrained")
    (fault, kf), (dfcf, cpcf) = figure.subplots(2, 2, sharex=True)
    seconds = np.arange(sim.END + 1)
    fault.plot(seconds, sim.fault()[:: sim.EVERY], color="black", lw=1.4, label="injected fault")
    fault.set_title("injected fault (line), m, and share rejected", loc="left", fontsize="medium")
    rejections(fault.twinx(), outcomes)
    lines(kf, outcomes[sim.KF_TEST], "kf that tests every position", highest=8.0)
    kf.plot(
        seconds, outcomes[sim.KF].over_time()[0], ":", color=WITHOUT, lw=1.6,
        label="actual one-sigma, no test",
    )  # fmt: skip
    kf.legend(frameon=False, loc="upper left")
    lines(dfcf, outcomes[sim.DFCF], "dfcf", highest=1.4)
    lines(cpcf, outcomes[sim.CPCF], "cpcf", highest=1.4)
    cpcf.plot(
        seconds, outcomes[sim.PAPER].over_time()[0], ":", color=WITHOUT, lw=1.6,
        label="actual one-sigma, maintenance (44)",
    )  # fmt: skip
    cpcf.legend(frameon=False, loc="upper left")
    for axis in (dfcf, cpcf):
        axis.set_xlabel("time, s")
    return figure


def rejections(axis: Axes, outcomes: Mapping[str, Outcome]) -> None:
    """Draw the share of rejected windows and positions."""
    ends = range(sim.WINDOW, sim.END + 1, sim.WINDOW)
    for name, colour, marker in ((sim.DFCF, REPORTED, "o"), (sim.CPCF, ACTUAL, "x")):
        rates = [outcomes[name].rejected([end]).value for end in ends]
        axis.plot(ends, rates, marker, color=colour, ms=5, label=f"{name}: windows rejected")
    made = outcomes[sim.KF_TEST].declared[:, 1:].reshape(-1, sim.END // sim.WINDOW, sim.WINDOW)
    each = made.mean(axis=(0, 2))
    axis.plot(ends, each, "-", color=WITHOUT, lw=1.4, label="kf: positions rejected")
    axis.set_ylabel("share rejected")
    axis.set_ylim(0.0, 1.05)
    axis.legend(frameon=False, loc="upper left")


def lines(axis: Axes, outcome: Outcome, title: str, *, highest: float) -> None:
    """Draw actual and reported one-sigma of one filter, from 600 s on."""
    seconds = np.arange(sim.END + 1)
    actual, reported = outcome.over_time()
    axis.plot(seconds, actual, color=ACTUAL, lw=1.6, label="actual one-sigma")
    axis.plot(seconds, reported, "--", color=REPORTED, lw=1.6, label="reported one-sigma")
    axis.axvline(sim.FAULT, color="black", lw=0.6)
    axis.set_title(f"{title}, m", loc="left", fontsize="medium")
    axis.set_xlim(FROM, sim.END)
    axis.set_ylim(0.0, highest)
    axis.grid(axis="y", lw=0.4, alpha=0.6)
    axis.legend(frameon=False, loc="upper left")
