"""The filter: its family and what the family has to know.

Read the options of a filter: what the family has to know besides the faults.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from fkgen.problem.probability import as_distribution, as_probability
from fkgen.problem.table.place import Place, show, suggestion
from fkgen.problem.table.section import Section, as_list, as_number
from fkgen.problem.text.foreign import plain_list

if TYPE_CHECKING:
    from fkgen.faults.jump import JumpFaults
    from fkgen.faults.section import Faults

Likelihood = Literal["mixture", "gaussian"]
CovarianceReading = Literal["moment_matched", "weighted", "paper", "paper_nominal"]
LinearForm = Literal["lemma2", "augmented"]
Detector = Literal["none", "llr", "nis", "energy"]
Gain = Literal["time_varying", "stationary"]
Maintenance = Literal["optimal", "paper"]

#: The section of ``faults`` that each family is about, or those of which it takes one; kf knows no
#: faults.
SECTIONS: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("mkf", "mme"), ("actuator",)),
    **dict.fromkeys(("linear_optimal", "one_step"), ("sensor",)),
    "imm": ("sensor", "jump"),
    "genie": ("sensor",),
    "mjls_lmmse": ("jump",),
    **dict.fromkeys(("compression_full", "dfcf", "cpcf"), ("soft",)),
}

FAMILIES = ("kf", *SECTIONS)
LIKELIHOODS: tuple[Likelihood, ...] = ("mixture", "gaussian")
READINGS: tuple[CovarianceReading, ...] = ("moment_matched", "weighted", "paper", "paper_nominal")
FORMS: tuple[LinearForm, ...] = ("lemma2", "augmented")
DETECTORS: tuple[Detector, ...] = ("none", "llr", "nis", "energy")
GAINS: tuple[Gain, ...] = ("time_varying", "stationary")
MAINTENANCE: tuple[Maintenance, ...] = ("optimal", "paper")

#: Which options a family has, besides ``family``.
OPTIONS: dict[str, tuple[str, ...]] = {
    "mme": ("hypotheses", "prior", "weight_floor", "likelihood"),
    "one_step": ("covariance",),
    "imm": ("modes",),
    "linear_optimal": ("form",),
    "mjls_lmmse": (
        *("detector", "alpha", "kappa", "window"),
        *("lock_out", "reinitialise", "gain"),
    ),
    "compression_full": ("test", "reacquire"),
    "dfcf": ("test", "reacquire"),
    "cpcf": ("test", "reacquire", "maintenance"),
}
_KEYS = tuple(dict.fromkeys(key for keys in OPTIONS.values() for key in keys))
DEFAULT_FLOOR = 1e-6
DEFAULT_ALPHA = 0.01

#: Options that only some detectors have.
OF_DETECTORS: dict[str, tuple[Detector, ...]] = {
    "alpha": ("nis",),
    "kappa": ("energy",),
    "window": ("energy",),
    "lock_out": ("llr", "nis", "energy"),
    "reinitialise": ("llr", "nis", "energy"),
}


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
        ``imm``: of sensor faults 4, or 3 (without signal, both noise levels are one mode); of jump
        faults as many as the plant has.
    form : str
        ``linear_optimal``: ``"lemma2"`` (23) or ``"augmented"``.
    detector : str
        ``mjls_lmmse``: the test whether a sample was lost; ``"none"``, ``"llr"``, ``"nis"`` or
        ``"energy"``.
    alpha : float
        Of ``"nis"``: its rate of false alarms, in (0, 1).
    kappa, window : float and int
        Of ``"energy"``: a loss is declared when the mean of |r|^2 over the last ``window`` samples
        exceeds ``kappa`` times its expectation.
    lock_out : int
        With a detector: from this many rejections in a row on, the status says so.
    reinitialise : bool
        Whether a lock-out starts the filter again from the unconditional moments.
    gain : str
        ``mjls_lmmse``: ``"time_varying"`` or ``"stationary"``.
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
    detector: Detector = "none"
    alpha: float = DEFAULT_ALPHA
    kappa: float = 1.0
    window: int = 1
    lock_out: int = 10
    reinitialise: bool = False
    gain: Gain = "time_varying"
    test: bool = True
    reacquire: int | None = None
    maintenance: Maintenance = "optimal"

    def plain(self) -> dict[str, object]:
        """Return the table a spec file would hold."""
        table: dict[str, object] = {"family": self.family}
        for key in OPTIONS.get(self.family, ()):
            value = getattr(self, key)
            if value is None or (key in OF_DETECTORS and self.detector not in OF_DETECTORS[key]):
                continue
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
    section = Section(table, place, known=("family", *_KEYS))
    expected = f"one of {', '.join(FAMILIES)}"
    family = section.require("family", expected)
    where = place.entry("family")
    if not isinstance(family, str) or family not in FAMILIES:
        hint = suggestion(family, FAMILIES) if isinstance(family, str) else ""
        raise where.error(show(family), expected + hint)
    for key in _KEYS:
        owners = [name for name, keys in OPTIONS.items() if key in keys]
        if family not in owners and key in section:
            able = f"the family {owners[0]}" if len(owners) == 1 else ", ".join(owners)
            given = f"{key} for the family {family}"
            raise place.entry(key).error(given, f"{key} only for {able}")
    return section


LONGEST_WINDOW = 100

#: A float counts exactly up to 2^24.
MOST_REJECTIONS = 10_000_000


def read_filter(section: Section, faults: Faults, inputs: int) -> Filter:
    """Return the filter that a section describes.

    Parameters
    ----------
    section : Section
        From `filter_section`.
    faults : Faults
        The dependence of actuator faults says how long a hypothesis is.
    inputs : int
        Number of inputs, q.

    Raises
    ------
    SpecError
        If a hypothesis, the prior, the floor or an option of a detector is impossible.
    """
    family = str(section.table["family"])
    if family == "mjls_lmmse":
        return _read_detection(section)
    if family != "mme":
        return Filter(
            family,
            covariance=section.choice("covariance", READINGS, "moment_matched"),
            modes=_modes(section) if faults.jump is None else _jump_modes(section, faults.jump),
            form=section.choice("form", FORMS, "lemma2"),
            test=section.flag("test", default=True),
            reacquire=_reacquire(section),
            maintenance=section.choice("maintenance", MAINTENANCE, "optimal"),
        )
    common = faults.actuator is None or faults.actuator.dependence == "common"
    hypotheses = _hypotheses(section, 1 if common else inputs)
    return Filter(
        family,
        hypotheses=hypotheses,
        prior=_prior(section, len(hypotheses)),
        weight_floor=_floor(section, len(hypotheses)),
        likelihood=section.choice("likelihood", LIKELIHOODS, "mixture"),
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


def _jump_modes(section: Section, faults: JumpFaults) -> int:
    """The number of modes of the plant; it may be repeated here."""
    place, count = section.place.entry("modes"), len(faults.modes)
    expected = f"{count}, the number of faults.jump.modes, or no such key"
    if as_number(section.table.get("modes", count), place, expected) != count:
        raise place.error(show(section.table["modes"]), expected)
    return count


def _reacquire(section: Section) -> int | None:
    if "reacquire" not in section:
        return None
    limit = _count(
        section, "reacquire", 1, MOST_REJECTIONS, "rejections in a row (leave it out for never)"
    )
    if not section.flag("test", default=True):
        raise section.place.entry("reacquire").error(
            "reacquire with test = false", "a test: without it nothing is rejected"
        )
    return limit


def _floor(section: Section, count: int) -> float:
    if "weight_floor" not in section:
        return DEFAULT_FLOOR
    place = section.place.entry("weight_floor")
    expected = f"a number in [0, 1/{count}): {count} hypotheses share the probability 1"
    floor = as_number(section.table["weight_floor"], place, expected)
    if not 0.0 <= floor < 1.0 / count:
        raise place.error(show(floor), expected)
    return floor


def _read_detection(section: Section) -> Filter:
    """Options of ``mjls_lmmse``; ``detector = true`` is the one that is recommended."""
    if isinstance(section.table.get("detector"), bool):
        section.table["detector"] = "llr" if section.table["detector"] else "none"
    detector = section.choice("detector", DETECTORS, "none")
    for key, owners in OF_DETECTORS.items():
        if key in section and detector not in owners and key != "alpha":
            raise section.place.entry(key).error(
                f"{key} with detector = '{detector}'", f"{key} only with {' or '.join(owners)}"
            )
    return Filter(
        "mjls_lmmse",
        detector=detector,
        alpha=_positive(section, "alpha", DEFAULT_ALPHA, below=1.0),
        kappa=_positive(section, "kappa", 1.0),
        window=_count(section, "window", 1, LONGEST_WINDOW),
        lock_out=_count(section, "lock_out", 10, 10**6),
        reinitialise=section.flag("reinitialise", default=False),
        gain=section.choice("gain", GAINS, "time_varying"),
    )


def _positive(section: Section, key: str, default: float, below: float = math.inf) -> float:
    place = section.place.entry(key)
    expected = "a positive number" if below == math.inf else f"a number in (0, {below:g})"
    number = as_number(section.table.get(key, default), place, expected)
    if not 0.0 < number < below:
        raise place.error(show(number), expected)
    return number


def _count(section: Section, key: str, default: int, largest: int, what: str = "samples") -> int:
    place = section.place.entry(key)
    expected = f"a number of {what}, a whole number in 1..{largest}"
    number = as_number(section.table.get(key, default), place, expected)
    if number != int(number) or not 1 <= number <= largest:
        raise place.error(show(section.table[key]), expected)
    return int(number)
