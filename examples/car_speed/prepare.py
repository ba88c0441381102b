"""Turn the recorded files into one time series: ``python prepare.py`` writes record.csv.

Every time stamp of every sensor becomes an instant of the record; a sensor without a sample at an
instant is missing there. No sample is moved in time and none is merged with another, which a grid
of IMU instants could not avoid: 353 of its intervals hold two wheel messages. The price is an
irregular step, 0.1 to 9.7 ms, and the filter takes it: ``dt`` is a run-time parameter.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

HERE = Path(__file__).resolve().parent
WHEELS = ("v_fl", "v_fr", "v_rl", "v_rr")
OUTPUTS = ("wheel_fl", "wheel_fr", "wheel_rl", "wheel_rr", "ublox", "qcom")
DROPOUT = 0.5  # share of the wheel samples that record.csv lacks
SEED = 1
Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Record:
    """One drive on one time axis of T instants.

    Attributes
    ----------
    t : (T,) ndarray
        Time, s.
    dt : (T,) ndarray
        Time to the next instant, s; 0 at the last one.
    a_fwd : (T,) ndarray
        Latest forward acceleration known at each instant, m/s2.
    y : (T, 6) ndarray
        Measurements in the order of `OUTPUTS`, m/s; NaN where there is no sample.
    lost : (T, 4) ndarray of bool
        Wheel samples that were recorded and then removed.
    """

    t: Floats
    dt: Floats
    a_fwd: Floats
    y: Floats
    lost: NDArray[np.bool_]


def table(name: str) -> dict[str, Floats]:
    """Read the numeric columns of one file of the data folder."""
    with (HERE / "data" / name).open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    return {
        key: np.array([float(row[key]) for row in rows]) for key in rows[0] if key != "receiver"
    }


def receiver(name: str) -> tuple[Floats, Floats]:
    """Read the times (s) and speeds (m/s) of one satellite receiver."""
    with (HERE / "data" / "gnss.csv").open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["receiver"] == name]
    return np.array([float(r["t_s"]) for r in rows]), np.array([float(r["speed"]) for r in rows])


def reference() -> tuple[Floats, Floats]:
    """Read times (s) and speeds (m/s) of the reference; nothing but the error is made of them."""
    truth = table("truth.csv")
    return truth["t_s"], truth["speed"]


def record(dropout: float, seed: int = SEED) -> Record:
    """Merge the sensors, then remove wheel samples.

    Parameters
    ----------
    dropout : float
        Probability that a wheel sample is removed, independently for each wheel and message.
    seed : int
        Seed of the removal.

    Returns
    -------
    Record
        It begins at the first measurement of a speed that is left; a filter knows nothing before.
    """
    wheels, imu = table("wheels.csv"), table("imu.csv")
    receivers = [receiver("ublox"), receiver("qcom")]
    t = np.unique(np.concatenate([wheels["t_s"], imu["t_s"], *(times for times, _ in receivers)]))

    gone = np.random.default_rng(seed).random((wheels["t_s"].size, 4)) < dropout
    speeds = np.stack([wheels[name] for name in WHEELS], axis=1)
    rows = np.searchsorted(t, wheels["t_s"])
    y = np.full((t.size, 6), np.nan)
    y[rows, :4] = np.where(gone, np.nan, speeds)
    for column, (times, speed) in enumerate(receivers, start=4):
        y[np.searchsorted(t, times), column] = speed
    lost = np.zeros((t.size, 4), dtype=bool)
    lost[rows] = gone

    latest = np.searchsorted(imu["t_s"], t, side="right") - 1
    a_fwd = imu["a_fwd"][np.maximum(latest, 0)]
    dt = np.round(np.append(np.diff(t), 0.0), 4)  # the stamps have four decimals
    first = int(np.flatnonzero(np.isfinite(y).any(axis=1))[0])
    return Record(t[first:], dt[first:], a_fwd[first:], y[first:], lost[first:])


def wheel_scale(wheels: tuple[str, ...], until: float = 60.0) -> tuple[float, float]:
    """Calibrate the mean of some wheels against the u-blox receiver.

    The receiver is late, which biases a fit while the car accelerates; so the delay is fitted too.

    Parameters
    ----------
    wheels : tuple of str
        Columns of wheels.csv.
    until : float
        End of the stretch used, s.

    Returns
    -------
    scale, delay : float
        ``ublox(t)`` is fitted best by ``scale * wheel(t - delay)``; delay in s, to 0.01 s.
    """
    data, (times, speed) = table("wheels.csv"), receiver("ublox")
    mean = np.mean([data[name] for name in wheels], axis=0)
    use = (times > 0.6) & (times < until)  # 0.6 s: the record must reach back by any delay tried
    best = (np.inf, 1.0, 0.0)
    for delay in np.arange(0.0, 0.5, 0.01):
        wheel = np.interp(times[use] - delay, data["t_s"], mean)
        scale = float(speed[use] @ wheel / (wheel @ wheel))
        best = min(best, (float(np.std(speed[use] - scale * wheel)), scale, float(delay)))
    return best[1], best[2]


def write(path: Path, drive: Record) -> None:
    """Write a record as CSV, a column per name of the specification; an empty field is missing."""
    decimals = (5, 5, 5, 5, 4, 4)  # as recorded, so that reading the file gives the same numbers
    with path.open("w", encoding="utf-8", newline="") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(["t_s", "dt", "a_fwd", *OUTPUTS])
        for t, dt, a_fwd, y in zip(drive.t, drive.dt, drive.a_fwd, drive.y, strict=True):
            fields = ["" if np.isnan(v) else f"{v:.{n}f}" for v, n in zip(y, decimals, strict=True)]
            out.writerow([f"{t:.4f}", f"{dt:.4f}", f"{a_fwd:.4f}", *fields])


def main() -> None:
    """Print the calibration of the wheels and write record.csv."""
    for axle, wheels in (("front", WHEELS[:2]), ("rear", WHEELS[2:])):
        scale, delay = wheel_scale(wheels)
        early, _ = wheel_scale(wheels, until=30.0)
        print(f"{axle}: scale {scale:.4f} (first half alone: {early:.4f}), delay {delay:.2f} s")
    drive = record(DROPOUT)
    write(HERE / "record.csv", drive)
    kept = int(np.isfinite(drive.y[:, :4]).sum())
    print(f"record.csv: {drive.t.size} instants, {kept} wheel samples, {drive.lost.sum()} removed")


if __name__ == "__main__":
    main()
