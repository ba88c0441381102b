"""Actuators that fail intermittently: rates, and how the faults of several inputs depend."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fkgen.problem.covariance import values_nearby
from fkgen.problem.model import Model
from fkgen.problem.probability import as_rate
from fkgen.problem.table.place import Place
from fkgen.problem.table.section import Section
from fkgen.problem.text.expression import Expression, evaluate
from fkgen.problem.text.foreign import plain_entry, plain_list
from fkgen.problem.text.matrix import Matrix, plain_fields

Dependence = Literal["common", "independent", "covariance"]

#: Absolute tolerance of probabilities computed from a covariance that a user typed.
JOINT_TOLERANCE = 1e-9


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


@dataclass(frozen=True, slots=True)
class ActuatorFaults:
    """Actuators that work or fail in every sample: ``u`` arrives as ``gamma * u``.

    ``"common"``: all inputs fail together (and whenever there is one input); ``"independent"``;
    ``"covariance"``: as stated.
    """

    success_rate: tuple[Expression, ...]  # Pr(gamma_i = 1), one if common; empty if unknown
    dependence: Dependence
    covariance: Matrix | None = None  # (q, q), of gamma

    def plain(self) -> dict[str, object]:
        """Return the table a spec file would hold."""
        return {key: value for key, value in plain_fields(self).items() if value != []}


def read_actuator_faults(
    section: Section, model: Model, family: str, *, rate_known: bool = True
) -> ActuatorFaults:
    """The actuator faults that a table describes, for a family that is told the rate or not."""
    if not model.nu:
        expected = f"B: the family {family} is about faults of the input"
        raise Place(section.place.file, "model.B").error("nothing (no input)", expected)
    if not rate_known:
        if "covariance" in section:
            expected = "none for the family mme: it follows from each hypothesis"
            raise section.error("covariance", "a covariance", expected)
        if section.table.get("dependence") == "covariance":
            expected = "common or independent for the family mme"
            raise section.error("dependence", "'covariance'", expected)
    dependence = _dependence(section, model.nu)
    rates: tuple[Expression, ...] = ()
    if rate_known or "success_rate" in section:
        rates = _rates(section, dependence, model.nu)
    covariance = _covariance(section, rates, model.nu) if "covariance" in section else None
    # With one input the covariance says nothing that the rate does not.
    return ActuatorFaults(rates, dependence, None if dependence == "common" else covariance)


def _dependence(section: Section, inputs: int) -> Dependence:
    stated = "covariance" in section
    found: Dependence = section.choice(
        "dependence", get_args(Dependence), "covariance" if stated else "common"
    )
    if stated and found != "covariance" and inputs > 1:
        raise section.error("dependence", f"'{found}' beside a covariance", "only one of the two")
    if found == "covariance":
        section.require("covariance", f"a ({inputs}, {inputs}) covariance of gamma")
    if inputs == 1:
        return "common"
    if not stated and "dependence" not in section:
        raise section.error(
            "dependence",
            f"nothing (the key is missing) with {inputs} inputs",
            "common or independent, or a covariance: they give different filters",
        )
    return found


def _rates(section: Section, dependence: Dependence, count: int) -> tuple[Expression, ...]:
    place, common = section.place.entry("success_rate"), dependence == "common"
    expected = f"a rate in [0, 1], or a list of {count}: one per input"
    given = plain_list(plain_entry(section.require("success_rate", expected), place), place)
    if not isinstance(given, list):
        return (as_rate(given, place, section.defaults),) * (1 if common else count)
    if len(given) != count and not (common and len(given) == 1):
        raise place.error(f"{len(given)} rates", expected)
    rates = tuple(as_rate(rate, place.item(i), section.defaults) for i, rate in enumerate(given))
    if common and len(set(rates)) > 1:
        raise place.error(
            "different rates with dependence 'common'", "one rate: common faults hit all inputs"
        )
    return rates[:1] if common else rates


def _covariance(section: Section, rates: Sequence[Expression], inputs: int) -> Matrix:
    """Return the covariance of gamma, which has to belong to a joint law with these rates."""
    because = "it is the covariance of gamma, one row per input"
    matrix, defaults = section.covariance("covariance", inputs, because), section.defaults
    values, xi = matrix.values(defaults), [evaluate(rate, defaults) for rate in rates]
    for i, rate in enumerate(rates):
        place = section.place.entry("covariance")
        both = Matrix(((matrix.rows[i][i], rate),))
        for point, ((variance, at),) in values_nearby(both, defaults):
            if abs(variance - at * (1.0 - at)) > JOINT_TOLERANCE:
                moved = "" if point == defaults else f" for success_rate = {at:.6g}"
                raise place.item(i, i).error(
                    f"{float(variance)!r}{moved}",
                    f"success_rate * (1 - success_rate) = {at * (1.0 - at):.6g} on the diagonal",
                )
        for j in range(i):
            independent = xi[i] * xi[j]
            low, high = max(0.0, xi[i] + xi[j] - 1.0) - independent, min(xi[i], xi[j]) - independent
            found = float(values[i, j])
            if not low - JOINT_TOLERANCE <= found <= high + JOINT_TOLERANCE:
                raise place.item(i, j).error(
                    f"{found!r}, so Pr(both work) = {found + independent:.6g}",
                    f"a covariance in [{low:.6g}, {high:.6g}]:"
                    " Pr(both work) is a joint probability",
                )
    return matrix
