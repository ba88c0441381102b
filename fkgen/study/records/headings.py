"""Headings of columns: the signals, the parameters and the times that they name."""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Mapping, Sequence
from fractions import Fraction

from fkgen.errors import DataError

TIMES = ("t", "time", "timestamp")  # names of a time column, in any case, with a unit or without
#: Of times: how many a second has.
UNITS: dict[str, int | Fraction] = {
    "s": 1,
    "ms": 1000,
    "us": 10**6,
    "µs": 10**6,
    "μs": 10**6,
    "ns": 10**9,
}
UNITS |= {"min": Fraction(1, 60), "h": Fraction(1, 3600)}
_UNIT = re.compile(r"(?P<name>.*?)\s*(?:\[(?P<square>[^\[\]]*)\]|\((?P<round>[^()]*)\))")
_SUFFIX = re.compile(r"(?P<name>.+)_(?P<unit>s|ms|us|ns|min|h)")
_SHOWN = 200  # characters of a list of headings in an error


def parted(heading: str) -> tuple[str, str]:
    """Name and unit of a heading such as ``GPS height [m]``."""
    found = _UNIT.fullmatch(heading.strip())
    if found is None:
        return heading.strip(), ""
    return found["name"], (found["square"] or found["round"] or "").strip()


def positions(headings: Sequence[str], name: str) -> list[int]:
    """Columns that a name means: those of this heading, else those that differ in case or unit."""
    exact = [i for i, heading in enumerate(headings) if heading == name]
    if exact:
        return exact
    wanted = name.strip().casefold()
    return [
        i
        for i, heading in enumerate(headings)
        if wanted in {heading.casefold(), parted(heading)[0].casefold()}
    ]


def counted(headings: Sequence[str], names: Collection[str]) -> int:
    """How many of the names have a column."""
    return sum(bool(positions(headings, name)) for name in names)


def column_of(headings: Sequence[str], name: str, renamed: Mapping[str, str]) -> int | None:
    """The column of a signal or a parameter, or None; an error names two that it could be."""
    heading = renamed.get(name, name)
    found = positions(headings, heading)
    if not found and name in renamed and heading.isdecimal() and 1 <= int(heading) <= len(headings):
        return int(heading) - 1
    if not found and name in renamed:
        raise DataError(
            f"column of {name}",
            given=f"{heading!r}, which is no heading (there are: {listed(headings)})",
            expected=_closest(heading, headings),
        )
    if len(found) > 1:
        two = " and ".join(repr(headings[i]) for i in found[:2])
        given = f"two columns {headings[found[0]]!r}" if len(set(two.split(" and "))) == 1 else two
        expected = f"different names, or --column {name}=HEADING, or the number of the column"
        raise DataError(f"column of {name}", given=given, expected=expected)
    return found[0] if found else None


def time_column(
    headings: Sequence[str],
    stated: str | None,
    taken: Collection[int],
    stamps: Sequence[int] = (),
) -> tuple[int | None, Fraction | None]:
    """The column of the times and how many of its units a second has, where its heading says it.

    ``stated`` is what the user calls it; an empty text is none. Of ``stamps``, columns that are
    typed as timestamps, the only one is it under any name.
    """
    if stated == "":
        return None, None
    if stated is not None:
        found = positions(headings, stated)
        if not found:
            given = f"{stated!r}, which is no heading (there are: {listed(headings)})"
            raise DataError("time column", given=given, expected=_closest(stated, headings))
        return found[0], unit_of(headings[found[0]])
    named = [(i, *_unit(heading)) for i, heading in enumerate(headings) if i not in taken]
    for name in TIMES:
        exact = [each for each in named if headings[each[0]] == name]
        for i, plain, unit in (*exact, *named):
            if plain == name:
                return i, unit
    return (stamps[0] if len(stamps) == 1 else None), None


def unit_of(heading: str) -> Fraction | None:
    """How many of the unit of a heading a second has; None where it has none."""
    return _unit(heading)[1]


def _unit(heading: str) -> tuple[str, Fraction | None]:
    """The name of a time in small letters, and its unit: ``t [ms]``, ``Time (s)``, ``t_us``."""
    name, unit = parted(heading)
    if not unit and (found := _SUFFIX.fullmatch(name)):
        name, unit = found["name"], found["unit"]
    per_second = UNITS.get(unit, UNITS.get(unit.casefold()))
    return name.casefold(), None if per_second is None else Fraction(per_second)


def listed(headings: Sequence[str]) -> str:
    """The headings, as far as one reads them."""
    text = ", ".join(heading for heading in headings if heading)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."


def _closest(name: str, headings: Sequence[str]) -> str:
    close = difflib.get_close_matches(name, headings, n=1)
    return repr(close[0]) if close else "one of the headings"
