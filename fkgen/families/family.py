"""What a family is: a value that says all there is to say about one kind of filter."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fkgen.problem import Model, Spec
from fkgen.problem.covariance import is_singular
from fkgen.problem.equations import Equations
from fkgen.problem.filter import Options, Traits
from fkgen.problem.finding import Finding
from fkgen.problem.functions.affine import matrices, why_not_linear
from fkgen.problem.table.place import Place
from fkgen.problem.table.section import Section

if TYPE_CHECKING:  # reading a spec loads none of what proves and builds its filter
    from fkgen.oracle.claims.claim import ClosedForm
    from fkgen.oracle.theorems.identity import Identity
    from fkgen.symbolic.recursion import Recursion

#: ``reader(section, model, family)`` reads one section of ``faults``.
FaultReader = Callable[[Section, Model, str], Any]

#: A spec as nested plain dicts.
Table = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Proof:
    """What a filter is held against."""

    closed_forms: tuple[ClosedForm, ...]  # All of them hold before any C is generated
    theorems: tuple[Identity, ...] = ()  # What SymPy proves once for all models


def built_by(where: str, **options: Any) -> Callable[[Spec], Recursion]:
    """The function "module:name" of the estimators, imported when it builds."""

    def build(spec: Spec) -> Recursion:
        recursion: Recursion = _found(f"estimators.{where}")(spec, **options)
        return recursion

    return build


def by_option(key: str, **builders: Callable[[Spec], Recursion]) -> Callable[[Spec], Recursion]:
    """What builds the filter for the value that an option has."""
    return lambda spec: builders[getattr(spec.filter.options, key)](spec)


def proved_by(claims: str, *names: str, theorems: str = "") -> Callable[[], Proof]:
    """Closed forms of a module of claims, and theorems "module:NAME", imported when asked for.

    The name of a closed form of another module begins with it, "module:NAME".
    """

    def proof() -> Proof:
        where = (name if ":" in name else f"{claims}:{name}" for name in names)
        closed_forms = tuple(_found(f"oracle.claims.{each}") for each in where)
        return Proof(closed_forms, _found(f"oracle.theorems.{theorems}") if theorems else ())

    return proof


def _found(where: str) -> Any:
    module, _, name = where.partition(":")
    return getattr(import_module(f"fkgen.{module}"), name)


@dataclass(frozen=True, slots=True, kw_only=True)
class Family:
    """A filter family; its module loads nothing heavy before ``build`` or ``proof`` is called."""

    name: str  # as in ``filter.family``
    title: str  # one line for ``fkgen families``
    build: Callable[[Spec], Recursion]
    proof: Callable[[], Proof]
    traits: Traits = field(default_factory=Traits)  # what other code asks
    options: type[Options] = Options  # a frozen dataclass that reads its fields from ``filter``
    #: Sections of ``faults`` that it is about, of which a spec has one, and how each is read
    accepts: Mapping[str, FaultReader] = field(default_factory=dict)
    optional_faults: bool = False  # the first section may be missing
    instead: str = ""  # the families that take plants that are not linear, with these faults
    check: Callable[[Spec], None] = lambda _: None  # raises SpecError where it is not defined
    #: Where the filter of a spec is less than its name says
    caveats: Callable[[Spec], tuple[Finding, ...]] = lambda _: ()
    #: ``adopt(table, truth)``: the spec of this family for the plant of another spec, to be
    #: compared with it; ``table["faults"]`` is that of the truth
    adopt: Callable[[Table, Spec], Table] = lambda table, _: table
    starter: str = ""  # file among the templates that holds a spec to begin with

    @property
    def closed_forms(self) -> tuple[ClosedForm, ...]:
        """What every recursion of the family is confronted with."""
        return self.proof().closed_forms

    @property
    def theorems(self) -> tuple[Identity, ...]:
        """What SymPy proves once for all models."""
        return self.proof().theorems

    @property
    def keys(self) -> tuple[str, ...]:
        """Names of the options."""
        return tuple(each.name for each in fields(self.options))

    def remarks(self, spec: Spec) -> tuple[Finding, ...]:
        """What is worth knowing of a spec before anything is computed."""
        return (*self.caveats(spec), *spec.model.remarks)

    def check_model(self, model: Model, place: Place) -> None:
        """Refuse equations, where the family needs matrices."""
        if model.equations is not None and not self.traits.nonlinear:
            raise self._no_matrices(model, model.equations, place.entry("model"))

    def _no_matrices(self, model: Model, equations: Equations, place: Place) -> Exception:
        key, given = why_not_linear(equations, model)
        instead = f"take {self.instead}" if self.instead else "take ekf, iekf or ukf"
        return place.entry(key).error(given, f"{self._demand}; {instead}")

    @property
    def _demand(self) -> str:
        """What the family needs of a plant that is not linear and is not there."""
        if self.traits.moments:
            what = "E[x x'] of every sample, which follows from A alone"
        elif self.traits.windows != "none":
            what = "products of A over a window"
        else:
            return f"equations that are linear in states and inputs for the family {self.name}"
        return f"a linear plant for the family {self.name}: it needs {what}"

    def check_spec(self, spec: Spec) -> None:
        """Refuse a spec for which the family is not defined."""
        curved = [
            (plant.equations, place)
            for plant, place in spec.placed_plants
            if plant.equations is not None and not self.traits.nonlinear
        ]
        for equations, place in sorted(curved, key=lambda each: matrices(each[0]) is not None):
            raise self._no_matrices(spec.model, equations, place)
        demand_noise(spec, f"the family {self.name}" if self.traits.densities else "")
        if not (spec.model.S.is_zero or self.traits.correlated):
            raise (
                Place(spec.file)
                .entry("model")
                .entry("S")
                .error(
                    f"a covariance of w with v for the family {self.name}",
                    "none: only the family kf, and ekf, take noises that are correlated",
                )
            )
        _check_hindsight(spec)
        _check_decoupled(spec)
        self.check(spec)


def _check_hindsight(spec: Spec) -> None:
    """Refuse a lag, or rows that may be late, where what came before is not remembered."""
    lag = spec.filter.option("lag", None)
    if lag is not None:
        at, given = Place(spec.file, "filter").entry("lag"), f"{lag} samples"
        if not spec.filter.traits.hindsight:
            raise at.error(f"{given} with a stationary gain", "gain = 'time_varying'")
        if spec.model.attitudes:
            raise at.error(f"{given}, of a plant with an attitude", "states without SO3")
    late = [i for i, signal in enumerate(spec.model.outputs) if signal.max_delay]
    if not late:
        return
    at = Place(spec.file, "model.outputs").item(late[0]).entry("max_delay")
    given = f"a row that may be late, for the family {spec.filter.family}"
    if not spec.filter.traits.hindsight:
        expected = "one of kf, ekf, mkf, genie, its gain not stationary; elsewhere states that"
        raise at.error(given, f"{expected} keep what is measured late: docs/delays.md")
    if lag is not None:
        raise at.error("a row that may be late, beside filter.lag", "one of the two")
    if spec.model.attitudes:
        raise at.error("a row that may be late, of a plant with an attitude", "states without SO3")
    if spec.filter.option("gate_by", None) == "sample":
        raise at.error("a row that may be late, with gate_by = 'sample'", "gate_by = 'row'")


def _check_decoupled(spec: Spec) -> None:
    """Refuse to leave covariances out where there is not one covariance, of x alone."""
    if not spec.code.decoupled:
        return
    at, lag = Place(spec.file, "code").entry("decoupled"), spec.filter.option("lag", None)
    if not spec.filter.traits.hindsight:
        raise at.error(
            f"true, for the family {spec.filter.family}",
            "one of kf, ekf, mkf, genie, its gain not stationary",
        )
    if lag is not None or any(signal.max_delay for signal in spec.model.outputs):
        raise at.error("true, beside filter.lag or rows that may be late", "one of the two")
    if spec.code.form == "loops":
        raise at.error('true, beside code.form = "loops"', 'form = "auto" or "straight"')


def demand_stationary(at: Place, *system: NDArray[np.float64]) -> None:
    """Refuse a stationary gain of a plant A, C, Q, R, and S if there is one, that has none."""
    from fkgen.oracle.textbook.riccati import stationary_prediction

    if stationary_prediction(*system) is None:
        raise at.error(
            "'stationary' for a plant without a stabilising solution of the Riccati equation",
            "every state that does not die away by itself to be seen by y, and every one on the"
            " unit circle to be moved by Q; use gain = 'time_varying'",
        )


def demand_noise(spec: Spec, compares: str) -> None:
    """Refuse a singular R where ``compares`` compares densities, or nothing at all is random."""
    for plant, place in spec.placed_plants:
        if not is_singular(plant.R.values(spec.defaults)):
            continue
        if compares:
            expected = f"a positive definite R for {compares}: it compares densities"
            raise place.entry("R").error("a singular matrix", expected)
        noises = () if plant.equations is None else plant.equations.noises
        if not (noises or plant.Q.values(spec.defaults).any()):
            raise place.entry("R").error(
                "a singular matrix, and Q = 0",
                "a positive definite R where there is no process noise, or some process noise",
            )
