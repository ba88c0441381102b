"""Turn the files of the data set into one time series: ``python prepare.py --data FOLDER``.

Every time stamp of every sensor becomes an instant of the record; a sensor without a sample at an
instant is missing there. No sample is moved in time and none is merged with another, which a grid
of IMU instants could not avoid: 353 of its intervals hold two wheel messages. The price is an
irregular step, 0.1 to 9.7 ms, and the filter takes it: ``dt`` is a run-time parameter.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

HERE = Path(__file__).resolve().parent
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
    lost : (T, 4) ndarray
        Wheel samples that were recorded and then removed, m/s; NaN elsewhere.
    """

    t: Floats
    dt: Floats
    a_fwd: Floats
    y: Floats
    lost: Floats

    def without(self, dropout: float, seed: int = SEED) -> Record:
        """Remove wheel samples from a complete record.

        Parameters
        ----------
        dropout : float
            Probability that a wheel sample is removed, independently for each wheel and message.
        seed : int
            Seed of the removal.

        Returns
        -------
        Record
            It begins at the first measurement that is left; a filter knows nothing before.
        """
        messages = np.flatnonzero(np.isfinite(self.y[:, 0]))
        gone = np.zeros((self.t.size, 4), dtype=bool)
        gone[messages] = np.random.default_rng(seed).random((messages.size, 4)) < dropout
        wheels = self.y[:, :4]
        y = np.column_stack([np.where(gone, np.nan, wheels), self.y[:, 4:]])
        first = int(np.flatnonzero(np.isfinite(y).any(axis=1))[0])
        lost = np.where(gone, wheels, np.nan)
        return Record(*(each[first:] for each in (self.t, self.dt, self.a_fwd, y, lost)))


def merged(folder: Path) -> Record:
    """Merge the sensors of the data set; the record begins at the first measured speed."""
    wheels, imu, gnss = (columns(folder / f"{name}.csv") for name in ("wheels", "imu", "gnss"))
    receivers = [gnss[gnss["receiver"] == name] for name in OUTPUTS[4:]]
    t = np.unique(np.concatenate([each["t_s"] for each in (wheels, imu, *receivers)]))
    y = np.full((t.size, 6), np.nan)
    y[np.searchsorted(t, wheels["t_s"]), :4] = np.column_stack(
        [wheels[name] for name in ("v_fl", "v_fr", "v_rl", "v_rr")]
    )
    for column, samples in enumerate(receivers, start=4):
        y[np.searchsorted(t, samples["t_s"]), column] = samples["speed"]
    latest = np.searchsorted(imu["t_s"], t, side="right") - 1
    a_fwd = imu["a_fwd"][np.maximum(latest, 0)]
    dt = np.round(np.append(np.diff(t), 0.0), 4)  # the stamps have four decimals
    return Record(t, dt, a_fwd, y, np.full((t.size, 4), np.nan)).without(0.0)


def columns(path: Path) -> NDArray[Any]:
    """Read a file of the data set; its columns have names."""
    return np.genfromtxt(path, delimiter=",", names=True, dtype=None, encoding="utf-8")


def read() -> Record:
    """Read the complete record: record.csv, and from lost.csv what it lacks."""
    record, lost = (
        np.genfromtxt(HERE / name, delimiter=",", skip_header=1)
        for name in ("record.csv", "lost.csv")
    )
    t, dt, a_fwd = record[:, :3].T
    wheels = np.full((t.size, 4), np.nan)
    wheels[np.searchsorted(t, lost[:, 0])] = lost[:, 1:]
    wheels = np.where(np.isnan(wheels), record[:, 3:7], wheels)
    y = np.column_stack([wheels, record[:, 7:]])
    return Record(t, dt, a_fwd, y, np.full((t.size, 4), np.nan))


def reference() -> Floats:
    """Read times (s) and speeds (m/s) of the reference; nothing but the error is made of them."""
    return np.loadtxt(HERE / "reference.csv", delimiter=",", skiprows=1).T


def wheel_scale(drive: Record, axle: slice, until: float = 60.0) -> tuple[float, float]:
    """Calibrate the mean of two wheels against the u-blox receiver.

    The receiver is late, which biases a fit while the car accelerates; so the delay is fitted too.

    Parameters
    ----------
    drive : Record
        A complete one.
    axle : slice
        Columns of y.
    until : float
        End of the stretch used, s.

    Returns
    -------
    scale, delay : float
        ``ublox(t)`` is fitted best by ``scale * wheel(t - delay)``; delay in s, to 0.01 s.
    """
    sampled = np.isfinite(drive.y)
    mean = np.mean(drive.y[sampled[:, 0], axle], axis=1)
    # 0.6 s: the record must reach back by any delay tried
    use = sampled[:, 4] & (drive.t > 0.6) & (drive.t < until)
    times, speed = drive.t[use], drive.y[use, 4]
    best = (np.inf, 1.0, 0.0)
    for delay in np.arange(0.0, 0.5, 0.01):
        wheel = np.interp(times - delay, drive.t[sampled[:, 0]], mean)
        scale = float(speed @ wheel / (wheel @ wheel))
        best = min(best, (float(np.std(speed - scale * wheel)), scale, float(delay)))
    return best[1], best[2]


def write(path: Path, names: tuple[str, ...], decimals: tuple[int, ...], *table: Floats) -> None:
    """Write columns as CSV; an empty field is missing."""
    text = StringIO()
    rows, formats = np.column_stack(table), [f"%.{n}f" for n in decimals]
    np.savetxt(text, rows, formats, delimiter=",", header=",".join(names), comments="")
    path.write_text(text.getvalue().replace("nan", ""), encoding="utf-8")


def make(data: Path, target: Path) -> Record:
    """Write record.csv, lost.csv and reference.csv, with the decimals of the data set."""
    drive = merged(data).without(DROPOUT)
    names = ("t_s", "dt", "a_fwd", *OUTPUTS)
    decimals = (4, 4, 4, 5, 5, 5, 5, 4, 4)
    write(target / "record.csv", names, decimals, drive.t, drive.dt, drive.a_fwd, drive.y)
    some = np.isfinite(drive.lost).any(axis=1)
    names, decimals = ("t_s", *OUTPUTS[:4]), (4, 5, 5, 5, 5)
    write(target / "lost.csv", names, decimals, drive.t[some], drive.lost[some])
    truth = columns(data / "truth.csv")
    write(target / "reference.csv", ("t_s", "speed"), (4, 4), truth["t_s"], truth["speed"])
    return drive


def main() -> None:
    """Write the records and print the calibration of the wheels."""
    parser = argparse.ArgumentParser(description="Write record.csv, lost.csv and reference.csv.")
    parser.add_argument("--data", type=Path, required=True, help="the folder of the data set")
    drive = make(parser.parse_args().data, HERE)
    kept, lost = (int(np.isfinite(each).sum()) for each in (drive.y[:, :4], drive.lost))
    print(f"record.csv: {drive.t.size} instants, {kept} wheel samples, {lost} removed")
    complete = read()
    for name, axle in (("front", slice(2)), ("rear", slice(2, 4))):
        scale, delay = wheel_scale(complete, axle)
        early, _ = wheel_scale(complete, axle, until=30.0)
        print(f"{name}: scale {scale:.4f} (first half alone: {early:.4f}), delay {delay:.2f} s")


if __name__ == "__main__":
    main()
