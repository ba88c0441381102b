"""What equations may name: signals, noises and parameters of a plant."""

from __future__ import annotations

import keyword
from dataclasses import dataclass

import numpy as np

from fkgen.problem.equations import Noise
from fkgen.problem.finding import Finding
from fkgen.problem.functions.vectors import Known, Vector
from fkgen.problem.signals import Signal, check_distinct, read_name, read_signals, read_unit
from fkgen.problem.table.place import Place
from fkgen.problem.table.section import Section, as_entry, as_list
from fkgen.problem.text.expression import WORDS, Name, Number, Scope, evaluate
from fkgen.problem.text.foreign import plain_list
from fkgen.problem.text.matrix import Matrix

REFUSED = (
    (WORDS, "a name that is not a word of the expression language, since equations name it"),
    (frozenset(keyword.kwlist), "a name that is not a keyword of Python, since equations name it"),
)
#: Largest distance of x0 from a unit quaternion that is taken for rounding.
UNIT_TOLERANCE = 1e-3
#: Units of an angle that wraps.
_ANGLES = ("", "rad")


@dataclass(frozen=True, slots=True)
class Named:
    """The signals and parameters of a plant, which its equations name."""

    states: tuple[Signal, ...]
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    noises: tuple[Noise, ...]
    scope: Scope
    continuous: bool = False  # Whether f is dx/dt

    @property
    def wraps(self) -> bool:
        """Whether there is an angle whose differences wrap."""
        return any(each.wrap for each in (*self.states, *self.outputs))

    @property
    def coordinates(self) -> tuple[str, ...]:
        """The numbers of x."""
        found = (coordinates(each) for each in self.states)
        return tuple(name for names_ in found for name in names_)

    @property
    def attitudes(self) -> dict[str, int]:
        """The states that are attitudes, and where they begin in x."""
        starts, at = {}, 0
        for each in self.states:
            if each.manifold:
                starts[each.name] = at
            at += len(coordinates(each))
        return starts

    def known(self) -> Known:
        """What equations may name before there is any definition."""
        vectors: dict[str, Vector] = {
            each.name: tuple(map(Name, coordinates(each))) for each in self.states if each.manifold
        }
        vectors |= {name: tuple(map(Name, parts)) for name, parts in self.scope.vectors.items()}
        scalars = dict.fromkeys(self.coordinates, "a state")
        scalars |= dict.fromkeys((each.name for each in self.inputs), "an input")
        scalars |= dict.fromkeys((each.name for each in self.noises), "a noise")
        scalars |= dict.fromkeys(self.scope, "a parameter")
        return Known(self.scope, scalars, vectors, self.attitudes)

    def check(self, place: Place) -> None:
        """Refuse names that equations could not tell apart or write."""
        for key in ("states", "inputs"):
            for i, each in enumerate(getattr(self, key)):
                where = place.entry(key).item(i).entry("name")
                read_name(each.name, where, REFUSED)
        of: dict[str, str] = dict.fromkeys((*self.scope, *self.scope.vectors), "parameters")
        for key in ("states", "inputs", "noises"):
            for i, each in enumerate(getattr(self, key)):
                if each.name in of:
                    where = place.entry(key).item(i).entry("name")
                    expected = "names in equations that mean one thing"
                    given = f"{each.name!r}, which is one of the {of[each.name]} too"
                    raise where.error(given, expected)
                of[each.name] = key


def coordinates(signal: Signal) -> tuple[str, ...]:
    """What the numbers of a state are called in equations."""
    if not signal.manifold:
        return (signal.name,)
    return tuple(f"{signal.name}[{i}]" for i in range(4))


def read_noises(section: Section) -> tuple[Noise, ...]:
    """The noises that enter through f."""
    expected = "a list of tables, such as {name = 'w', variance = 0.01}"
    place = section.place.entry("noises")
    entries = as_list(section.table.get("noises", []), place, expected)
    found = tuple(
        _noise(
            Section(
                entry, place.item(i), known=("name", "unit", "variance"), defaults=section.defaults
            )
        )
        for i, entry in enumerate(entries)
    )
    check_distinct((noise.name for noise in found), place, "noises")
    return found


def _noise(section: Section) -> Noise:
    given = section.require("name", "a C identifier")
    name = read_name(given, section.place.entry("name"), REFUSED)
    expected = "a variance: a number that is not negative, or an expression of the parameters"
    place = section.place.entry("variance")
    variance = as_entry(section.require("variance", expected), place, section.defaults, expected)
    if not (value := evaluate(variance, section.defaults)) >= 0.0:
        at = "" if isinstance(variance, Number) else " at the defaults"
        raise place.error(f"{value!r}{at}", expected)
    return Noise(name, read_unit(section), variance)


def read_named(section: Section) -> Named:
    """The signals that a section states, whose matrices need not be there."""
    counts = (("states", "x", ("A", "x0")), ("inputs", "u", ()), ("outputs", "y", ("C", "h", "R")))
    found = []
    for key, letter, sources in counts:
        count = None if key in section else _count(section, sources)
        if key == "inputs" and key not in section and "B" in section:
            count = section.matrix("B", (None, None), "B maps the input to the state").shape[1]
        found.append(read_signals(section, key, letter, count))
        if not found[-1] and key != "inputs":
            expected = f"{key} by name, such as [{{name = 'angle', unit = 'rad'}}]"
            raise section.error(key, "none", expected)
    scope = section.defaults if isinstance(section.defaults, Scope) else Scope(section.defaults)
    continuous = section.choice("time", ("discrete", "continuous"), "discrete") == "continuous"
    named = Named(found[0], found[1], found[2], read_noises(section), scope, continuous)
    named.check(section.place)
    return named


def _count(section: Section, sources: tuple[str, ...]) -> int:
    """How many entries the first of some lists has that is there."""
    for key in sources:
        entries = plain_list(section.table.get(key), section.place.entry(key))
        if isinstance(entries, list):
            return len(entries)
    return 0


def read_start(section: Section, named: Named, x0: Matrix) -> tuple[Matrix, tuple[Finding, ...]]:
    """x0 with quaternions of unit length, and what is to be said about it."""
    remarks, rows, place = [], list(x0.rows), section.place.entry("x0")
    for name, at in named.attitudes.items():
        q = np.array([evaluate(row[0], section.defaults) for row in rows[at : at + 4]])
        length = float(np.sqrt(q @ q))
        if not abs(length - 1.0) <= UNIT_TOLERANCE:
            expected = f"a unit quaternion (w, x, y, z) for {name}, to within {UNIT_TOLERANCE:g}"
            raise place.item(at).error(f"four numbers of length {length:.6g}", expected)
        if not all(isinstance(row[0], Number) for row in rows[at : at + 4]):
            continue  # the start scales what parameters make of it
        if abs(length - 1.0) > 1e-12:
            message = f"x0 of {name} has length {length:.9g} and was normalised"
            remedy = "write all digits, or leave it"
            remarks.append(Finding("unit-quaternion", "note", message, length, remedy))
        sign = -1.0 if q[0] < 0.0 else 1.0
        exact = abs(length - 1.0) <= 1e-15
        rows[at : at + 4] = [
            (Number(each if exact and sign > 0.0 else sign * each / length),) for each in q
        ]
    return Matrix(tuple(rows)), (*remarks, *_wrapped_units(named))


def _wrapped_units(named: Named) -> list[Finding]:
    """Angles that wrap are in radians."""
    found = []
    for each in (*named.states, *named.outputs):
        if each.wrap and each.unit not in _ANGLES[1:]:
            unit = f"the unit '{each.unit}'" if each.unit else "no unit"
            message = f"{each.name} wraps at pi, as an angle in radians does, and has {unit}"
            found.append(Finding("wrap-unit", "warning", message, None, "unit = 'rad', or no wrap"))
    return found
