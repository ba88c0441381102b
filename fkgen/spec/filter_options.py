"""Read the options of a filter: what the family has to know besides the faults."""

from __future__ import annotations

import math

from fkgen.spec.faults import Faults
from fkgen.spec.filter import (
    DEFAULT_ALPHA,
    DEFAULT_FLOOR,
    DETECTORS,
    FORMS,
    GAINS,
    LIKELIHOODS,
    MAINTENANCE,
    OF_DETECTORS,
    READINGS,
    Filter,
)
from fkgen.spec.foreign import plain_list
from fkgen.spec.jump_faults import JumpFaults
from fkgen.spec.place import Place, show
from fkgen.spec.probability import as_distribution, as_probability
from fkgen.spec.section import Section, as_list, as_number

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
