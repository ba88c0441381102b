"""A slow drift of one wheel put into the drive of car_speed: ``python drift.py``.

Prints the tables of the page and draws wheel_drift.png. The recording and its preparation are those
of ../car_speed; nothing is copied.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from importlib import util
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.stats import chi2

import fkgen

HERE = Path(__file__).resolve().parent
Floats = NDArray[np.floating[Any]]
WHEELS = ("front left", "front right", "rear left", "rear right")
RATES = (0.0005, 0.001, 0.002, 0.004)  # change of scale per second
SHOWN, SEED, SEEDS = 0.002, 1, 20
EARLIEST, LATEST = 12.0, 25.0  # s, when a drift begins
SETTLED = 5.0  # s, before that the filter is still finding the speed
COLOURS = ("#1f5a94", "#b3261e", "#3f8f4f", "#d9741a")
BLUE, GREY = "#1f5a94", "#8a8a8a"


@dataclass(frozen=True)
class Drift:
    """What happens to one wheel.

    Attributes
    ----------
    wheel : int
        Which one, 0 to 3.
    onset : float
        When it begins, s.
    rate : float
        Change of its scale per second, of either sign.
    """

    wheel: int
    onset: float
    rate: float

    @classmethod
    def drawn(cls, rate: float, seed: int) -> Drift:
        """Draw wheel, onset and sign."""
        rng = np.random.default_rng(seed)
        sign = float(rng.choice([-1.0, 1.0]))
        return cls(int(rng.integers(4)), float(rng.uniform(EARLIEST, LATEST)), sign * rate)

    def scale(self, t: Floats) -> Floats:
        """Reading over true reading."""
        return np.asarray(1.0 + self.rate * np.maximum(0.0, t - self.onset))


@dataclass(frozen=True)
class Outcome:
    """One filter over one drive.

    Attributes
    ----------
    error : (E,) ndarray
        Filtered speed minus reference where there is a reference, m/s.
    statistic : (W, 4) ndarray
        zeta of every wheel at every end of a window.
    rejected : (W, 4) ndarray of bool
    ends : (W,) ndarray
        Times of these, s. W = 0 for kf.
    """

    error: Floats
    statistic: Floats
    rejected: NDArray[np.bool_]
    ends: Floats


def preparation() -> ModuleType:
    """The script ../car_speed/prepare.py as a module."""
    name = "car_speed_preparation"
    place = HERE.parent / "car_speed" / "prepare.py"
    spec = util.spec_from_file_location(name, place)
    if spec is None or spec.loader is None:
        raise SystemExit(f"{place} is missing")
    module = util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


class Car:
    """The recorded drive, and the two filters that are compared on it."""

    def __init__(self) -> None:
        prepare = preparation()
        self.drive, self.reference = prepare.read(), prepare.reference()
        self.t: Floats = self.drive.t
        self.covered: NDArray[np.bool_] = self.t <= self.reference[0][-1]
        spec = fkgen.load(HERE / "spec.toml")
        soft = spec.faults.soft
        if soft is None:
            raise SystemExit("spec.toml has no [faults.soft]")
        self.window, self.false_alarm = soft.window, soft.false_alarm
        plain = spec.to_dict() | {"name": "plain", "faults": {}, "filter": {"family": "kf"}}
        self.dfcf, self.kf = fkgen.build(spec), fkgen.build(fkgen.Spec.from_dict(plain))

    def filtered(self, family: str, drift: Drift | None) -> Outcome:
        """Filter the drive with one wheel drifting, or none."""
        y = self.drive.y.copy()
        if drift is not None:
            y[:, drift.wheel] *= drift.scale(self.t)
        tested = family == "dfcf"
        car = self.dfcf if tested else self.kf
        keep = ["filtered_state", *(["test_statistic", "fault_declared"] if tested else [])]
        run = car.run(y, self.drive.a_fwd[:, None], {"dt": self.drive.dt}, keep=keep)
        speed = np.interp(self.t[self.covered], *self.reference)
        ends = slice(self.window, None, self.window) if tested else slice(0, 0)
        none = np.zeros((len(self.t), 4))
        return Outcome(
            error=run.filtered_state[self.covered, 0] - speed,
            statistic=(run.test_statistic if tested else none)[ends],
            rejected=(run.fault_declared if tested else none)[ends] > 0.0,
            ends=self.t[ends],
        )

    def rms(self, outcome: Outcome, begin: float) -> float:
        """Root mean square error from a time on, m/s."""
        late = self.t[self.covered] >= begin
        return float(np.sqrt(np.mean(outcome.error[late] ** 2)))

    def detection(self, outcome: Outcome, drift: Drift) -> float:
        """When the wheel is rejected first after its drift began, s; NaN if never."""
        found = outcome.ends[outcome.rejected[:, drift.wheel] & (outcome.ends > drift.onset)]
        return float(found[0]) if found.size else float("nan")


def table(car: Car) -> list[tuple[float, ...]]:
    """Per rate: found, seconds, scale error then, two errors, and healthy windows rejected."""
    rows: list[tuple[float, ...]] = []
    for rate in RATES:
        cells = []
        for seed in range(SEEDS):
            drift = Drift.drawn(rate, seed)
            pair, single = car.filtered("dfcf", drift), car.filtered("kf", drift)
            at = car.detection(pair, drift)
            healthy = np.delete(pair.rejected, drift.wheel, axis=1)
            errors = car.rms(single, drift.onset), car.rms(pair, drift.onset)
            cells.append((at - drift.onset, *errors, healthy.mean()))
        delay, single_rms, pair_rms, healthy_rate = np.array(cells).T
        found = ~np.isnan(delay)
        middle = float(np.median(delay[found])) if found.any() else float("nan")
        means = (float(single_rms.mean()), float(pair_rms.mean()), float(healthy_rate.mean()))
        rows.append((rate, float(found.mean()), middle, rate * middle, *means))
    return rows


def draw(car: Car, drift: Drift) -> Figure:
    """Draw the drift, the statistics of the wheels, the verdicts and the errors."""
    pair, single = car.filtered("dfcf", drift), car.filtered("kf", drift)
    figure = Figure(figsize=(9.0, 9.5), layout="constrained")
    axes = figure.subplots(4, 1, sharex=True, height_ratios=(1.0, 2.2, 1.0, 2.0))
    axes[0].plot(car.t, 100.0 * (drift.scale(car.t) - 1.0), color=COLOURS[drift.wheel])
    axes[0].set_ylabel("scale error (%)")
    title = f"The {WHEELS[drift.wheel]} wheel drifts from {drift.onset:.1f} s on"
    axes[0].set_title(title, loc="left")
    draw_statistics(axes[1], car, pair)
    draw_verdicts(axes[2], pair)
    at = car.t[car.covered]
    axes[3].plot(at, single.error, color=GREY, lw=0.8, label="kf: every wheel, always")
    axes[3].plot(at, pair.error, color=BLUE, lw=0.8, label="dfcf: wheels that pass")
    axes[3].axhline(0.0, color="black", lw=0.6)
    axes[3].set(ylabel="filter - reference (m/s)", xlabel="time (s)", ylim=(-0.7, 0.7))
    axes[3].legend(frameon=False, ncols=2, loc="upper left")
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
        axis.axvline(drift.onset, color="black", lw=0.8, ls=":")
        axis.set_xlim(0.0, 60.0)
    return figure


def draw_statistics(axis: Axes, car: Car, pair: Outcome) -> None:
    """Draw zeta of every wheel over the threshold of two degrees of freedom."""
    for wheel, (name, colour) in enumerate(zip(WHEELS, COLOURS, strict=True)):
        values = np.maximum(pair.statistic[:, wheel], 1e-3)
        axis.semilogy(pair.ends, values, ".-", color=colour, lw=0.7, ms=4, label=name)
    axis.axhline(chi2.isf(car.false_alarm, 2), color="black", lw=0.8, ls="--", label="threshold")
    axis.set_ylabel("test statistic")
    axis.set_ylim(1e-3, 1e4)
    axis.legend(frameon=False, ncols=5, loc="upper left")


def draw_verdicts(axis: Axes, pair: Outcome) -> None:
    """Draw a mark per rejected window and wheel."""
    times = [pair.ends[pair.rejected[:, wheel]] for wheel in range(4)]
    axis.eventplot(times, lineoffsets=range(4), colors=COLOURS, linelengths=0.7, linewidths=1.6)
    axis.set_yticks(range(4), WHEELS)
    axis.set_ylim(3.6, -0.6)
    axis.set_title("windows in which a wheel is rejected", loc="left", fontsize="medium")


def main() -> None:
    """Print both tables and draw the figure."""
    car = Car()
    for family in ("kf", "dfcf"):
        quiet = car.filtered(family, None)
        text = f"{family}, no drift: rms {car.rms(quiet, SETTLED):.3f} m/s from {SETTLED:g} s on"
        share = f", {int(quiet.rejected.sum())} of {quiet.rejected.size} verdicts reject"
        print(text + (share if quiet.rejected.size else ""))
    print("| %/s | isolated | after (s) | at (%) | kf rms | dfcf rms | healthy rejected |")
    print("| ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    for rate, found, delay, scale, single, pair, healthy in table(car):
        cells = f"{100 * rate:.2f} | {found:.0%} | {delay:.1f} | {100 * scale:.1f}"
        print(f"| {cells} | {single:.3f} | {pair:.3f} | {healthy:.1%} |")
    figure = draw(car, Drift.drawn(SHOWN, SEED))
    figure.savefig(HERE / "wheel_drift.png", dpi=110, metadata={"Software": None})


if __name__ == "__main__":
    main()
