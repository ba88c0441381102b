"""Does the unknown rate get found, and how fast: ``python posterior.py``.

Draws the paper's figures 2 to 8 as posterior.png and writes claims.md, the numbers behind what the
page says about the paper's statements on convergence.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from motor import (
    HERE,
    PERIOD,
    RATES,
    RUNS,
    SAMPLES,
    Floats,
    mode_probability,
    simulate,
    specification,
)

import fkgen

HYPOTHESES = (0.1, 0.3, 0.5, 0.7, 0.9)
LIMITS = {0.75: 0.7, 0.85: 0.9}  # where the rates off the grid end; the others end at themselves
COLOURS = ("#1f5a94", "#3aa0a0", "#8a8a8a", "#d9741a", "#a02c5d")
BANKS: dict[str, dict[str, dict[str, Any]]] = {
    "the paper's likelihood, no floor": {},
    "the mixture likelihood, no floor": {"filter": {"likelihood": None}},
    "the mixture likelihood and the floor, fkgen's defaults": {
        "filter": {"likelihood": None, "weight_floor": None}
    },
}


def settling(weight: Floats) -> Floats:
    """Find the time (M,) after which a weight (M, T) stays above 0.9, s; 10 s and more: never."""
    below = weight <= 0.9
    last = np.where(below.any(axis=1), weight.shape[1] - 1 - below[:, ::-1].argmax(axis=1), -1)
    return PERIOD * (last + 1)


def convergence(probability: dict[float, Floats]) -> list[str]:
    """Say in one line per rate where the runs end, and how long they take."""
    lines = [
        "| rate | runs that end at .1 / .3 / .5 / .7 / .9 | before 1 s | median (s) | 90 % (s) |",
        "| ---: | ---: | ---: | ---: | ---: |",
    ]
    for rate, weights in probability.items():
        ends = np.bincount(weights[:, -1].argmax(axis=1), minlength=len(HYPOTHESES))
        limit = HYPOTHESES.index(LIMITS.get(rate, rate))
        settled = settling(weights[:, :, limit])
        median, slow = np.quantile(settled, (0.5, 0.9))
        counts = " / ".join(str(count) for count in ends)
        early = np.mean(settled < 1.0 - PERIOD / 2)
        lines.append(f"| {rate:.2f} | {counts} | {early:.3f} | {median:.2f} | {slow:.2f} |")
    return lines


def calibration(probability: dict[float, Floats]) -> list[str]:
    """Compare what the bank claims, where it claims 0.9 to 0.99, with how often it is right."""
    lines = ["| after (s) | statements | claimed | right |", "| ---: | ---: | ---: | ---: |"]
    for k in (20, 50, 100):
        claims, right = [], []
        for index, rate in enumerate(HYPOTHESES):
            weights = probability[rate][:, k - 1]
            claims.append(weights.max(axis=1))
            right.append(weights.argmax(axis=1) == index)
        claim = np.concatenate(claims)
        sure = (claim >= 0.9) & (claim <= 0.99)
        shares = f"{claim[sure].mean():.3f} | {np.concatenate(right)[sure].mean():.3f}"
        lines.append(f"| {PERIOD * k:.1f} | {sure.sum()} | {shares} |")
    return lines


def without_voltage(runs: int = 1000) -> list[str]:
    """Count the runs at the right hypothesis if the speed alone is measured: C = [0 1], D = 0."""
    process, sensor = 1e-4, 5e-6
    model = {"C": [[0.0, 1.0]], "D": [[0.0]], "R": [[sensor]], "outputs": None}
    bank = fkgen.build(specification("unknown_rate", model=model))
    random = np.random.default_rng(0)
    lines = ["| rate | after 1 s | after 3 s | after 10 s |", "| ---: | ---: | ---: | ---: |"]
    for index, rate in enumerate(HYPOTHESES):
        y = simulate(rate, runs, noise=process).speed
        y = y + np.sqrt(sensor) * random.standard_normal(y.shape)
        best = mode_probability(bank, y).argmax(axis=2)
        right = [float(np.mean(best[:, round(s / PERIOD) - 1] == index)) for s in (1, 3, 10)]
        lines.append(f"| {rate:.1f} | " + " | ".join(f"{share:.3f}" for share in right) + " |")
    return lines


def nearest(rate: float = 0.81, runs: int = 200) -> list[str]:
    """Count the long runs that end at 0.7 although 0.9 is nearer."""
    bank = fkgen.build(specification("unknown_rate"))
    weights = mode_probability(bank, simulate(rate, runs, 10 * SAMPLES).speed_and_voltage)
    lines = ["| after (s) | share at 0.7 | share at 0.9 |", "| ---: | ---: | ---: |"]
    for seconds in (10, 30, 100):
        best = weights[:, round(seconds / PERIOD) - 1].argmax(axis=1)
        lines.append(f"| {seconds} | {np.mean(best == 3):.3f} | {np.mean(best == 4):.3f} |")
    return lines


def draw(probability: dict[float, Floats]) -> Figure:
    """Draw one panel per true rate: one run, as in the paper, and the mean of all runs."""
    figure = Figure(figsize=(12.5, 5.6), layout="constrained")
    axes = figure.subplots(2, 4, sharex=True, sharey=True)
    order = (0.1, 0.3, 0.5, 0.7, 0.9, 0.75, 0.85)
    for axis, rate in zip(axes.flat, order, strict=False):
        panel(axis, probability[rate])
        grid = "" if rate in HYPOTHESES else ", not a hypothesis"
        axis.set_title(f"true rate {rate:g}{grid}", fontsize="medium", loc="left")
    for axis in axes[:, 0]:
        axis.set_ylabel("posterior probability")
    for axis in (*axes[1, :3], axes[0, 3]):
        axis.set_xlabel("time (s)")
        axis.tick_params(labelbottom=True)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    axes[1, 3].axis("off")
    legend = axes[1, 3].legend(handles, labels, loc="center", frameon=False)
    legend.set_title("hypothesis")
    legend.set_alignment("left")
    return figure


def panel(axis: Axes, weights: Floats) -> None:
    """Draw the posterior probabilities over time, from 0.01 s to 10 s."""
    t = PERIOD * np.arange(1, weights.shape[1] + 1)
    for index, (hypothesis, colour) in enumerate(zip(HYPOTHESES, COLOURS, strict=True)):
        axis.plot(t, weights[0, :, index], color=colour, lw=1.7, label=f"{hypothesis}, one run")
    for index, colour in enumerate(COLOURS):
        label = f"mean of {len(weights)} runs" if index == 2 else None
        axis.plot(t, weights[:, :, index].mean(axis=0), ":", color=colour, lw=1.3, label=label)
    axis.set_xscale("log")
    axis.set_xlim(PERIOD, PERIOD * weights.shape[1])
    axis.set_xticks([0.01, 0.1, 1.0, 10.0], ["0.01", "0.1", "1", "10"])
    axis.set_ylim(-0.02, 1.04)
    axis.spines[["top", "right"]].set_visible(False)
    axis.axvline(1.0, color="black", lw=0.5, alpha=0.5)


def main() -> None:
    """Write claims.md and the figure."""
    start = time.perf_counter()
    heading = f"Written by `posterior.py`: {RUNS} runs per rate. A run has settled when the\n"
    heading += "probability of the hypothesis it should end at stays above 0.9."
    sections = [("# Claims on convergence, in numbers", [heading])]
    measured = {rate: simulate(rate).speed_and_voltage for rate in RATES}
    for title, changes in BANKS.items():
        bank = fkgen.build(specification("unknown_rate", **changes))
        probability = {rate: mode_probability(bank, y) for rate, y in measured.items()}
        sections.append((f"## Convergence with {title}", convergence(probability)))
        sections.append((f"## Calibration of {title}", calibration(probability)))
        if not changes:
            figure = draw(probability)
            figure.savefig(HERE / "posterior.png", dpi=110, metadata={"Software": None})
    title = "## The right hypothesis if the voltage is not measured (D = 0)"
    sections.append((title, without_voltage()))
    sections.append(("## True rate 0.81, nearer to 0.9 than to 0.7", nearest()))
    text = "\n".join("\n".join([title, "", *lines, ""]) for title, lines in sections)
    (HERE / "claims.md").write_text(text, encoding="utf-8")
    print(text)
    print(f"{time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
