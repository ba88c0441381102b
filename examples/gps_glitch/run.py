"""Filter the flight with imm, one_step and kf, judge them by the barometer: ``python run.py``.

Prints the table of the page and draws gps_glitch.png.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from prepare import Floats, Record, read

import fkgen

HERE = Path(__file__).resolve().parent
FAMILIES = ("imm", "one_step", "kf")
HEALTHY_UNTIL, FAILED_FROM = 115.0, 122.0  # s
FALSE_AT_MOST, FOUND_AT_LEAST = 0.01, 0.75  # shares of the GPS samples before and after
IMM_WITHIN, KF_BEYOND = 4.0, 10.0  # m, distance from the barometer
MODES = ("good", "glitch", "reports zeros", "zeros and glitch")
BLUE, ORANGE, GREEN, RED = "#1f5a94", "#d9741a", "#3f8f4f", "#b3261e"
LIGHT, GREY = "#cfdcea", "#8a8a8a"


@dataclass(frozen=True)
class Result:
    """One filter over the flight.

    Attributes
    ----------
    height, climb, offset : (T,) ndarray
        Filtered states, m, m/s, m.
    probability : (T, 4) ndarray
        Posterior probabilities of the modes; (T, 0) for a filter without.
    declared : (G,) ndarray of bool
        GPS samples declared faulty: Pr(good GPS) below one half, given this sample too.
    distance : (T,) ndarray
        Height minus that of the barometer without its offset, m.
    """

    height: Floats
    climb: Floats
    offset: Floats
    probability: Floats
    declared: NDArray[np.bool_]
    distance: Floats


@dataclass(frozen=True)
class Verdict:
    """What is required of a filter.

    Attributes
    ----------
    false, found : float
        Share of the GPS samples declared faulty before 115 s and after 122 s.
    farthest : float
        Largest distance from the barometer from 115 s on, m.
    """

    false: float
    found: float
    farthest: float


def content() -> dict[str, Any]:
    """Read spec.toml, to be varied."""
    return tomllib.loads((HERE / "spec.toml").read_text(encoding="utf-8"))


def specification(family: str) -> fkgen.Spec:
    """Make the spec of another family with the same model and noise."""
    varied = content()
    if family != varied["filter"]["family"]:
        varied["filter"] = {"family": family}
    if family == "kf":
        del varied["faults"]
    return fkgen.Spec.from_dict(varied, file="spec.toml")


def barometer(flight: Record) -> Floats:
    """Height of the barometer minus its mean offset to the GPS before the failure, m."""
    before = flight.gps[flight.t[flight.gps] < HEALTHY_UNTIL]
    offset = np.mean(flight.y[before, 0] - flight.y[before, 1])
    return flight.y[:, 0] - offset


def run(compiled: fkgen.CompiledFilter, flight: Record) -> Result:
    """Filter the flight."""
    out = compiled.run(flight.y, params={"dt": flight.dt})
    if np.any(out.status < 0):
        raise SystemExit(f"{compiled.family}: refused samples")
    none = np.empty((flight.t.size, 0))
    probability = out.mode_probability if "mode_probability" in compiled.ports else none
    good = probability[flight.gps, :1]
    height, climb, offset = out.filtered_state.T
    return Result(
        height=height,
        climb=climb,
        offset=offset,
        probability=probability,
        declared=(good < 0.5).any(axis=1),
        distance=height - barometer(flight),
    )


def judge(flight: Record, result: Result) -> Verdict:
    """Count declarations and measure the distance."""
    t = flight.t[flight.gps]
    return Verdict(
        false=float(np.mean(result.declared[t < HEALTHY_UNTIL])),
        found=float(np.mean(result.declared[t > FAILED_FROM])),
        farthest=float(np.abs(result.distance[flight.t >= HEALTHY_UNTIL]).max()),
    )


def missed(imm: Verdict) -> list[str]:
    """Name what is required of imm and not reached."""
    required = {
        f"at most {FALSE_AT_MOST:.0%} declared before the failure": imm.false <= FALSE_AT_MOST,
        f"at least {FOUND_AT_LEAST:.0%} declared during it": imm.found >= FOUND_AT_LEAST,
        f"within {IMM_WITHIN:.0f} m of the barometer": imm.farthest <= IMM_WITHIN,
    }
    return [text for text, reached in required.items() if not reached]


def draw(flight: Record, results: dict[str, Result]) -> Figure:
    """Draw heights, distances from the barometer, vertical speed, probabilities, declarations."""
    figure = Figure(figsize=(9.0, 12.0), layout="constrained")
    axes = figure.subplots(5, 1, sharex=True, height_ratios=(2.6, 1.8, 1.7, 1.4, 0.45))
    draw_height(axes[0], flight, results)
    draw_distance(axes[1], flight, results)
    draw_climb(axes[2], flight, results["imm"])
    draw_probability(axes[3], flight, results["imm"])
    draw_declared(axes[4], flight, results["imm"])
    for axis in axes:
        axis.axvline(HEALTHY_UNTIL, color="black", lw=0.7, ls=":")
        axis.axvline(FAILED_FROM, color="black", lw=0.7, ls=":")
        axis.spines[["top", "right"]].set_visible(False)
        axis.margins(x=0.0)
    axes[-1].set_xlabel("time (s); dotted: 115 s and 122 s")
    return figure


def draw_samples(axis: Axes, flight: Record, result: Result, row: int) -> None:
    """Draw one row of the GPS, those declared faulty in another colour."""
    t, values = flight.t[flight.gps], flight.y[flight.gps, row]
    for chosen, colour, label in (
        (~result.declared, GREEN, "GPS, accepted"),
        (result.declared, RED, "GPS, declared faulty"),
    ):
        axis.plot(t[chosen], values[chosen], ".", color=colour, ms=4, label=label)


def draw_height(axis: Axes, flight: Record, results: dict[str, Result]) -> None:
    """Draw heights: sensors and estimates."""
    axis.plot(flight.t, barometer(flight), color="black", lw=3.0, alpha=0.25, label="barometer")
    draw_samples(axis, flight, results["imm"], 1)
    axis.plot(flight.t, results["kf"].height, color=ORANGE, lw=1.4, label="kf")
    axis.plot(flight.t, results["imm"].height, color=BLUE, lw=1.4, label="imm")
    axis.set_ylabel("height (m)")
    axis.set_title("The GPS goes wrong by 91 m and reports a good fix all the time", loc="left")
    axis.legend(frameon=False, loc="lower left", markerscale=2)


def draw_distance(axis: Axes, flight: Record, results: dict[str, Result]) -> None:
    """Draw what separates the estimates from the barometer, as far as imm goes."""
    axis.axhspan(-IMM_WITHIN, IMM_WITHIN, color=LIGHT, lw=0, label="within 4 m")
    axis.plot(flight.t, results["kf"].distance, color=ORANGE, lw=0.7, label="kf")
    axis.plot(flight.t, results["imm"].distance, color=BLUE, lw=0.7, label="imm")
    axis.set_ylim(-12.0, 8.0)
    axis.set_ylabel("height - barometer (m)")
    axis.legend(frameon=False, ncols=3, loc="lower left")


def draw_climb(axis: Axes, flight: Record, imm: Result) -> None:
    """Draw the vertical speed."""
    draw_samples(axis, flight, imm, 2)
    axis.plot(flight.t, imm.climb, color=BLUE, lw=1.2, label="imm")
    axis.set_ylabel("vertical speed (m/s)")
    axis.legend(frameon=False, ncols=3, loc="lower left", markerscale=2)


def draw_probability(axis: Axes, flight: Record, imm: Result) -> None:
    """Draw the posterior probabilities of the four modes on top of each other."""
    colours = (LIGHT, RED, ORANGE, GREY)
    axis.stackplot(flight.t, imm.probability.T, colors=colours, labels=MODES, lw=0)
    axis.set_ylim(0.0, 1.0)
    axis.set_ylabel("mode probability")
    axis.legend(loc="lower left", ncols=2, framealpha=0.9)


def draw_declared(axis: Axes, flight: Record, imm: Result) -> None:
    """Draw a tick for each GPS sample declared faulty."""
    t = flight.t[flight.gps][imm.declared]
    axis.eventplot(t, colors=RED, linelengths=0.9, linewidths=1.3)
    axis.set_yticks([1.0], ["declared"])
    axis.set_ylim(0.4, 1.6)


def main() -> None:
    """Print the verdicts, draw the figure, and fail if a requirement is missed."""
    flight = read()
    results = {name: run(fkgen.build(specification(name)), flight) for name in FAMILIES}
    verdicts = {name: judge(flight, result) for name, result in results.items()}
    print("| filter | declared before 115 s | declared after 122 s | farthest from barometer |")
    print("| --- | ---: | ---: | ---: |")
    for name, verdict in verdicts.items():
        shares = [f"{verdict.false:.2%}", f"{verdict.found:.1%}"] if name != "kf" else ["", ""]
        print(f"| {name} | {shares[0]} | {shares[1]} | {verdict.farthest:.1f} m |")
    draw(flight, results).savefig(HERE / "gps_glitch.png", dpi=110, metadata={"Software": None})
    failures = missed(verdicts["imm"])
    if verdicts["kf"].farthest <= KF_BEYOND:
        failures.append(f"kf beyond {KF_BEYOND:.0f} m")
    if failures:
        raise SystemExit("missed: " + "; ".join(failures))


if __name__ == "__main__":
    main()
