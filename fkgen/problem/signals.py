"""Names and units of states, inputs and outputs."""

from __future__ import annotations

from dataclasses import dataclass

from fkgen.problem.table.place import Place, show, suggestion
from fkgen.problem.table.section import Section, as_list, as_number, as_text
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
    unit_place = place.entry("unit")
    unit = as_text(section.table.get("unit", ""), unit_place, "a text, such as 'rad/s'")
    forbidden = any(part in unit for part in ("*/", "/*", "\\", "??"))
    if forbidden or len(unit) > MAX_UNIT or not unit.isprintable():
        raise unit_place.error(
            show(unit), f"at most {MAX_UNIT} printable characters that can stand in a C comment"
        )
    return Signal(name, unit)


def read_row(entry: object, place: Place, names: list[str]) -> int:
    """Return the index of a row of y that is given by number or by name."""
    expected = f"a row of y, 0..{len(names) - 1}, or its name ({', '.join(names)})"
    if isinstance(entry, str):
        if entry not in names:
            raise place.error(show(entry), expected + suggestion(entry, names))
        return names.index(entry)
    number = as_number(entry, place, expected)
    if number != int(number) or not 0 <= number < len(names):
        raise place.error(show(entry), expected)
    return int(number)


def read_rows(entries: object, place: Place, expected: str, names: list[str]) -> tuple[int, ...]:
    """Return the indices of rows of y, ascending, each of which is named once."""
    given = as_list(entries, place, expected)
    rows = [read_row(entry, place.item(i), names) for i, entry in enumerate(given)]
    for i, row in enumerate(rows):
        if row in rows[:i]:
            raise place.item(i).error(f"row {row} a second time", "every row once")
    return tuple(sorted(rows))
