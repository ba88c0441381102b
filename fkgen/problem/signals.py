"""Names and units of states, inputs and outputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fkgen.problem.table.place import Place, describe, show, suggestion
from fkgen.problem.table.section import Section, as_list, as_number
from fkgen.problem.text.naming import check_distinct, read_name

MAX_UNIT = 40


@dataclass(frozen=True, slots=True)
class Signal:
    """One component of x, u or y."""

    name: str  # A C identifier
    unit: str = ""  # Such as "rad/s"; empty if not stated


def read_signals(section: Section, key: str, letter: str, count: int) -> tuple[Signal, ...]:
    """Return the signals under ``key``, or ``x0, x1, ...`` without units."""
    if key not in section:
        return tuple(Signal(f"{letter}{index}") for index in range(count))
    place = section.place.entry(key)
    expected = f"a list of {count} tables, such as {{name = 'speed', unit = 'rad/s'}}"
    entries = as_list(section.table[key], place, expected)
    if len(entries) != count:
        raise place.error(f"{len(entries)} entries", f"{count}: the model has {count} {key}")
    signals = tuple(_signal(entry, place.item(index)) for index, entry in enumerate(entries))
    check_distinct((signal.name for signal in signals), place, key)
    return signals


def _signal(entry: object, place: Place) -> Signal:
    section = Section(entry, place, known=("name", "unit"))
    name = read_name(section.require("name", "a C identifier"), place.entry("name"))
    unit = section.table.get("unit", "")
    if not isinstance(unit, str):
        raise section.error("unit", describe(unit), "a text, such as 'rad/s'")
    forbidden = any(part in unit for part in ("*/", "/*", "\\", "??"))
    if forbidden or len(unit) > MAX_UNIT or not unit.isprintable():
        expected = f"at most {MAX_UNIT} printable characters that can stand in a C comment"
        raise section.error("unit", show(unit), expected)
    return Signal(name, str(unit))


def read_rows(
    section: Section, key: str, outputs: Sequence[Signal], which: str = "", empty: str = ""
) -> tuple[int, ...]:
    """Return rows of y under a key that must be there; ``empty``: what to do if there are none."""
    names = ", ".join(signal.name for signal in outputs)
    expected = f"a list of rows of y, out of 0..{len(outputs) - 1} ({names}){which}"
    rows = as_rows(section.require(key, expected), section.place.entry(key), expected, outputs)
    if not rows and empty:
        raise section.error(key, "an empty list", f"{expected}; {empty}")
    return rows


def as_rows(
    entries: object, place: Place, expected: str, outputs: Sequence[Signal]
) -> tuple[int, ...]:
    """Return indices of rows of y, ascending, each given once, by number or by name."""
    rows: list[int] = []
    for i, entry in enumerate(as_list(entries, place, expected)):
        row = _row(entry, place.item(i), [signal.name for signal in outputs])
        if row in rows:
            raise place.item(i).error(f"row {row} a second time", "every row once")
        rows.append(row)
    return tuple(sorted(rows))


def _row(entry: object, place: Place, names: list[str]) -> int:
    expected = f"a row of y, 0..{len(names) - 1}, or its name ({', '.join(names)})"
    if isinstance(entry, str):
        if entry not in names:
            raise place.error(show(entry), expected + suggestion(entry, names))
        return names.index(entry)
    number = as_number(entry, place, expected)
    if number not in range(len(names)):
        raise place.error(show(entry), expected)
    return int(number)
