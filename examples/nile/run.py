"""Fit the local level model to the flow of the Nile: ``python run.py``.

Prints the tables of the page and draws nile.png.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

import fkgen

HERE = Path(__file__).resolve().parent
Floats = NDArray[np.floating[Any]]
NAMES = ("level_variance", "flow_variance")
PRINTED = {"level_variance": 1469.1, "flow_variance": 15099.0}
BLUE, ORANGE, GREY, LIGHT = "#1f5a94", "#d9741a", "#8a8a8a", "#cfdcea"
CUT = 0.5 * 3.841458820694124  # half the quantile of 95 % of chi-square with one degree
DAM, FIRST = 1899, 1871  # the old dam at Aswan was begun, the record begins


def read() -> tuple[Floats, Floats]:
    """Years and flows, 1e8 m3."""
    columns = np.genfromtxt(HERE / "record.csv", delimiter=",", names=True)
    return columns["year"], columns["flow"]


def fitted(flow: Floats) -> fkgen.Fit:
    """Fit both variances."""
    return fkgen.fit(fkgen.load(HERE / "spec.toml"), flow, estimate=NAMES)


def with_step(year: Floats, flow: Floats) -> fkgen.Fit:
    """Fit a level that stays but for the year of the dam, where it falls by a size to be found."""
    spec = fkgen.load(HERE / "spec.toml").to_dict()
    model: Any = spec["model"]
    model |= {"Q": [["level_variance"]], "c": ["fall*begins"]}
    spec["parameters"] = {"level_variance": 1.0, "flow_variance": 1e4, "fall": 0.0, "begins": 0.0}
    begins = (year == DAM - 1).astype(float)  # from the sample before to that of the dam
    changed = fkgen.Spec.from_dict(spec)
    return fkgen.fit(changed, flow, params={"begins": begins}, estimate=(*NAMES, "fall"))


def draw(fit: fkgen.Fit, year: Floats, flow: Floats) -> Figure:
    """Draw flows and level, and both profiles."""
    figure = Figure(figsize=(9.0, 5.4), layout="constrained")
    axes = figure.subplot_mosaic([["flow", "flow"], [*NAMES]])
    top, *profiles = axes.values()
    run = fkgen.build(fit.spec).run(flow)
    level, deviation = run.filtered_state[:, 0], np.sqrt(run.filtered_covariance[:, 0, 0])
    top.plot(year, flow, ".-", color=GREY, lw=0.6, ms=4, label="flow")
    top.fill_between(year, level - 1.96 * deviation, level + 1.96 * deviation, color=LIGHT, lw=0)
    top.plot(year, level, color=BLUE, lw=1.6, label="filtered level, 95 %")
    top.set_ylabel("flow (1e8 m³ per year)")
    top.legend(frameon=False, ncols=2)
    for axis, name in zip(profiles, NAMES, strict=True):
        draw_profile(axis, fit, name)
    for axis in (top, *profiles):
        axis.spines[["top", "right"]].set_visible(False)
    return figure


def draw_profile(axis: Axes, fit: fkgen.Fit, name: str) -> None:
    """Draw how much less likely other values of one variance are."""
    profile, (low, high) = fit.profile(name, points=61), fit.interval(0.95)[name]
    estimate, error = fit.estimates[name], fit.standard_errors[name]
    fall = profile.log_likelihood - fit.log_likelihood
    axis.plot(profile.values, fall, color=BLUE, lw=1.6, label="profile likelihood")
    parabola = -0.5 * ((profile.values - estimate) / error) ** 2
    axis.plot(profile.values, parabola, color=GREY, lw=1.0, ls="--", label="standard error")
    axis.axhline(-CUT, color=ORANGE, lw=0.8)
    axis.vlines([low, high], -5.0, -CUT, color=ORANGE, lw=0.8)
    axis.set_ylim(-5.0, 0.3)
    axis.locator_params(axis="x", nbins=6)
    axis.set_xlabel(name.replace("_", " "))
    axis.set_ylabel("log-likelihood")
    axis.legend(frameon=False, fontsize=8)


def main() -> None:
    """Print the tables and draw the figure."""
    year, flow = read()
    fit = fitted(flow)
    print("| | estimate | printed | standard error | 95 % |")
    print("| --- | ---: | ---: | ---: | --- |")
    for name, (low, high) in fit.interval().items():
        cells = f"{fit.estimates[name]:.1f} | {PRINTED[name]:g} | {fit.standard_errors[name]:.0f}"
        print(f"| `{name}` | {cells} | {low:.0f} to {high:.0f} |")
    dam = with_step(year, flow)
    print("\n| model | log-likelihood | AIC | `level_variance` | `flow_variance` | fall |")
    print("| --- | ---: | ---: | ---: | ---: | --- |")
    for label, each in (("a level that wanders", fit), ("and falls in 1899", dam)):
        two = " | ".join(f"{each.estimates[name]:.1f}" for name in NAMES)
        fall = ""
        if "fall" in each.estimates:
            fall = f"{each.estimates['fall']:.0f} ± {each.standard_errors['fall']:.0f}"
        print(f"| {label} | {each.log_likelihood:.2f} | {each.aic:.1f} | {two} | {fall} |")
    print(f"\n{dam.message}")
    figure = draw(fit, year, flow)
    figure.savefig(HERE / "nile.png", dpi=110, metadata={"Software": None})


if __name__ == "__main__":
    main()
