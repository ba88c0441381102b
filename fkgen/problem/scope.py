"""What expressions may name: run-time parameters with their ranges, and tables to look up."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Any, get_args

from fkgen.problem.filter import Parameter
from fkgen.problem.model import Model
from fkgen.problem.signals import check_distinct, parameter_words, read_name
from fkgen.problem.table.place import Place, show
from fkgen.problem.table.section import Section, as_list, as_number, as_table
from fkgen.problem.text.foreign import plain_list
from fkgen.problem.text.lookup import Kind, Table

_DEFAULT = "a finite number, the default"
_POINTS = "a list of at least 2 finite numbers"
#: Most points of a table: each interval is some lines of C.
MOST_POINTS = 200
#: Most entries of a parameter that is a vector.
MOST_ENTRIES = 16


def read_parameters(
    table: object, place: Place, name: str, told: tuple[Parameter, ...], family: str
) -> tuple[Parameter, ...]:
    """The parameters of a filter of this name, then those that its family is ``told``."""
    entries = as_table(table, place, "a table of default values, such as tau = 0.05")
    words = parameter_words(name, entries)
    parameters = tuple(
        each
        for key, value in entries.items()
        for each in _stated(read_name(key, place.entry(key), words), value, place.entry(key))
    )
    check_distinct((*entries, *(each.name for each in parameters if each.of)), place, "parameters")
    for own in told:
        if own.name in entries:
            raise place.entry(own.name).error(
                f"a parameter {own.name}",
                f"another name: the family {family} has a parameter {own.name} of its own",
            )
    check_distinct((each.name for each in (*parameters, *told)), place, "parameters")
    return (*parameters, *told)


def delays_of(
    model: Model, parameters: tuple[Parameter, ...], place: Place
) -> tuple[Parameter, ...]:
    """How late rows of y are, one parameter for each that may be."""
    late = [signal for signal in model.outputs if signal.max_delay]
    for signal in late:
        for each in parameters:
            if each.name.lower() == signal.delay.lower():
                expected = f"another name: it is that of the delay of the row {signal.name}"
                raise place.entry(each.name).error(f"a parameter {each.name}", expected)
    return tuple(Parameter(signal.delay, 0.0) for signal in late)


def vectors(parameters: tuple[Parameter, ...]) -> dict[str, tuple[str, ...]]:
    """The parameters that are entries of vectors, by vector."""
    found: dict[str, tuple[str, ...]] = {}
    for each in parameters:
        if each.of:
            found[each.of] = (*found.get(each.of, ()), each.name)
    return found


def plain_parameters(parameters: tuple[Parameter, ...]) -> dict[str, object]:
    """The table that a spec file would hold."""
    found: dict[str, Any] = {}
    for each in parameters:
        if each.of:
            found.setdefault(each.of, []).append(each.default)
        else:
            found[each.name] = each.plain()
    return found


def _stated(name: str, value: object, place: Place) -> tuple[Parameter, ...]:
    """One parameter, or those of a vector: of m they are m_0, m_1, ..."""
    plain = plain_list(value, place)
    if not isinstance(plain, list) or len(plain) < 2:
        return (_parameter(name, value, place),)
    if len(plain) > MOST_ENTRIES:
        expected = f"a number, or a vector of 2 to {MOST_ENTRIES} numbers"
        raise place.error(f"a list of {len(plain)}", expected)
    return tuple(
        Parameter(read_name(f"{name}_{i}", place.item(i)), as_number(each, place.item(i)), of=name)
        for i, each in enumerate(plain)
    )


def _parameter(name: str, value: object, place: Place) -> Parameter:
    """A number, or a table with the range around it."""
    if not isinstance(value, Mapping):
        return Parameter(name, as_number(value, place, _DEFAULT))
    section = Section(value, place, known=("default", "min", "max"))
    default = section.number("default", _DEFAULT, math.isfinite)
    low, high = (
        section.number(key, "a finite number", math.isfinite) if key in section else free
        for key, free in (("min", -math.inf), ("max", math.inf))
    )
    if low > high:
        raise section.error("min", f"{low!r}, above max = {high!r}", "a range that holds numbers")
    if not low <= default <= high:
        expected = f"a default in the range, {low!r} to {high!r}"
        raise section.error("default", f"{default!r}", expected)
    return Parameter(name, default, low, high)


def read_tables(table: object, place: Place) -> tuple[Table, ...]:
    """The tables that ``interp`` looks up."""
    expected = 'a table of tables, such as drag = {x = [0.0, 1.0], y = [2.0, 3.0], kind = "linear"}'
    entries = as_table(table, place, expected)
    return tuple(
        _table(read_name(key, place.entry(key)), value, place.entry(key))
        for key, value in entries.items()
    )


def _table(name: str, value: object, place: Place) -> Table:
    section = Section(value, place, known=("x", "y", "kind"))
    x, y = (_points(section, key) for key in ("x", "y"))
    if len(x) != len(y):
        raise section.error("y", f"{len(y)} numbers", f"{len(x)}: one for each of x")
    for i, (before, after) in enumerate(pairwise(x)):
        if not before < after:
            given = f"{after!r} after {before!r}"
            raise section.place.entry("x").item(i + 1).error(given, "numbers that increase")
    kind: Any = section.choice("kind", get_args(Kind), "linear")
    found = Table(name, x, y, kind)
    if not all(math.isfinite(each) for piece in found.pieces for each in piece):
        raise section.error("y", "values with slopes that overflow", "finite slopes")
    return found


def _points(section: Section, key: str) -> tuple[float, ...]:
    place = section.place.entry(key)
    entries = as_list(section.require(key, _POINTS), place, _POINTS)
    if not 2 <= len(entries) <= MOST_POINTS:
        given, expected = f"{len(entries)} numbers", f"2 to {MOST_POINTS} numbers"
        raise section.error(key, given, expected)
    return tuple(as_number(entry, place.item(i)) for i, entry in enumerate(entries))


def check_float(
    parameters: tuple[Parameter, ...], tables: tuple[Table, ...], largest: float, place: Place
) -> None:
    """Refuse numbers that the scalar type of the code cannot hold."""
    for section, names in (("parameters", parameters), ("tables", tables)):
        for each in names:
            for value in each.numbers:
                if largest < abs(value) < math.inf:
                    expected = f"numbers up to {largest:.6g}, the largest of the scalar type"
                    raise place.entry(section).entry(each.name).error(show(value), expected)
