"""Give the fixes of the data set 0.2 s late: ``python prepare.py --data FOLDER`` writes record.csv.

The instants are those of the barometer. A fix is measured at the first instant that is not before
it, and comes with the first one that is 0.2 s later or more; the delay is counted in instants.
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
ROWS = ("gps_east", "gps_north", "gps_v_east", "gps_v_north")
LATE, UNTIL = 0.2, 115.0  # s; later on the receiver of this flight is wrong
Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Record:
    """One flight, T instants.

    Attributes
    ----------
    t : (T,) ndarray
        Time, s.
    y : (T, 4) ndarray
        Fixes as they come: m, m, m/s, m/s; NaN where there is none.
    delay : (T,) ndarray
        Instants since the fix was measured; 0 where there is none.
    """

    t: Floats
    y: Floats
    delay: Floats

    @property
    def in_time(self) -> Floats:
        """The same fixes at the instants at which they were measured."""
        y = np.full_like(self.y, np.nan)
        come = np.flatnonzero(np.isfinite(self.y[:, 0]))
        y[come - self.delay[come].astype(int)] = self.y[come]
        return y

    def delays(self) -> dict[str, Floats]:
        """The run-time parameters of the filter."""
        return {f"delay_{row}": self.delay for row in ROWS}

    @property
    def dt(self) -> Floats:
        """Time to the next instant, s; the last one repeats the one before it."""
        steps = np.diff(self.t)
        return np.append(steps, steps[-1])


def merged(folder: Path) -> Record:
    """Merge the instants of the barometer and the fixes of the data set."""
    baro, gps = (
        np.genfromtxt(folder / name, delimiter=",", names=True)
        for name in ("imu_baro.csv", "gps.csv")
    )
    t = baro["t_s"][baro["t_s"] < UNTIL]
    gps = gps[gps["t_s"] + LATE <= t[-1]]
    measured, come = (np.searchsorted(t, gps["t_s"] + wait) for wait in (0.0, LATE))
    if np.any(np.diff(come) == 0):
        raise SystemExit("two fixes at one instant")
    y, delay = np.full((t.size, len(ROWS)), np.nan), np.zeros(t.size)
    y[come] = np.column_stack([gps[name] for name in ("east_m", "north_m", "ve", "vn")])
    delay[come] = come - measured
    return Record(t, y, delay)


def read() -> Record:
    """Read what `make` wrote."""
    t, *columns = np.genfromtxt(HERE / "record.csv", delimiter=",", skip_header=1).T
    return Record(t, np.column_stack(columns[:4]), columns[4])


def make(data: Path, target: Path) -> Record:
    """Write record.csv, a column per name of the specification; an empty field is missing."""
    flight, text = merged(data), StringIO()
    late = np.tile(flight.delay[:, np.newaxis], len(ROWS))
    rows = np.column_stack([flight.t, flight.y, late])
    formats = ["%.4f"] + ["%.3f"] * len(ROWS) + ["%d"] * len(ROWS)
    header = ",".join(("t", *ROWS, *flight.delays()))
    np.savetxt(text, rows, formats, delimiter=",", header=header, comments="")
    (target / "record.csv").write_text(text.getvalue().replace("nan", ""), encoding="utf-8")
    return flight


def main() -> None:
    """Write record.csv."""
    parser = argparse.ArgumentParser(description="Write record.csv.")
    parser.add_argument("--data", type=Path, required=True, help="the folder of the data set")
    flight = make(parser.parse_args().data, HERE)
    late = flight.delay[flight.delay > 0]
    print(f"record.csv: {flight.t.size} instants, {late.size} fixes")
    print(f"they come {late.min():.0f} to {late.max():.0f} instants late")


if __name__ == "__main__":
    main()
