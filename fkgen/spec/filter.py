"""The filter: its family and what the family has to know."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from fkgen.spec.faults import ActuatorFaults
from fkgen.spec.foreign import plain_list
from fkgen.spec.place import Place, show, suggestion
from fkgen.spec.section import LATER, Section, as_list, as_number

Likelihood = Literal["mixture", "gaussian"]

FAMILIES = ("kf", "mkf", "mme")
LATER_FAMILIES = (
    *("one_step", "imm", "linear_optimal", "genie", "mjls_lmmse"),
    *("compression_full", "dfcf", "cpcf"),
)
_LIKELIHOODS: tuple[Likelihood, ...] = ("mixture", "gaussian")
_HYPOTHESIS_KEYS = ("hypotheses", "prior", "weight_floor", "likelihood")
_LATER_KEYS = ("covariance", "modes", "detector", "alpha", "maintenance")
DEFAULT_FLOOR = 1e-6
SUM_TOLERANCE = 1e-9


@dataclass(frozen=True, slots=True)
class Filter:
    """A family and its options; only ``mme`` has any so far.

    Parameters
    ----------
    family : str
        ``"kf"``, ``"mkf"`` or ``"mme"``.
    hypotheses : tuple of tuple of float
        The N success rates that are tried, each as long as ``ActuatorFaults.success_rate`` is.
    prior : tuple of float
        Their N probabilities at the start; they sum to one.
    weight_floor : float
        Every hypothesis keeps this probability, in [0, 1/N).
    likelihood : str
        ``"mixture"`` (exact for the present sample) or ``"gaussian"``.
    """

    family: str
    hypotheses: tuple[tuple[float, ...], ...] = ()
    prior: tuple[float, ...] = ()
    weight_floor: float = DEFAULT_FLOOR
    likelihood: Likelihood = "mixture"

    def plain(self) -> dict[str, object]:
        """Return the table a spec file would hold."""
        if not self.hypotheses:
            return {"family": self.family}
        return {
            "family": self.family,
            "hypotheses": [list(hypothesis) for hypothesis in self.hypotheses],
            "prior": list(self.prior),
            "weight_floor": self.weight_floor,
            "likelihood": self.likelihood,
        }


def filter_section(table: object, place: Place) -> Section:
    """Return the section ``filter``, its keys checked and its family known to exist.

    Raises
    ------
    SpecError
        If the family is missing or unknown, or a key is unknown or belongs to another family.
    """
    section = Section(table, place, known=("family", *_HYPOTHESIS_KEYS), later=_LATER_KEYS)
    expected = f"one of {', '.join(FAMILIES)}"
    family = section.require("family", expected)
    where = place.entry("family")
    if isinstance(family, str) and family in LATER_FAMILIES:
        raise where.error(show(family), f"{expected}; {family} {LATER}")
    if not isinstance(family, str) or family not in FAMILIES:
        hint = suggestion(family, FAMILIES + LATER_FAMILIES) if isinstance(family, str) else ""
        raise where.error(show(family), expected + hint)
    for key in _HYPOTHESIS_KEYS:
        if family != "mme" and key in section:
            raise place.entry(key).error(
                f"{key} for the family {family}", f"{key} only for the family mme"
            )
    return section


def read_filter(section: Section, actuator: ActuatorFaults | None, inputs: int) -> Filter:
    """Return the filter that a section describes.

    Parameters
    ----------
    section : Section
        From `filter_section`.
    actuator : ActuatorFaults or None
        The faults; their dependence says how long a hypothesis is.
    inputs : int
        Number of inputs, q.

    Raises
    ------
    SpecError
        If a hypothesis, the prior or the floor is impossible.
    """
    family = str(section.table["family"])
    if family != "mme":
        return Filter(family)
    common = actuator is None or actuator.dependence == "common"
    hypotheses = _hypotheses(section, 1 if common else inputs)
    return Filter(
        family,
        hypotheses=hypotheses,
        prior=_prior(section, len(hypotheses)),
        weight_floor=_floor(section, len(hypotheses)),
        likelihood=section.choice("likelihood", _LIKELIHOODS, "mixture"),
    )


def _hypotheses(section: Section, length: int) -> tuple[tuple[float, ...], ...]:
    place = section.place.entry("hypotheses")
    each = "a rate in [0, 1]" if length == 1 else f"a rate in [0, 1] or a list of {length}"
    expected = f"a list of hypotheses, each {each}"
    entries = as_list(section.require("hypotheses", expected), place, expected)
    if not entries:
        raise place.error("an empty list", "at least one hypothesis")
    return tuple(
        _hypothesis(entry, place.item(index), length) for index, entry in enumerate(entries)
    )


def _hypothesis(entry: object, place: Place, length: int) -> tuple[float, ...]:
    rates = plain_list(entry, place)
    if not isinstance(rates, list):
        return (_probability(entry, place),) * length
    if len(rates) != length:
        reason = "the faults are common" if length == 1 else "one per input"
        raise place.error(f"{len(rates)} rates", f"{length}: {reason}")
    return tuple(_probability(rate, place.item(index)) for index, rate in enumerate(rates))


def _probability(value: object, place: Place) -> float:
    number = as_number(value, place, "a probability in [0, 1]")
    if not 0.0 <= number <= 1.0:
        raise place.error(show(number), "a probability in [0, 1]")
    return number


def _prior(section: Section, count: int) -> tuple[float, ...]:
    if "prior" not in section:
        return (1.0 / count,) * count
    place = section.place.entry("prior")
    expected = f"a list of {count} probabilities, one per hypothesis"
    entries = as_list(section.table["prior"], place, expected)
    if len(entries) != count:
        raise place.error(f"{len(entries)} entries", expected)
    prior = tuple(_probability(entry, place.item(index)) for index, entry in enumerate(entries))
    if abs(sum(prior) - 1.0) > SUM_TOLERANCE:
        raise place.error(f"probabilities that sum to {sum(prior):.12g}", "a sum of 1")
    return prior


def _floor(section: Section, count: int) -> float:
    if "weight_floor" not in section:
        return DEFAULT_FLOOR
    place = section.place.entry("weight_floor")
    expected = f"a number in [0, 1/{count}): {count} hypotheses share the probability 1"
    floor = as_number(section.table["weight_floor"], place, expected)
    if not 0.0 <= floor < 1.0 / count:
        raise place.error(show(floor), expected)
    return floor
