"""The filter: its family and what the family has to know."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from fkgen.spec.actuator_faults import ActuatorFaults
from fkgen.spec.faults import SECTIONS
from fkgen.spec.foreign import plain_list
from fkgen.spec.place import Place, show, suggestion
from fkgen.spec.probability import as_distribution, as_probability
from fkgen.spec.section import LATER, Section, as_list, as_number

Likelihood = Literal["mixture", "gaussian"]
CovarianceReading = Literal["moment_matched", "weighted", "paper", "paper_nominal"]
LinearForm = Literal["lemma2", "augmented"]
Maintenance = Literal["optimal", "paper"]

FAMILIES = ("kf", *SECTIONS)
LATER_FAMILIES = ("mjls_lmmse",)
_LIKELIHOODS: tuple[Likelihood, ...] = ("mixture", "gaussian")
_READINGS: tuple[CovarianceReading, ...] = ("moment_matched", "weighted", "paper", "paper_nominal")
_FORMS: tuple[LinearForm, ...] = ("lemma2", "augmented")
_MAINTENANCE: tuple[Maintenance, ...] = ("optimal", "paper")

#: Which options a family has, besides ``family``.
OPTIONS: dict[str, tuple[str, ...]] = {
    "mme": ("hypotheses", "prior", "weight_floor", "likelihood"),
    "one_step": ("covariance",),
    "imm": ("modes",),
    "linear_optimal": ("form",),
    "compression_full": ("test", "reacquire"),
    "dfcf": ("test", "reacquire"),
    "cpcf": ("test", "reacquire", "maintenance"),
}
_KEYS = tuple(dict.fromkeys(key for keys in OPTIONS.values() for key in keys))
_LATER_KEYS = ("detector", "alpha")
DEFAULT_FLOOR = 1e-6

#: A float counts exactly up to 2^24.
MOST_REJECTIONS = 10_000_000


@dataclass(frozen=True, slots=True)
class Filter:
    """A family and its options; those of other families have their defaults.

    Parameters
    ----------
    family : str
        One of `FAMILIES`.
    hypotheses : tuple of tuple of float
        ``mme``: the N success rates that are tried, each as long as
        ``ActuatorFaults.success_rate`` is.
    prior : tuple of float
        ``mme``: their N probabilities at the start; they sum to one.
    weight_floor : float
        ``mme``: every hypothesis keeps this probability, in [0, 1/N).
    likelihood : str
        ``mme``: ``"mixture"`` (exact for the present sample) or ``"gaussian"``.
    covariance : str
        ``one_step``: how (7) is read; ``"moment_matched"``, ``"weighted"``, ``"paper"`` or
        ``"paper_nominal"``.
    modes : int
        ``imm``: 4, or 3 (without signal, both noise levels are one mode).
    form : str
        ``linear_optimal``: ``"lemma2"`` (23) or ``"augmented"``.
    test : bool
        Compression filters: False reports the statistic and rejects nothing.
    reacquire : int or None
        Compression filters: rejections in a row from which on the host is inflated; None: never.
    maintenance : str
        ``cpcf``: ``"optimal"`` or ``"paper"`` (44).
    """

    family: str
    hypotheses: tuple[tuple[float, ...], ...] = ()
    prior: tuple[float, ...] = ()
    weight_floor: float = DEFAULT_FLOOR
    likelihood: Likelihood = "mixture"
    covariance: CovarianceReading = "moment_matched"
    modes: int = 4
    form: LinearForm = "lemma2"
    test: bool = True
    reacquire: int | None = None
    maintenance: Maintenance = "optimal"

    def plain(self) -> dict[str, object]:
        """Return the table a spec file would hold."""
        table: dict[str, object] = {"family": self.family}
        for key in OPTIONS.get(self.family, ()):
            value = getattr(self, key)
            if value is not None:
                table[key] = _listed(value) if isinstance(value, tuple) else value
        return table


def _listed(value: tuple[object, ...]) -> list[object]:
    return [list(entry) if isinstance(entry, tuple) else entry for entry in value]


def filter_section(table: object, place: Place) -> Section:
    """Return the section ``filter``, its keys checked and its family known to exist.

    Raises
    ------
    SpecError
        If the family is missing or unknown, or a key is unknown or belongs to another family.
    """
    section = Section(table, place, known=("family", *_KEYS), later=_LATER_KEYS)
    expected = f"one of {', '.join(FAMILIES)}"
    family = section.require("family", expected)
    where = place.entry("family")
    if isinstance(family, str) and family in LATER_FAMILIES:
        raise where.error(show(family), f"{expected}; {family} {LATER}")
    if not isinstance(family, str) or family not in FAMILIES:
        hint = suggestion(family, FAMILIES + LATER_FAMILIES) if isinstance(family, str) else ""
        raise where.error(show(family), expected + hint)
    for key in _KEYS:
        owners = [name for name, keys in OPTIONS.items() if key in keys]
        if family not in owners and key in section:
            able = f"the family {owners[0]}" if len(owners) == 1 else ", ".join(owners)
            given = f"{key} for the family {family}"
            raise place.entry(key).error(given, f"{key} only for {able}")
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
        return Filter(
            family,
            covariance=section.choice("covariance", _READINGS, "moment_matched"),
            modes=_modes(section),
            form=section.choice("form", _FORMS, "lemma2"),
            test=section.flag("test", default=True),
            reacquire=_reacquire(section),
            maintenance=section.choice("maintenance", _MAINTENANCE, "optimal"),
        )
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
        return (as_probability(entry, place),) * length
    if len(rates) != length:
        reason = "the faults are common" if length == 1 else "one per input"
        raise place.error(f"{len(rates)} rates", f"{length}: {reason}")
    return tuple(as_probability(rate, place.item(index)) for index, rate in enumerate(rates))


def _prior(section: Section, count: int) -> tuple[float, ...]:
    if "prior" not in section:
        return (1.0 / count,) * count
    place = section.place.entry("prior")
    return as_distribution(section.table["prior"], place, count, "one per hypothesis")


def _modes(section: Section) -> int:
    place = section.place.entry("modes")
    expected = "4, or 3: the modes without signal are one, with the mixture of their likelihoods"
    number = as_number(section.table.get("modes", 4), place, expected)
    if number not in {3.0, 4.0}:
        raise place.error(show(number), expected)
    return int(number)


def _reacquire(section: Section) -> int | None:
    if "reacquire" not in section:
        return None
    place = section.place.entry("reacquire")
    expected = "a whole number of rejections in a row, at least 1; leave it out for never"
    number = as_number(section.table["reacquire"], place, expected)
    if number != int(number) or not 1 <= number <= MOST_REJECTIONS:
        raise place.error(show(number), expected)
    if not section.flag("test", default=True):
        raise place.error("reacquire with test = false", "a test: without it nothing is rejected")
    return int(number)


def _floor(section: Section, count: int) -> float:
    if "weight_floor" not in section:
        return DEFAULT_FLOOR
    place = section.place.entry("weight_floor")
    expected = f"a number in [0, 1/{count}): {count} hypotheses share the probability 1"
    floor = as_number(section.table["weight_floor"], place, expected)
    if not 0.0 <= floor < 1.0 / count:
        raise place.error(show(floor), expected)
    return floor
