"""The filter: its family, which is found by name at run time, its traits and its options."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import import_module
from typing import Any, Literal, Self

from fkgen.problem.model import Model
from fkgen.problem.table.section import Section
from fkgen.problem.text.matrix import plain_fields


@dataclass(frozen=True, slots=True)
class Parameter:
    """A number that can change at run time."""

    name: str  # A C identifier, usable in the expressions of the spec
    default: float  # Its value where the user of the filter states none
    #: low, high: What it may be at run time
    low: float = -math.inf
    high: float = math.inf
    of: str = ""  # The vector parameter that it is an entry of

    @property
    def numbers(self) -> tuple[float, ...]:
        """What the code has to hold."""
        return self.default, self.low, self.high

    @property
    def is_bounded(self) -> bool:
        """Whether there is a range."""
        return self.low > -math.inf or self.high < math.inf

    def plain(self) -> object:
        """Return the entry a spec file would hold."""
        limits = {"min": self.low, "max": self.high}
        stated = {key: value for key, value in limits.items() if math.isfinite(value)}
        return {"default": self.default, **stated} if stated else self.default


@dataclass(frozen=True, slots=True, kw_only=True)
class Traits:
    """What code asks of a family in place of its name."""

    #: Linear in y, with gains that no measurement changes; the NIS is chi-square
    linear: bool = False
    exact: bool = False  # Its likelihood is that of the model, with nothing approximated
    #: "one"; "bank": several side by side, combined by weights; "merged": several from one
    #: Gaussian, merged again; "mixed": several estimates, mixed before every sample
    models: Literal["one", "bank", "merged", "mixed"] = "one"
    correlated: bool = False  # Noise of the state may be correlated with that of y
    #: One mean and one covariance with a gain for every sample: what a smoother works back through
    hindsight: bool = False
    densities: bool = False  # It compares densities of y, so R has to be positive definite
    moments: bool = False  # Gains follow from unconditional second moments, P0 among them
    #: "none"; rows of y wait for the end of a window as an estimate of the whole state
    #: ("full"), or of the part that they measure ("partial")
    nonlinear: bool = False  # It linearises where it is, so it takes equations
    windows: Literal["none", "full", "partial"] = "none"
    #: How it takes f and h: by derivatives at a "point", found "anew" in the update, or by a
    #: "spread" of points
    looks: Literal["point", "anew", "spread"] = "point"
    #: What it is told of the faults of every sample, as run-time parameters
    told: tuple[Parameter, ...] = ()

    @property
    def smooths(self) -> bool:
        """Whether records can be smoothed, over modes by Kim's approximation."""
        return self.hindsight or self.models in {"merged", "mixed"}


@dataclass(frozen=True, slots=True)
class Options:
    """Options of a family: the fields of a subclass, which reads them."""

    @classmethod
    def read(cls, section: Section, faults: Any, model: Model) -> Self:  # noqa: ARG003
        """The options in the section ``filter``; by default there are none."""
        return cls()

    def plain(self) -> dict[str, object]:
        """The keys that a spec file would hold; None is left out."""
        return plain_fields(self)

    def adapted(self, traits: Traits) -> Traits:
        """What of the traits of the family these options change."""
        return traits


@dataclass(frozen=True, slots=True)
class Filter:
    """A family and its options."""

    family: str  # Its name, or module:NAME of a `Family` in any importable module
    options: Any = field(default_factory=Options)  # Of the type that the family has for them
    linearises: bool = False  # The plant has functions f and h

    @property
    def traits(self) -> Traits:
        """What the family is like."""
        traits: Traits = self.options.adapted(registry().family(self.family).traits)
        return replace(traits, linear=traits.linear and not self.linearises)

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
