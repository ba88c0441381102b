"""Turn the reports of ships into time series: ``python prepare.py --data FOLDER``.

reports.csv has the reports of all ships as the filter takes them, record.csv one ship. Every report
is an instant. Between instants that are more than 5 s apart come empty ones, because the chain of
the modes moves once per instant. Three stretches of track A are taken out of record.csv.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from io import StringIO
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


def reports(folder: Path) -> tuple[NDArray[np.str_], Floats]:
    """Tracks of the reports of the data set, and time, position and velocity of each."""
    rows = columns(folder / "tracks.csv")
    course, speed = np.deg2rad(rows["cog_deg"]), rows["sog_ms"]
    velocity = speed * np.sin(course), speed * np.cos(course)
    return rows["track"], np.column_stack([rows["t_s"], rows["east_m"], rows["north_m"], *velocity])


def record(track: str) -> Record:
    """Read the reports of a ship and put empty instants between them."""
    rows = columns(HERE / "reports.csv")
    rows = rows[rows["track"] == track]
    t = rows["t_s"]
    parts = np.maximum(1, np.ceil(np.diff(t) / LONGEST).astype(int))
    at = np.concatenate([[0], np.cumsum(parts)])
    instants = np.interp(np.arange(at[-1] + 1), at, t)
    y = np.full((instants.size, 4), np.nan)
    y[at] = np.column_stack([rows[name] for name in COLUMNS[2:]])
    instants = np.round(instants, 3)
    return Record(instants, np.round(np.append(np.diff(instants), 0.0), 3), y)


def stretches(t: Floats, removed: tuple[tuple[float, float], ...] = REMOVED) -> NDArray[np.bool_]:
    """Instants within one of the stretches."""
    return np.any([(t >= start) & (t < end) for start, end in removed], axis=0)


def columns(path: Path) -> NDArray[Any]:
    """Read a CSV file; its columns have names."""
    return np.genfromtxt(path, delimiter=",", names=True, dtype=None, encoding="utf-8")


def write(path: Path, ship: Record) -> None:
    """Write a record as CSV, a column per name of the specification; an empty field is missing."""
    text, rows = StringIO(), np.column_stack([ship.t, ship.dt, ship.y])
    np.savetxt(text, rows, "%.3f", delimiter=",", header=",".join(COLUMNS), comments="")
    path.write_text(text.getvalue().replace("nan", ""), encoding="utf-8")


def make(data: Path, target: Path) -> None:
    """Write reports.csv, velocities with all their digits: record.csv rounds them once."""
    tracks, rows = reports(data)
    lines = [("track", COLUMNS[0], *COLUMNS[2:])]
    lines += [(track, *map(repr, row)) for track, row in zip(tracks, rows.tolist(), strict=True)]
    text = "".join(",".join(line) + "\n" for line in lines)
    (target / "reports.csv").write_text(text, encoding="utf-8")


def main() -> None:
    """Write reports.csv, and record.csv from it."""
    parser = argparse.ArgumentParser(description="Write reports.csv and record.csv.")
    parser.add_argument("--data", type=Path, required=True, help="the folder of the data set")
    make(parser.parse_args().data, HERE)
    ship = record("A")
    kept = ship.without(stretches(ship.t))
    write(HERE / "record.csv", kept)
    print(f"record.csv: {ship.t.size} instants, {ship.reported.sum()} reports on them, ", end="")
    print(f"{(ship.reported & ~kept.reported).sum()} of them taken out")


if __name__ == "__main__":
    main()
