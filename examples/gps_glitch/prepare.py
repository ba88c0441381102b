"""Turn the data set into one time series: ``python prepare.py --data FOLDER`` writes record.csv.

The instants are those of the barometer. Each GPS sample goes to the first instant that is not
before it, once; at all other instants the GPS is missing. Between instants lie 25 to 132 ms, and
the filter takes that time as the run-time parameter ``dt``.
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
COLUMNS = ("t_s", "dt", "baro", "gps_height", "gps_climb")
ORDINARY = 50.0  # s of the flight whose scatter sets the noise of the sensors
Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Record:
    """One flight on the time axis of the barometer, T instants.

    Attributes
    ----------
    t : (T,) ndarray
        Time, s.
    dt : (T,) ndarray
        Time to the next instant, s; 0 at the last one.
    y : (T, 3) ndarray
        Height of the barometer (m), height (m) and vertical speed (m/s, up) of the GPS; NaN where
        there is no sample.
    """

    t: Floats
    dt: Floats
    y: Floats

    @property
    def gps(self) -> NDArray[np.intp]:
        """Instants with a GPS sample."""
        return np.flatnonzero(np.isfinite(self.y[:, 1]))


def merged(folder: Path) -> Record:
    """Merge barometer and GPS of the data set."""
    baro, gps = (
        np.genfromtxt(folder / name, delimiter=",", names=True)
        for name in ("imu_baro.csv", "gps.csv")
    )
    t = baro["t_s"]
    rows = np.searchsorted(t, gps["t_s"])
    if np.any(np.diff(rows) == 0) or rows[-1] == t.size:
        raise SystemExit("two GPS samples at one instant, or one after the last")
    y = np.full((t.size, 3), np.nan)
    y[:, 0] = baro["baro_alt_m"]
    y[rows, 1], y[rows, 2] = gps["alt_m"], -gps["vd"]
    dt = np.round(np.append(np.diff(t), 0.0), 4)  # the stamps have four decimals
    return Record(t, dt, y)


def scatter(flight: Record) -> Floats:
    """Standard deviations of the three measurements in the first seconds of the flight.

    The barometer against its own mean over a second; the GPS against that mean and its slope.

    Returns
    -------
    (3,) ndarray
        m, m, m/s.
    """
    half = 18  # instants: a second is 37 of them
    window = np.ones(2 * half + 1) / (2 * half + 1)
    inner = slice(half, -half)
    t, y = flight.t[inner], flight.y[inner]
    height = np.convolve(flight.y[:, 0], window, mode="valid")
    errors = y - np.column_stack([height, height, np.gradient(height, t)])
    return np.nanstd(errors[t < ORDINARY], axis=0)


def read() -> Record:
    """Read what `make` wrote."""
    t, dt, *y = np.genfromtxt(HERE / "record.csv", delimiter=",", skip_header=1).T
    return Record(t, dt, np.column_stack(y))


def make(data: Path, target: Path) -> Record:
    """Write record.csv, a column per name of the specification; an empty field is missing."""
    flight, text = merged(data), StringIO()
    rows, formats = np.column_stack([flight.t, flight.dt, flight.y]), ["%.4f"] * 2 + ["%.3f"] * 3
    np.savetxt(text, rows, formats, delimiter=",", header=",".join(COLUMNS), comments="")
    (target / "record.csv").write_text(text.getvalue().replace("nan", ""), encoding="utf-8")
    return flight


def main() -> None:
    """Write record.csv and print the scatter of the sensors."""
    parser = argparse.ArgumentParser(description="Write record.csv.")
    parser.add_argument("--data", type=Path, required=True, help="the folder of the data set")
    flight = make(parser.parse_args().data, HERE)
    baro, height, climb = scatter(flight)
    print(f"record.csv: {flight.t.size} instants, {flight.gps.size} with a GPS sample")
    print(f"first {ORDINARY:.0f} s: barometer {baro:.2f} m, GPS {height:.2f} m, {climb:.2f} m/s")


if __name__ == "__main__":
    main()
