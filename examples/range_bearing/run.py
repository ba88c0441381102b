"""Simulate the robot, filter 200 drives, compare: ``python run.py``.

Prints the tables of the page and draws range_bearing.png.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.stats import chi2

import fkgen

HERE = Path(__file__).resolve().parent
Floats = NDArray[np.floating[Any]]
FILTERS = ("imm", "one_step", "genie", "ekf", "ekf, mean noise")
SEED, DRIVES, SAMPLES = 1, 200, 1200
SPEED, TURN = 1.0, 0.1  # m/s, rad/s: a circle of 10 m around a point 7 m from the beacon
NOISE, SLIP, DRIFT = (0.05, 0.02, 0.1), 0.1, 0.05  # as in the spec
WORSE, SETS_IN, ENDS = 40.0, 0.01, 0.05  # times the noise; probabilities per sample
LONGER = 2.0  # m, mean of what a reflection adds
UNSURE = (0.03, 0.3, 2.0)  # rad, deviations of the heading at the start
BLUE, ORANGE, RED, LIGHT = "#1f5a94", "#d9741a", "#b3261e", "#cfdcea"


@dataclass(frozen=True)
class Drives:
    """Simulated drives: M of them, T samples.

    Attributes
    ----------
    state : (M, T, 3) ndarray
        x, y (m), heading (rad).
    y : (M, T, 3) ndarray
        Range (m), bearing and compass (rad, in (-pi, pi]).
    obstructed : (M, T) ndarray of bool
        Whether the range is that of a reflection.
    """

    state: Floats
    y: Floats
    obstructed: NDArray[np.bool_]


def content() -> dict[str, Any]:
    """Read spec.toml, to be varied."""
    return tomllib.loads((HERE / "spec.toml").read_text(encoding="utf-8"))


def wrapped(angle: Floats) -> Floats:
    """Reduce angles to (-pi, pi]."""
    return np.asarray(np.pi - (np.pi - angle) % (2.0 * np.pi))


def simulated(*, reflections: bool = False, heading: float = 0.3, seed: int = SEED) -> Drives:
    """Draw drives by formulas of their own, not by the spec.

    Parameters
    ----------
    reflections : bool
        An obstructed range is too long, by an exponential law; else its noise is 40 times as large.
    heading : float
        Deviation of the heading at the start, rad.
    seed : int
    """
    rng = np.random.default_rng(seed)
    x = content()["model"]["x0"] + rng.standard_normal((DRIVES, 3)) * (1.0, 1.0, heading)
    obstructed = rng.random(DRIVES) < SETS_IN / (SETS_IN + ENDS)
    rows = list[tuple[Floats, Floats, NDArray[np.bool_]]]()
    for _ in range(SAMPLES):
        v = rng.standard_normal((DRIVES, 3)) * NOISE
        wrong = rng.exponential(LONGER, DRIVES) + v[:, 0] if reflections else WORSE * v[:, 0]
        v[:, 0] = np.where(obstructed, wrong, v[:, 0])
        seen = np.arctan2(-x[:, 1], -x[:, 0]) - x[:, 2]
        y = np.column_stack([np.hypot(x[:, 0], x[:, 1]), seen, x[:, 2]]) + v
        y[:, 1:] = wrapped(y[:, 1:])
        rows.append((x, y, obstructed))
        step = 0.1 * SPEED * (1.0 + SLIP * rng.standard_normal(DRIVES))
        turn = 0.1 * (TURN + DRIFT * rng.standard_normal(DRIVES))
        x = x + np.column_stack([step * np.cos(x[:, 2]), step * np.sin(x[:, 2]), turn])
        changes = np.where(obstructed, ENDS, SETS_IN)
        obstructed = obstructed ^ (rng.random(DRIVES) < changes)
    state, y, obstructed = (np.stack(each, axis=1) for each in zip(*rows, strict=True))
    return Drives(state, y, obstructed)


def built(family: str, **changes: Any) -> fkgen.CompiledFilter:
    """Build a filter of the spec with another family, and with other keys of the model."""
    varied = content()
    varied["model"] |= changes
    varied["filter"] = {"family": family}
    if family == "ekf":
        del varied["faults"]
    return fkgen.build(fkgen.Spec.from_dict(varied, file="spec.toml"))


def filters(names: Iterable[str] = FILTERS) -> dict[str, fkgen.CompiledFilter]:
    """Build what is compared."""
    R = content()["model"]["R"]
    share = SETS_IN / (SETS_IN + ENDS)
    R[0][0] *= 1.0 + share * (WORSE**2 - 1.0)
    mean = {"ekf, mean noise": {"R": R}}
    return {name: built(name.split(",")[0], **mean.get(name, {})) for name in names}


def run(compiled: fkgen.CompiledFilter, drives: Drives) -> fkgen.BatchRun:
    """Filter all drives."""
    told = {}
    if compiled.family == "genie":
        gamma = np.ones(drives.obstructed.shape)
        told = {"gamma": gamma, "delta": np.where(drives.obstructed, WORSE**2, 1.0)}
    u = np.broadcast_to([SPEED, TURN], (DRIVES, SAMPLES, 2))
    return compiled.run_batch(drives.y, u, params=told)


def errors(out: fkgen.BatchRun, drives: Drives) -> tuple[Floats, Floats]:
    """Distances from the true position, m, and normalised errors squared over their number."""
    wrong = out.filtered_state - drives.state
    wrong[..., 2] = wrapped(wrong[..., 2])
    solved = np.linalg.solve(out.filtered_covariance, wrong[..., None])[..., 0]
    return np.hypot(wrong[..., 0], wrong[..., 1]), np.sum(wrong * solved, axis=-1) / 3.0


def without(drives: Drives, row: int) -> Drives:
    """Take a row of y away."""
    y = drives.y.copy()
    y[..., row] = np.nan
    return replace(drives, y=y)


def table(
    compiled: dict[str, fkgen.CompiledFilter], drives: Drives
) -> dict[str, tuple[float, ...]]:
    """Position error, the same where the range is obstructed, and mean NEES, by filter."""
    runs = {name: (each, drives) for name, each in compiled.items()}
    runs["ekf, without the range"] = (compiled["ekf"], without(drives, 0))
    result = {}
    for name, (each, given) in runs.items():
        distance, nees = errors(run(each, given), given)
        behind = distance[drives.obstructed]
        both = (float(np.sqrt(np.mean(part**2))) for part in (distance, behind))
        result[name] = (*both, float(nees.mean()))
    return result


def limits() -> list[tuple[float, bool, float, float]]:
    """Measure what an ekf knows of what it does not know, without obstacles.

    Returns
    -------
    list of (deviation of the heading at the start, with a compass, NEES, share beyond 99 %)
        Of the second minute.
    """
    result = []
    for unsure in UNSURE:
        P0 = content()["model"]["P0"]
        P0[2][2] = unsure**2
        drives = simulated(heading=unsure)
        y = drives.y.copy()
        y[drives.obstructed, 0] = np.nan
        clear = replace(drives, y=y)
        compiled = built("ekf", P0=P0)
        for compass, given in ((True, clear), (False, without(clear, 2))):
            nees = errors(run(compiled, given), given)[1][:, SAMPLES // 2 :]
            beyond = float(np.mean(3.0 * nees > chi2.ppf(0.99, 3)))
            result.append((unsure, compass, float(nees.mean()), beyond))
    return result


def draw(compiled: dict[str, fkgen.CompiledFilter], drives: Drives, drive: int = 0) -> Figure:
    """Draw one drive: the way, the range, the error, the probability."""
    figure = Figure(figsize=(9.5, 5.6), layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=(1.0, 1.15))
    way = left.subplots()
    axes = right.subplots(3, 1, sharex=True, height_ratios=(1.2, 1.2, 0.8))
    outs = {name: run(compiled[name], drives) for name in ("ekf", "imm")}
    draw_way(way, {name: out.filtered_state[drive] for name, out in outs.items()}, drives, drive)
    t = 0.1 * np.arange(SAMPLES)
    distance = np.hypot(*drives.state[drive, :, :2].T)
    axes[0].plot(t, drives.y[drive, :, 0] - distance, ".", color=RED, ms=2.0)
    axes[0].set_ylabel("error of the range (m)")
    for (name, out), colour in zip(outs.items(), (ORANGE, BLUE), strict=True):
        axes[1].plot(t, errors(out, drives)[0][drive], color=colour, lw=1.0, label=name)
    axes[1].set_ylabel("position error (m)")
    axes[1].legend(frameon=False, ncols=2)
    axes[2].fill_between(t, drives.obstructed[drive], color=LIGHT, lw=0, label="obstructed")
    obstructed = outs["imm"].mode_probability[drive, :, 1]
    axes[2].plot(t, obstructed, color=BLUE, lw=0.8, label="probability")
    axes[2].set_ylim(0.0, 1.6)
    axes[2].set_yticks([0.0, 1.0])
    axes[2].legend(frameon=False, ncols=2, loc="upper right")
    axes[2].set_xlabel("time (s)")
    for axis in (way, *axes):
        axis.spines[["top", "right"]].set_visible(False)
    return figure


def draw_way(axis: Axes, ways: dict[str, Floats], drives: Drives, drive: int) -> None:
    """Draw where the robot was, and where filters say it was."""
    true = drives.state[drive]
    axis.plot(*true[:, :2].T, color="black", lw=3.0, alpha=0.25, label="true")
    for (name, way), colour in zip(ways.items(), (ORANGE, BLUE), strict=True):
        axis.plot(*way[:, :2].T, color=colour, lw=1.0, label=name)
    axis.plot(0.0, 0.0, "^", color="black", ms=8, label="beacon")
    axis.set_aspect("equal")
    axis.set_xlabel("x (m)")
    axis.set_ylabel("y (m)")
    axis.set_title("Two minutes around a beacon", loc="left")
    axis.legend(frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=4)


def main() -> None:
    """Print the tables and draw the figure."""
    compiled, drives = filters(), simulated()
    found = table(compiled, drives)
    longer = table(compiled, simulated(reflections=True))
    print("| filter | position | obstructed | NEES | position | obstructed | NEES |")
    print("| --- |" + " ---: |" * 6)
    for name, numbers in found.items():
        cells = (f"{a:.2f} m | {b:.2f} m | {n:.2f}" for a, b, n in (numbers, longer[name]))
        print(f"| {name} | " + " | ".join(cells) + " |")
    print("\n| heading at the start | with compass | without |")
    print("| --- | --- | --- |")
    for (unsure, _, *with_it), (_, _, *without_it) in zip(*[iter(limits())] * 2, strict=True):
        both = (f"{nees:.2f}, {beyond:.0%}" for nees, beyond in (with_it, without_it))
        print(f"| {unsure} rad | " + " | ".join(both) + " |")
    figure = draw(compiled, drives)
    figure.savefig(HERE / "range_bearing.png", dpi=110, metadata={"Software": None})


if __name__ == "__main__":
    main()
