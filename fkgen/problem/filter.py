"""The filter: its family, which is found by name at run time, its traits and its options."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from functools import cache
from importlib import import_module
from typing import Any, Literal, Self

from fkgen.problem.model import Model
from fkgen.problem.table.place import show
from fkgen.problem.table.section import Section, as_number


@dataclass(frozen=True, slots=True)
class Parameter:
    """A number that can change at run time.

    Parameters
    ----------
    name : str
        A C identifier, usable in the expressions of the spec.
    default : float
        Its value where the user of the filter states none.
    """

    name: str
    default: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Traits:
    """What code asks of a family in place of its name.

    Attributes
    ----------
    linear : bool
        Linear in y, with gains that no measurement changes; the NIS is chi-square.
    models : str
        ``"one"``; ``"bank"``: several side by side, combined by weights; ``"merged"``: several from
        one Gaussian, merged again; ``"mixed"``: several estimates, mixed before every sample.
    densities : bool
        It compares densities of y, so R has to be positive definite.
    moments : bool
        Gains follow from unconditional second moments, P0 among them.
    windows : str
        ``"none"``; rows of y wait for the end of a window as an estimate of the whole state
        (``"full"``), or of the part that they measure (``"partial"``).
    told : tuple of Parameter
        What it is told of the faults of every sample, as run-time parameters.
    """

    linear: bool = False
    models: Literal["one", "bank", "merged", "mixed"] = "one"
    densities: bool = False
    moments: bool = False
    windows: Literal["none", "full", "partial"] = "none"
    told: tuple[Parameter, ...] = ()


@dataclass(frozen=True, slots=True)
class Options:
    """Options of a family: the fields of a subclass, which reads them."""

    @classmethod
    def read(cls, section: Section, faults: Any, model: Model) -> Self:  # noqa: ARG003
        """The options in the section ``filter``; by default there are none."""
        return cls()

    def plain(self) -> dict[str, object]:
        """The keys that a spec file would hold; None is left out."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        return {key: _listed(value) for key, value in values.items() if value is not None}


def _listed(value: object) -> object:
    return [_listed(entry) for entry in value] if isinstance(value, tuple) else value


@dataclass(frozen=True, slots=True)
class Filter:
    """A family and its options.

    Parameters
    ----------
    family : str
        Its name, or ``module:NAME`` of a `Family` in any importable module.
    options : Options
        Of the type that the family has for them.
    """

    family: str
    options: Any = field(default_factory=Options)

    @property
    def traits(self) -> Traits:
        """What the family is like."""
        traits: Traits = registry().family(self.family).traits
        return traits

    def option(self, name: str, default: Any) -> Any:
        """An option that not every family has."""
        return getattr(self.options, name, default)

    def plain(self) -> dict[str, object]:
        """Return the table a spec file would hold."""
        return {"family": self.family, **self.options.plain()}


@cache
def registry() -> Any:
    """The package of families. It lies below, so a spec finds it when it is read, not before."""
    return import_module("fkgen.families")


def positive(section: Section, key: str, default: float, below: float = math.inf) -> float:
    """The positive number under a key."""
    place = section.place.entry(key)
    expected = "a positive number" if below == math.inf else f"a number in (0, {below:g})"
    number = as_number(section.table.get(key, default), place, expected)
    if not 0.0 < number < below:
        raise place.error(show(number), expected)
    return number


def count(section: Section, key: str, default: int, largest: int, what: str = "samples") -> int:
    """The whole number from 1 to the largest under a key."""
    place = section.place.entry(key)
    expected = f"a number of {what}, a whole number in 1..{largest}"
    number = as_number(section.table.get(key, default), place, expected)
    if number != int(number) or not 1 <= number <= largest:
        raise place.error(show(section.table[key]), expected)
    return int(number)
