"""Multiple model estimation of an unknown fault rate: a bank of modified Kalman filters.

Strandt, Schneider & Yaz, sec. 3: one hypothesis per success rate, weighted by Bayes' rule (14)-(16)
with the mixture likelihood (exact in gamma[k]) or the paper's Gaussian (15).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal, Self, get_args

from fkgen.errors import DataError
from fkgen.families.family import Family, Table, built_by, proved_by
from fkgen.faults import Faults
from fkgen.faults.actuator import read_actuator_faults
from fkgen.problem import Model, Spec
from fkgen.problem.filter import Options, Traits
from fkgen.problem.probability import as_distribution, as_probability
from fkgen.problem.table.place import Place, show
from fkgen.problem.table.section import Section, as_list, as_number
from fkgen.problem.text.foreign import plain_list

Likelihood = Literal["mixture", "gaussian"]
DEFAULT_FLOOR = 1e-6


@dataclass(frozen=True, slots=True)
class MmeOptions(Options):
    """Hypotheses and their weights."""

    #: The N success rates that are tried, each as long as ActuatorFaults.success_rate is
    hypotheses: tuple[tuple[float, ...], ...]
    prior: tuple[float, ...]  # Their N probabilities at the start; they sum to one
    weight_floor: float = DEFAULT_FLOOR  # Every hypothesis keeps this probability, in [0, 1/N)
    likelihood: Likelihood = "mixture"  # "mixture" (exact for the present sample) or "gaussian"

    @classmethod
    def read(cls, section: Section, faults: Faults, model: Model) -> Self:
        """Hypotheses, each of one rate where the inputs fail together."""
        common = faults.actuator is None or faults.actuator.dependence == "common"
        hypotheses = _hypotheses(section, 1 if common else model.nu)
        count, place = len(hypotheses), section.place.entry("prior")
        prior = (1.0 / count,) * count
        if "prior" in section:
            prior = as_distribution(section.table["prior"], place, count, "one per hypothesis")
        return cls(
            hypotheses,
            prior,
            _floor(section, count),
            section.choice("likelihood", get_args(Likelihood), "mixture"),
        )


def _hypotheses(section: Section, length: int) -> tuple[tuple[float, ...], ...]:
    place = section.place.entry("hypotheses")
    each = "a rate in [0, 1]" if length == 1 else f"a rate in [0, 1] or a list of {length}"
    expected = f"a list of hypotheses, each {each}"
    entries = as_list(section.require("hypotheses", expected), place, expected)
    if not entries:
        raise place.error("an empty list", "at least one hypothesis")
    return tuple(_hypothesis(entry, place.item(i), length) for i, entry in enumerate(entries))


def _hypothesis(entry: object, place: Place, length: int) -> tuple[float, ...]:
    rates = plain_list(entry, place)
    if not isinstance(rates, list):
        return (as_probability(entry, place),) * length
    if len(rates) != length:
        reason = "the faults are common" if length == 1 else "one per input"
        raise place.error(f"{len(rates)} rates", f"{length}: {reason}")
    return tuple(as_probability(rate, place.item(index)) for index, rate in enumerate(rates))


def _floor(section: Section, count: int) -> float:
    place = section.place.entry("weight_floor")
    expected = f"a number in [0, 1/{count}): {count} hypotheses share the probability 1"
    floor = as_number(section.table.get("weight_floor", DEFAULT_FLOOR), place, expected)
    if not 0.0 <= floor < 1.0 / count:
        raise place.error(show(floor), expected)
    return floor


def with_hypotheses(table: Table, _: Spec) -> Table:
    """The same faults; what is tried for their rate cannot be guessed."""
    if "hypotheses" in table["filter"]:
        return table
    raise DataError(
        "families",
        given="'mme' for a spec without hypotheses",
        expected="a spec of its own beside this one: mme needs filter.hypotheses",
    )


FAMILY = Family(
    name="mme",
    title="unknown actuator fault rate: a bank of modified Kalman filters, one per hypothesis",
    build=built_by("models.bank:multiple_model_bank"),
    proof=proved_by(
        "gaussian",
        "MME_TEXTBOOK",
        "MME_BATCH",
        "nonlinear:LINEARISED_BANK",
        theorems="mkf:IDENTITIES",
    ),
    traits=Traits(models="bank", densities=True, nonlinear=True),
    options=MmeOptions,
    accepts={"actuator": partial(read_actuator_faults, rate_known=False)},
    optional_faults=True,
    adopt=with_hypotheses,
    starter="starter_mme.toml",
)
