"""Thin trials of the data set: ``python prepare.py --data FOLDER`` writes record_16.csv and so on.

The sensor has 286 samples a second, and the errors of its magnetometer last for many of them. So a
row of a record stands for 30 samples: `u` is what gyroscope and accelerometer integrate to over
them, `y` what the magnetometer reads at the first.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

HERE = Path(__file__).resolve().parent
TRIALS = (16, 30, 32, 35)
EVERY = 30  # samples a row
AROUND, SHORT = 0.5, 0.1  # s: at rest is who is so for half a second before and after
STEADY = {"imu_gyr": np.deg2rad(1.0), "imu_acc": 0.5}  # a short mean from the long one, rad/s, m/s2
BIAS = np.deg2rad(2.0)  # no gyroscope at rest reads more, rad/s
COLUMNS = (
    "t_s,turn_x,turn_y,turn_z,push_x,push_y,push_z,still_e,still_n,still_u,mag_x,mag_y,mag_z,"
    "rest_x,rest_y,rest_z,true_w,true_x,true_y,true_z"
)
FORMATS = ["%.3f"] + ["%.6f"] * 3 + ["%.5f"] * 3 + ["%.0f"] * 3 + ["%.2f"] * 3
FORMATS += ["%.0f"] * 3 + ["%.5f"] * 4
Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Record:
    """One trial, T rows.

    Attributes
    ----------
    t : (T,) ndarray
        Time, s.
    u : (T, 6) ndarray
        Rotation vector (rad) and gain of speed (m/s) from a row to the next, in body axes of the
        row; gravity is in the latter. The last row repeats the rotation of the one before.
    y : (T, 9) ndarray
        0, for a hand comes back; the field (uT); 0 where the sensor rests, else NaN.
    truth : (T, 4) ndarray
        Quaternion (w, x, y, z), body to world, where the benchmark scores; else NaN.
    """

    t: Floats
    u: Floats
    y: Floats
    truth: Floats


def integrated(gyro: Floats, force: Floats, dt: float) -> Floats:
    """Sum up what leads from each row to the next, in body axes of the row.

    The rotation into sample i is that of ``gyro[i]``; ``force[i]`` acts from sample i to i + 1.

    Returns
    -------
    (T, 6) ndarray
    """
    rows = (len(gyro) - 1) // EVERY
    turned = Rotation.identity(rows)
    speed = np.zeros((rows, 3))
    for at in np.arange(rows * EVERY).reshape(rows, EVERY).T:
        speed += turned.apply(force[at]) * dt
        turned = turned * Rotation.from_rotvec(gyro[at + 1] * dt)
    steps = np.column_stack([turned.as_rotvec(), speed])
    return np.vstack([steps, np.append(steps[-1, :3], np.zeros(3))])


def around(values: Floats, half: int) -> Floats:
    """Mean of each sample and of up to `half` samples on either side."""
    n = len(values)
    total = np.vstack([np.zeros(values.shape[1]), np.cumsum(values, axis=0)])
    last, first = (np.clip(np.arange(n) + shift, 0, n) for shift in (half + 1, -half))
    return np.asarray((total[last] - total[first]) / (last - first)[:, None])


def resting(trial: dict[str, Floats], rate: float) -> NDArray[np.bool_]:
    """Say which samples lie in a rest. That takes half a second to know."""
    short, long = round(SHORT * rate) // 2, round(AROUND * rate)
    moves = (np.abs(around(trial["imu_gyr"], long)) > BIAS).any(axis=1)
    for name, limit in STEADY.items():
        apart = np.abs(around(trial[name], short) - around(trial[name], long))
        moves |= (apart > limit).any(axis=1)
    return around(moves[:, None].astype(float), long)[:, 0] == 0.0


def thinned(path: Path, first: int = 0) -> Record:
    """Make the record of one trial of the benchmark, from a sample on."""
    with np.load(path) as file:
        rate = float(file["sampling_rate"].item())
        trial = {
            name: np.asarray(file[name][first:], dtype=float)
            for name in ("imu_gyr", "imu_acc", "imu_mag", "movement", "opt_quat")
        }
    u = integrated(trial["imu_gyr"], trial["imu_acc"], 1.0 / rate)
    at = np.arange(len(u)) * EVERY
    rest = np.where(resting(trial, rate)[at, None], np.zeros(3), np.nan)
    y = np.column_stack([np.zeros((len(u), 3)), trial["imu_mag"][at], rest])
    truth = np.where(trial["movement"] > 0.5, trial["opt_quat"], np.nan)[at]
    return Record(at / rate, u, y, truth)


def read(trial: int) -> Record:
    """Read what `make` wrote."""
    table = np.genfromtxt(HERE / f"record_{trial}.csv", delimiter=",", skip_header=1)
    return Record(table[:, 0], table[:, 1:7], table[:, 7:16], table[:, 16:])


def make(data: Path, target: Path, trials: Iterable[int] = TRIALS) -> None:
    """Write a record per trial, a column per name of the spec; an empty field is missing."""
    for trial in trials:
        record, text = thinned(data / f"broad_{trial}.npz"), StringIO()
        rows = np.column_stack([record.t, record.u, record.y, record.truth])
        np.savetxt(text, rows, FORMATS, delimiter=",", header=COLUMNS, comments="")
        written = text.getvalue().replace("nan", "")
        (target / f"record_{trial}.csv").write_text(written, encoding="utf-8")


def main() -> None:
    """Write the records and say what is in them."""
    parser = argparse.ArgumentParser(description="Write the records of the four trials.")
    parser.add_argument("--data", type=Path, required=True, help="the folder of the data set")
    make(parser.parse_args().data, HERE)
    for trial in TRIALS:
        record = read(trial)
        rest, scored = (np.isfinite(each[:, -1]) for each in (record.y, record.truth))
        print(
            f"record_{trial}.csv: {record.t.size} rows, at rest {rest.mean():.0%}, "
            f"scored {scored.mean():.0%}, both {np.sum(rest & scored)} rows"
        )


if __name__ == "__main__":
    main()
