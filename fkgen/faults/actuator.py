"""Actuators that fail intermittently: rates, and how the faults of several inputs depend."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fkgen.errors import InternalError
from fkgen.faults.chain import Mode, ModeChain
from fkgen.problem.covariance import checked_covariance, nearby
from fkgen.problem.model import Model
from fkgen.problem.table.matrix import Role, read_entry, read_matrix
from fkgen.problem.table.place import Place
from fkgen.problem.table.section import Section
from fkgen.problem.text.expression import ZERO, Expression, Number, evaluate, to_text
from fkgen.problem.text.foreign import plain_entry, plain_list
from fkgen.problem.text.matrix import NO_PARAMETERS, Matrix

#: Error of a probability that a linear program may leave.
TOLERANCE = 1e-9


def pattern_law(rates: ArrayLike, covariance: ArrayLike) -> NDArray[np.float64] | None:
    """Probabilities of all patterns of q inputs that work (1) or fail (0).

    For more than two inputs the moments leave the law open; this is the one with the smallest total
    distance from independent inputs. Patterns are in the order of ``itertools.product``; None if no
    law has these moments.
    """
    from scipy.optimize import linprog  # noqa: PLC0415 - slow to import

    rate, moments = np.asarray(rates, float), np.asarray(covariance, float)
    q = rate.size
    patterns = np.array(list(product((1.0, 0.0), repeat=q)))
    pairs = [(i, j) for i in range(q) for j in range(i)]
    rows = [np.ones(2**q), *patterns.T, *(patterns[:, i] * patterns[:, j] for i, j in pairs)]
    sides = [1.0, *rate, *(moments[i, j] + rate[i] * rate[j] for i, j in pairs)]
    independent = np.prod(np.where(patterns > 0.0, rate, 1.0 - rate), axis=1)
    one = np.eye(2**q)
    found = linprog(  # p, then |p - independent|
        np.repeat([0.0, 1.0], 2**q),
        A_ub=np.block([[one, -one], [-one, -one]]),
        b_ub=np.concatenate([independent, -independent]),
        A_eq=np.hstack([np.array(rows), np.zeros((len(rows), 2**q))]),
        b_eq=sides,
    )
    if not found.success:
        return None
    law = np.maximum(found.x[: 2**q], 0.0)
    return np.asarray(law / law.sum())


Dependence = Literal["common", "independent", "covariance"]

_DEPENDENCES: tuple[Dependence, ...] = ("common", "independent", "covariance")
JOINT_TOLERANCE = 1e-9
"""Absolute tolerance of probabilities computed from a covariance that a user typed."""


@dataclass(frozen=True, slots=True)
class ActuatorFaults:
    """Actuators that work or fail in every sample: ``u`` arrives as ``gamma * u``.

    ``"common"``: all inputs fail together (and whenever there is one input); ``"independent"``;
    ``"covariance"``: as stated.
    """

    success_rate: tuple[Expression, ...]  # Pr(gamma_i = 1), one if common; empty if unknown
    dependence: Dependence
    covariance: Matrix | None = None  # (q, q), of gamma

    def chain(self, model: Model, parameters: Mapping[str, float] = NO_PARAMETERS) -> ModeChain:
        """The patterns of inputs that work (1) or fail (0), as modes that are drawn anew."""
        rates = np.array([evaluate(rate, parameters) for rate in self.success_rate])
        patterns = list(product((1.0, 0.0), repeat=model.nu))
        if self.dependence == "common":
            patterns, law = [patterns[0], patterns[-1]], np.array([rates[0], 1.0 - rates[0]])
        elif self.covariance is None:
            law = np.prod(np.where(np.array(patterns) > 0.0, rates, 1.0 - rates), axis=1)
        else:
            found = pattern_law(rates, self.covariance.values(parameters))
            if found is None:
                raise InternalError("a covariance of inputs that no joint law has")
            law = found
        modes = tuple(
            Mode(
                A=model.A,
                B=_masked(model.B, pattern),
                C=model.C,
                D=_masked(model.D, pattern),
                Q=model.Q,
                R=model.R,
                c=Matrix.zeros(model.nx, 1),
            )
            for pattern in patterns
        )
        initial = tuple(law.tolist())
        return ModeChain(modes, (initial,) * len(modes), initial)

    def plain(self) -> dict[str, object]:
        """Return the table a spec file would hold."""
        table: dict[str, object] = {"dependence": self.dependence}
        if self.success_rate:
            table["success_rate"] = [
                rate.value if isinstance(rate, Number) else to_text(rate)
                for rate in self.success_rate
            ]
        if self.covariance is not None:
            table["covariance"] = self.covariance.plain()
        return table


def _masked(matrix: Matrix, pattern: Sequence[float]) -> Matrix:
    """The columns of the inputs that work, zeros for the others."""
    rows = (zip(row, pattern, strict=True) for row in matrix.rows)
    return Matrix(tuple(tuple(entry if works else ZERO for entry, works in row) for row in rows))


def read_actuator_faults(
    table: object,
    place: Place,
    defaults: Mapping[str, float],
    model: Model,
    family: str,
    *,
    rate_known: bool = True,
) -> ActuatorFaults:
    """The actuator faults that a table describes, for a family that is told the rate or not."""
    if not model.nu:
        raise (
            Place(place.file)
            .entry("model")
            .entry("B")
            .error("nothing (no input)", f"B: the family {family} is about faults of the input")
        )
    reader = _ActuatorReader(table, place, defaults, model.nu)
    return reader.known_rate() if rate_known else reader.unknown_rate()


class _ActuatorReader:
    """Reads one section ``faults.actuator``."""

    def __init__(
        self, table: object, place: Place, defaults: Mapping[str, float], inputs: int
    ) -> None:
        self.section = Section(table, place, known=("success_rate", "dependence", "covariance"))
        self.place, self.defaults, self.inputs = place, defaults, inputs

    def unknown_rate(self) -> ActuatorFaults:
        """Read the section for a family that finds the rate out itself."""
        if "covariance" in self.section:
            raise self.place.entry("covariance").error(
                "a covariance", "none for the family mme: it follows from each hypothesis"
            )
        if self.section.table.get("dependence") == "covariance":
            raise self.place.entry("dependence").error(
                "'covariance'", "common or independent for the family mme"
            )
        dependence = self.dependence()
        given = "success_rate" in self.section
        return ActuatorFaults(self.rates(dependence) if given else (), dependence)

    def known_rate(self) -> ActuatorFaults:
        """Read the section for a family that is told the rate."""
        dependence = self.dependence()
        rates = self.rates(dependence)
        if "covariance" not in self.section:
            return ActuatorFaults(rates, dependence)
        covariance = self.joint(rates)
        if dependence == "common":  # one input: the covariance says nothing that the rate does not
            return ActuatorFaults(rates, dependence)
        return ActuatorFaults(rates, dependence, covariance)

    def dependence(self) -> Dependence:
        place = self.place.entry("dependence")
        given: Dependence = "covariance" if "covariance" in self.section else "common"
        stated = self.section.choice("dependence", _DEPENDENCES, given)
        if "covariance" in self.section and stated != "covariance" and self.inputs > 1:
            raise place.error(f"'{stated}' beside a covariance", "only one of the two")
        if stated == "covariance":
            self.section.require(
                "covariance", f"a ({self.inputs}, {self.inputs}) covariance of gamma"
            )
        if self.inputs == 1:
            return "common"
        if "dependence" not in self.section and "covariance" not in self.section:
            raise place.error(
                f"nothing (the key is missing) with {self.inputs} inputs",
                "common or independent, or a covariance: they give different filters",
            )
        return stated

    def rates(self, dependence: Dependence) -> tuple[Expression, ...]:
        place = self.place.entry("success_rate")
        count = self.inputs
        expected = f"a rate in [0, 1], or a list of {count}: one per input"
        given = plain_entry(self.section.require("success_rate", expected), place)
        plain = plain_list(given, place)
        if not isinstance(plain, list):
            rate = self.rate(plain, place)
            return (rate,) if dependence == "common" else (rate,) * count
        single = dependence == "common" and len(plain) == 1
        if len(plain) != count and not single:
            raise place.error(f"{len(plain)} rates", expected)
        rates = tuple(self.rate(entry, place.item(i)) for i, entry in enumerate(plain))
        if dependence != "common":
            return rates
        if len(set(rates)) > 1:
            raise place.error(
                "different rates with dependence 'common'", "one rate: common faults hit all inputs"
            )
        return rates[:1]

    def rate(self, value: object, place: Place) -> Expression:
        rate = read_entry(value, place, self.defaults)
        number = evaluate(rate, self.defaults)
        if not 0.0 <= number <= 1.0:
            at = "" if isinstance(rate, Number) else f" at the defaults ({to_text(rate)})"
            raise place.error(f"{number!r}{at}", "a probability in [0, 1]")
        return rate

    def joint(self, rates: tuple[Expression, ...]) -> Matrix:
        place = self.place.entry("covariance")
        role = Role(self.inputs, self.inputs, "it is the covariance of gamma, one row per input")
        matrix = read_matrix(self.section.table["covariance"], place, role, self.defaults)
        matrix = checked_covariance(matrix, place, self.defaults)
        values = matrix.values(self.defaults)
        xi = [evaluate(rate, self.defaults) for rate in rates]
        for i, rate in enumerate(rates):
            self.check_variance(matrix.rows[i][i], rate, place.item(i, i))
            for j in range(i):
                _check_joint(float(values[i, j]), (xi[i], xi[j]), place.item(i, j))
        return matrix

    def check_variance(self, variance: Expression, rate: Expression, place: Place) -> None:
        """Refuse a diagonal entry that does not follow from the rate, near the defaults too."""
        for point in nearby(self.defaults):
            try:
                given, xi = evaluate(variance, point), evaluate(rate, point)
            except ArithmeticError:  # outside the domain: this point says nothing
                continue
            expected = xi * (1.0 - xi)
            if abs(given - expected) > JOINT_TOLERANCE:
                moved = "" if point == self.defaults else f" for success_rate = {xi:.6g}"
                raise place.error(
                    f"{given!r}{moved}",
                    f"success_rate * (1 - success_rate) = {expected:.6g} on the diagonal",
                )


def _check_joint(covariance: float, rates: tuple[float, float], place: Place) -> None:
    """Refuse a covariance for which Pr(both work) cannot be a probability."""
    product = rates[0] * rates[1]
    low, high = max(0.0, sum(rates) - 1.0) - product, min(rates) - product
    if not low - JOINT_TOLERANCE <= covariance <= high + JOINT_TOLERANCE:
        raise place.error(
            f"{covariance!r}, so Pr(both work) = {covariance + product:.6g}",
            f"a covariance in [{low:.6g}, {high:.6g}]: Pr(both work) is a joint probability",
        )
