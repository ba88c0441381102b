"""Turn the reports of a ship into one time series: ``python prepare.py`` writes record.csv.

Every report is an instant. Between instants that are more than 5 s apart come empty ones, because
the chain of the modes moves once per instant. Three stretches of track A are taken out of
record.csv.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

HERE = Path(__file__).resolve().parent
COLUMNS = ("t_s", "dt", "report_east", "report_north", "report_speed_east", "report_speed_north")
LONGEST = 5.0  # s between two instants
REMOVED = ((3270.0, 3330.0), (3800.0, 3860.0), (4260.0, 4320.0))  # s, of track A
Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Record:
    """One ship, T instants.

    Attributes
    ----------
    t, dt : (T,) ndarray
        Time, and time to the next instant, s; 0 at the last one.
    y : (T, 4) ndarray
        Position (m) and velocity (m/s), east and north; NaN where there is no report.
    """

    t: Floats
    dt: Floats
    y: Floats

    @property
    def reported(self) -> NDArray[np.bool_]:
        """Instants with a report."""
        return np.isfinite(self.y[:, 0])

    def without(self, removed: NDArray[np.bool_]) -> Record:
        """The same instants without some of the reports."""
        y = self.y.copy()
        y[removed] = np.nan
        return replace(self, y=y)


def record(track: str) -> Record:
    """Read the reports of a ship."""
    with (HERE / "data" / "tracks.csv").open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["track"] == track]
    names = ("t_s", "east_m", "north_m", "cog_deg", "sog_ms")
    t, east, north, course, speed = (np.array([float(row[name]) for row in rows]) for name in names)
    course = np.deg2rad(course)
    reports = np.column_stack([east, north, speed * np.sin(course), speed * np.cos(course)])
    parts = np.maximum(1, np.ceil(np.diff(t) / LONGEST).astype(int))
    at = np.concatenate([[0], np.cumsum(parts)])
    instants = np.interp(np.arange(at[-1] + 1), at, t)
    y = np.full((instants.size, 4), np.nan)
    y[at] = reports
    instants = np.round(instants, 3)
    return Record(instants, np.round(np.append(np.diff(instants), 0.0), 3), y)


def stretches(t: Floats, removed: tuple[tuple[float, float], ...] = REMOVED) -> NDArray[np.bool_]:
    """Instants within one of the stretches."""
    return np.any([(t >= start) & (t < end) for start, end in removed], axis=0)


def write(path: Path, ship: Record) -> None:
    """Write a record as CSV, a column per name of the specification; an empty field is missing."""
    with path.open("w", encoding="utf-8", newline="") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(COLUMNS)
        for t, dt, y in zip(ship.t, ship.dt, ship.y, strict=True):
            fields = ["" if np.isnan(value) else f"{value:.3f}" for value in y]
            out.writerow([f"{t:.3f}", f"{dt:.3f}", *fields])


def main() -> None:
    """Write record.csv."""
    ship = record("A")
    kept = ship.without(stretches(ship.t))
    write(HERE / "record.csv", kept)
    print(f"record.csv: {ship.t.size} instants, {ship.reported.sum()} reports on them, ", end="")
    print(f"{(ship.reported & ~kept.reported).sum()} of them taken out")


if __name__ == "__main__":
    main()
