"""Filter the trials, judge them by the cameras: ``python run.py``.

Prints the table of the page and draws attitude.png. ``python run.py --data FOLDER`` scores any
trials of the benchmark, ``broad_*.npz``, and says what the first sample of a record has to do
with it.
"""

from __future__ import annotations

import argparse
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from prepare import EVERY, TRIALS, Record, read, thinned
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

import fkgen

HERE = Path(__file__).resolve().parent
Floats = NDArray[np.floating[Any]]
VQF = {16: (0.74, 0.70), 30: (2.57, 1.96), 32: (7.67, 6.44), 35: (1.09, 1.08)}  # vqf 2.1.2
FIELD, MOVES, NOISY = slice(3, 6), 1, 2
SHOWN = 32
MODES = ("consistent", "the offset moves", "noisy")
BLUE, ORANGE, GREEN, RED = "#1f5a94", "#d9741a", "#3f8f4f", "#b3261e"
LIGHT, GREY = "#cfdcea", "#8a8a8a"


@dataclass(frozen=True)
class Score:
    """The benchmark's score of one trial, root mean squares in degrees.

    Attributes
    ----------
    total : float
        Of the angle between estimate and truth.
    turned : float
        The same after the constant turn about the vertical that makes it least.
    """

    total: float
    turned: float


def content() -> dict[str, Any]:
    """Read spec.toml, to be varied."""
    return tomllib.loads((HERE / "spec.toml").read_text(encoding="utf-8"))


def plain(*, noisy: bool = False) -> fkgen.Spec:
    """Make the spec of an ekf without modes: with the noise of the first one, or of the last."""
    varied = content()
    modes = varied.pop("faults")["jump"]["modes"]
    if noisy:
        varied["model"]["R"] = modes[NOISY]["R"]
    return fkgen.Spec.from_dict(varied | {"filter": {"family": "ekf"}}, file="spec.toml")


def without_rests(record: Record) -> Record:
    """Take away what prepare.py says about rests."""
    y = record.y.copy()
    y[:, 6:] = np.nan
    return Record(record.t, record.u, y, record.truth)


def run(compiled: fkgen.CompiledFilter, record: Record) -> fkgen.Run:
    """Filter one trial."""
    out = compiled.run(record.y, record.u)
    if np.any(out.status < 0):
        raise SystemExit(f"{compiled.family}: refused samples")
    return out


def errors(out: fkgen.Run, record: Record) -> Rotation:
    """Turns, in world axes, from truth to estimate at the rows that the benchmark scores."""
    scored = np.isfinite(record.truth[:, 0])
    found = Rotation.from_quat(out.filtered_state[scored, :4], scalar_first=True)
    return found * Rotation.from_quat(record.truth[scored], scalar_first=True).inv()


def score(out: fkgen.Run, record: Record) -> Score:
    """Score one trial."""
    turns = errors(out, record)

    def rms(heading: float) -> float:
        turned = Rotation.from_rotvec([0.0, 0.0, heading]) * turns
        return float(np.degrees(np.sqrt(np.mean(turned.magnitude() ** 2))))

    middle = -float(turns.mean().as_rotvec()[2])
    best = minimize_scalar(rms, bracket=(middle - 0.02, middle + 0.02))
    return Score(rms(0.0), float(best.fun))


def filters() -> dict[str, fkgen.CompiledFilter]:
    """Build what is compared."""
    specs = {
        "imm": fkgen.load(HERE / "spec.toml"),
        "ekf": plain(),
        "ekf, noise of the noisy mode": plain(noisy=True),
    }
    return {name: fkgen.build(spec) for name, spec in specs.items()}


def table(compiled: dict[str, fkgen.CompiledFilter]) -> dict[str, dict[int, Score]]:
    """Score every filter on every trial."""
    records = {trial: read(trial) for trial in TRIALS}
    found = {
        name: {trial: score(run(each, record), record) for trial, record in records.items()}
        for name, each in compiled.items()
    }
    for name in ("imm", "ekf"):
        blind = {trial: without_rests(record) for trial, record in records.items()}
        found[f"{name} without rests"] = {
            trial: score(run(compiled[name], record), record) for trial, record in blind.items()
        }
    return {"vqf 2.1.2": {trial: Score(*both) for trial, both in VQF.items()}} | found


def ratio(scores: dict[int, Score]) -> float:
    """Mean of the trials over that of vqf, as it stands."""
    return sum(each.total for each in scores.values()) / sum(total for total, _ in VQF.values())


def draw(out: fkgen.Run, single: fkgen.Run, record: Record) -> Figure:
    """Draw what a magnet does to the sensor, to the modes and to the errors."""
    figure = Figure(figsize=(9.0, 9.5), layout="constrained")
    axes = figure.subplots(4, 1, sharex=True, height_ratios=(1.0, 1.2, 1.0, 1.3))
    draw_field(axes[0], record)
    draw_offset(axes[1], out, record)
    draw_modes(axes[2], out, record)
    draw_errors(axes[3], {"ekf": single, "imm": out}, record)
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
        axis.margins(x=0.0)
    axes[-1].set_xlabel("time (s)")
    return figure


def draw_field(axis: Axes, record: Record) -> None:
    """Draw the strength of the field."""
    parameters = content()["parameters"]
    strength = np.linalg.norm(record.y[:, FIELD], axis=1)
    axis.plot(record.t, strength, color=GREY, lw=0.8, label="measured")
    axis.axhline(np.hypot(*parameters.values()), color="black", lw=0.8, ls=":", label="the place")
    axis.set_ylim(0.0, 100.0)
    axis.set_ylabel("field (uT)")
    axis.set_title("A magnet is brought up, and stays attached to the sensor", loc="left")
    axis.legend(frameon=False, loc="upper left", ncols=2)


def draw_offset(axis: Axes, out: fkgen.Run, record: Record) -> None:
    """Draw the offset of the magnetometer, with two deviations."""
    for i, (name, colour) in enumerate(zip("xyz", (BLUE, ORANGE, GREEN), strict=True)):
        offset = out.filtered_state[:, 10 + i]
        spread = 2.0 * np.sqrt(out.filtered_covariance[:, 9 + i, 9 + i])
        axis.fill_between(record.t, offset - spread, offset + spread, color=colour, alpha=0.2, lw=0)
        axis.plot(record.t, offset, color=colour, lw=1.2, label=f"m_{name}")
    axis.set_ylabel("estimated offset (uT)")
    axis.legend(frameon=False, loc="center left", ncols=3)


def draw_modes(axis: Axes, out: fkgen.Run, record: Record) -> None:
    """Draw the posterior probabilities of the modes on top of each other."""
    colours = (LIGHT, RED, GREY)
    axis.stackplot(record.t, out.mode_probability.T, colors=colours, labels=MODES, lw=0)
    axis.set_ylim(0.0, 1.0)
    axis.set_ylabel("mode probability")
    axis.legend(loc="lower left", ncols=3, framealpha=0.9)


def draw_errors(axis: Axes, results: dict[str, fkgen.Run], record: Record) -> None:
    """Draw the angle between estimate and truth, where there is one."""
    scored = np.isfinite(record.truth[:, 0])
    for colour, (name, out) in zip((ORANGE, BLUE), results.items(), strict=True):
        angle = np.full(record.t.size, np.nan)
        angle[scored] = np.degrees(errors(out, record).magnitude())
        axis.plot(record.t, angle, color=colour, lw=1.0, label=name)
    axis.set_ylim(bottom=0.0)
    axis.set_ylabel("error (deg)")
    axis.legend(frameon=False, loc="upper left", ncols=2)


def other(data: Path, compiled: fkgen.CompiledFilter) -> None:
    """Score all trials of a folder, and the mean over ten first samples of their records."""
    print("| trial | as it stands | offset removed | means over ten first samples |")
    print("| --- | ---: | ---: | ---: |")
    for path in sorted(data.glob("broad_*.npz")):
        starts = [thinned(path, first) for first in range(0, EVERY, EVERY // 10)]
        scores = [score(run(compiled, record), record) for record in starts]
        total, turned = np.mean([[each.total, each.turned] for each in scores], axis=0)
        print(
            f"| {path.stem} | {scores[0].total:.2f} | {scores[0].turned:.2f} "
            f"| {total:.2f} / {turned:.2f} |"
        )


def main() -> None:
    """Print the scores, draw the figure, and fail where vqf is better."""
    parser = argparse.ArgumentParser(description="Filter the trials and score them.")
    parser.add_argument("--data", type=Path, help="a folder with other trials, broad_*.npz")
    arguments = parser.parse_args()
    if arguments.data:
        other(arguments.data, fkgen.build(fkgen.load(HERE / "spec.toml")))
        return
    compiled = filters()
    found = table(compiled)
    print("|  | " + " | ".join(f"{trial}" for trial in TRIALS) + " | mean / vqf |")
    print("| --- |" + " ---: |" * (len(TRIALS) + 1))
    for name, scores in found.items():
        cells = [f"{each.total:.2f} / {each.turned:.2f}" for each in scores.values()]
        print(f"| {name} | " + " | ".join(cells) + f" | {ratio(scores):.2f} |")
    record = read(SHOWN)
    figure = draw(run(compiled["imm"], record), run(compiled["ekf"], record), record)
    figure.savefig(HERE / "attitude.png", dpi=110, metadata={"Software": None})
    worse = [
        trial
        for trial, each in found["imm"].items()
        if each.total >= VQF[trial][0] or each.turned >= VQF[trial][1]
    ]
    if worse:
        raise SystemExit(f"vqf is better on {worse}")


if __name__ == "__main__":
    main()
