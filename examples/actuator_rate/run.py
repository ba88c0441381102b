"""Fit the motor's success rate and noises to simulated logs: ``python run.py``.

Prints the tables of the page and draws actuator_rate.png.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import fkgen

HERE = Path(__file__).resolve().parent
Floats = NDArray[np.floating[Any]]
TRUE = {"rate": 0.7, "torque_noise": 1e-3, "speed_noise": 1e-4}
LABELS = {"rate": "success rate", "torque_noise": "torque noise", "speed_noise": "speed noise"}
LOGS, SAMPLES, SEED = 200, 2000, 1  # 20 s each
VOLTAGE, HALF_PERIOD = 3.0, 100  # V, samples: to and fro, once in 2 s
SHOWN = 60  # logs in the figure
BLUE, ORANGE, GREY = "#1f5a94", "#d9741a", "#8a8a8a"


@dataclass(frozen=True)
class Found:
    """What is found in logs.

    Attributes
    ----------
    estimates, standard_errors : (M, 3) ndarray
    intervals : (M, 3, 2) ndarray
        Of 95 %.
    """

    estimates: Floats
    standard_errors: Floats
    intervals: Floats

    @property
    def holds(self) -> NDArray[np.bool_]:
        """(M, 3): whether an interval holds the truth."""
        true = np.array(list(TRUE.values()))
        low, high = np.moveaxis(self.intervals, -1, 0)
        return np.asarray((low <= true) & (true <= high))


def commands() -> Floats:
    """Voltages, (T, 1)."""
    sign = np.where(np.arange(SAMPLES) // HALF_PERIOD % 2, -1.0, 1.0)
    return VOLTAGE * sign[:, np.newaxis]


def logs(count: int = LOGS) -> Floats:
    """Speeds of so many logs, (M, T, 1), drawn with the true rate and noises."""
    spec = fkgen.load(HERE / "spec.toml")
    drawn = fkgen.simulate(spec, count, SAMPLES, SEED, commands(), params=TRUE)
    return drawn.y


def fitted(y: Floats) -> Found:
    """Fit every log by itself."""
    spec, u, rows = fkgen.load(HERE / "spec.toml"), commands(), []
    for log in y:
        fit = fkgen.fit(spec, log, u, estimate=tuple(TRUE))
        intervals = fit.interval(0.95)
        rows.append(
            [[fit.estimates[n], fit.standard_errors[n], *intervals[n]] for n in TRUE],
        )
    found = np.array(rows)
    return Found(found[..., 0], found[..., 1], found[..., 2:])


def draw(found: Found) -> Figure:
    """Draw the intervals of the first logs, and the truth."""
    figure = Figure(figsize=(9.0, 5.6), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True)
    at = np.arange(min(SHOWN, len(found.estimates)))
    for j, (axis, (name, true)) in enumerate(zip(axes, TRUE.items(), strict=True)):
        low, high = found.intervals[at, j].T
        right = found.holds[at, j]
        for chosen, colour in ((right, BLUE), (~right, ORANGE)):
            axis.vlines(at[chosen], low[chosen], high[chosen], color=colour, lw=1.4)
            axis.plot(at[chosen], found.estimates[at[chosen], j], ".", color=colour, ms=4)
        axis.axhline(true, color=GREY, lw=1.0)
        share = found.holds[:, j].mean()
        held = f"{share:.1%} of {len(found.estimates)} intervals hold the truth"
        axis.set_title(f"{LABELS[name]}: {held}", fontsize=9, loc="left")
        axis.spines[["top", "right"]].set_visible(False)
    axes[-1].set_xlabel("log")
    return figure


def main() -> None:
    """Print the tables and draw the figure."""
    y = logs()
    found = fitted(y)
    print("| log 0 | true | guessed | estimate | standard error | 95 % |")
    print("| --- | ---: | ---: | ---: | ---: | --- |")
    guessed = fkgen.load(HERE / "spec.toml").defaults
    for j, (name, true) in enumerate(TRUE.items()):
        low, high = found.intervals[0, j]
        numbers = (true, guessed[name], found.estimates[0, j], found.standard_errors[0, j])
        cells = " | ".join(f"{each:.3g}" for each in numbers)
        print(f"| {LABELS[name]} | {cells} | {low:.3g} to {high:.3g} |")
    print(f"\n| {len(y)} logs | mean | spread | standard error | intervals that hold the truth |")
    print("| --- | ---: | ---: | ---: | ---: |")
    for j, name in enumerate(TRUE):
        mean, spread = found.estimates[:, j].mean(), found.estimates[:, j].std()
        error = np.nanmedian(found.standard_errors[:, j])
        print(
            f"| {LABELS[name]} | {mean:.3g} | {spread:.3g} | {error:.3g} |"
            f" {found.holds[:, j].mean():.1%} |"
        )
    figure = draw(found)
    figure.savefig(HERE / "actuator_rate.png", dpi=110, metadata={"Software": None})


if __name__ == "__main__":
    main()
