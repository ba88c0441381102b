"""Where the signals stand in record files: names of columns."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from fkgen.problem.table.place import Place, describe, suggestion
from fkgen.problem.table.section import Section, as_table

_COLUMN = "the heading of a column, such as 'GPS height [m]'"


@dataclass(frozen=True, slots=True)
class Columns:
    """Headings of columns, where they are not the names of the signals."""

    columns: tuple[tuple[str, str], ...] = ()  # Signal or parameter, and heading of its column
    time: str | None = None  # Heading of the time column

    def plain(self) -> dict[str, object]:
        """Return the table a spec file would hold."""
        table: dict[str, object] = {"columns": dict(self.columns)} if self.columns else {}
        return table if self.time is None else table | {"time": self.time}


def read_record(table: object, place: Place, known: Collection[str]) -> Columns:
    """Return the names of columns that a table states for signals and parameters."""
    section = Section(table, place, known=("columns", "time"))
    inner = place.entry("columns")
    entries = as_table(section.table.get("columns", {}), inner, f"a table of {_COLUMN}")
    for name in entries:
        if name not in known:
            expected = f"a signal or a parameter, out of {', '.join(known)}"
            raise inner.entry(name).error("an unknown name", expected + suggestion(name, known))
    columns = tuple((name, _heading(entry, inner.entry(name))) for name, entry in entries.items())
    time = section.table.get("time")
    return Columns(columns, None if time is None else _heading(time, place.entry("time")))


def _heading(value: object, place: Place) -> str:
    if not isinstance(value, str):
        raise place.error(describe(value), _COLUMN)
    return value
