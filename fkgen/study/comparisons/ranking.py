"""From scores to a table, a Pareto front and one recommendation that the numbers bear out.

Recommended is the cheapest of the filters that are as good as the best, as far as is known.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import DataError
from fkgen.families import family
from fkgen.problem import Spec
from fkgen.study.comparisons.candidates import GENIE, fault_section
from fkgen.study.comparisons.footprint import Footprint
from fkgen.study.comparisons.scores import Detection, Scores
from fkgen.study.reports.jsonable import json_text
from fkgen.trials.errors import error_signals

Array = NDArray[np.float64]

#: Paired differences within so many standard errors may be chance.
TIE = 2.0
#: They are ties if they cannot be larger than this share of the smaller error; else, not decided.
MARGIN = 0.1
#: A filter whose NEES is farther from 1 is not believed about its own error.
HONEST = 0.1

_GENIE_IS = {
    "sensor": "is told gamma and delta of every sample",
    "actuator": "is a Kalman filter that is told what reaches the plant",
    "jump": "is a Kalman filter that is told the mode of every sample, and what was lost",
}


@dataclass(frozen=True, slots=True)
class Estimate:
    """A number and its standard error."""

    value: float
    error: float

    def __str__(self) -> str:
        """The number with as many digits as its error leaves meaning."""
        if not np.isfinite(self.value):
            return "-"
        if not self.error > 0.0:
            return f"{self.value:.4g}"
        digits = int(np.clip(1 - np.floor(np.log10(self.error)), 0, 8))
        return f"{self.value:.{digits}f} +- {self.error:.{digits}f}"

    def root(self) -> Estimate:
        """The square root, with its error by the delta method."""
        root = float(np.sqrt(self.value))
        return Estimate(root, self.error / (2.0 * root) if root > 0.0 else 0.0)


def mean(each: Array) -> Estimate:
    """The mean over trials, of (M,) numbers; NaN where a trial has nothing to say."""
    known = each[np.isfinite(each)]
    return ratio(known, np.ones_like(known)) if known.size else Estimate(np.nan, np.nan)


def ratio(above: Array, below: Array) -> Estimate:
    """The ratio of two means over the same trials, with its error by the delta method."""
    value, influence = influence_of(above, below)
    return Estimate(value, error_of(influence))


def influence_of(above: Array, below: Array) -> tuple[float, Array]:
    """A ratio of means, and how far each trial moves it: (M,), with mean zero.

    Differences of ratios have the differences of these: that is what pairing trials gains.
    """
    total = float(below.mean())
    if not total > 0.0:
        return float("nan"), np.full(above.shape, np.nan)
    value = float(above.mean()) / total
    return value, (above - value * below) / total


def error_of(influence: Array) -> float:
    """Standard error of the mean of numbers with mean zero, one per trial."""
    if influence.size < 2:
        return float("nan")
    return float(np.sqrt((influence**2).sum() / (influence.size - 1) / influence.size))


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """What counts for the choice: error over that of the genie, influence of each trial, costs."""

    label: str
    footprint: Footprint
    value: float
    influence: Array

    @property
    def price(self) -> tuple[int, int, int]:
        """Operations, then code, then memory."""
        costs = self.footprint
        return costs.cost, min(costs.flash.values(), default=0), costs.state

    @property
    def relative(self) -> Estimate:
        """Its error over that of the genie."""
        return Estimate(self.value, error_of(self.influence))

    def gap(self, better: Score) -> Estimate:
        """The paired difference to another one."""
        return Estimate(self.value - better.value, error_of(self.influence - better.influence))

    def not_worse_than(self, other: Score) -> bool:
        """Whether its error is smaller, or a tie, over the same trials."""
        gap = self.gap(other)
        doubt = TIE * gap.error
        tie = gap.value <= doubt and gap.value + doubt <= MARGIN * other.value
        return gap.value <= 0.0 or tie


def beaten(one: Score, everyone: Sequence[Score]) -> bool:
    """Whether a cheaper filter is not worse, or one of the same price is better."""
    rivals = [other for other in everyone if other is not one and other.not_worse_than(one)]
    return any(
        other.price < one.price or (other.price == one.price and not one.not_worse_than(other))
        for other in rivals
    )


def recommended(everyone: Sequence[Score], nees: dict[str, Estimate]) -> tuple[str, str]:
    """The cheapest of those whose error is not worse than the smallest, and why."""
    best = everyone[0]
    ties = [one for one in everyone if one.not_worse_than(best)]
    chosen = min(ties, key=lambda one: one.price)
    about = f"its mean squared error, {chosen.relative} times that of the genie,"
    if len(everyone) == 1:
        why = f"{about} has nothing to be compared with"
    elif chosen is not best:
        share = chosen.footprint.cost / max(1, best.footprint.cost)
        why = (
            f"{about} is that of {best.label} within {TIE:g} standard errors (difference "
            f"{chosen.gap(best)}), at {share:.0%} of the operations"
        )
    elif len(ties) > 1:
        names = " and ".join(one.label for one in ties if one is not best)
        why = f"{about} is the smallest, and {names}, which may be as good, costs no less"
    else:
        second, gap = everyone[1], everyone[1].gap(best)
        why = f"{about} is the smallest, {gap} below that of {second.label}"
        if 0.0 < gap.value <= TIE * gap.error:  # may be chance, and may as well be much larger
            why += ", which more trials would have to decide"
    own = nees[chosen.label]
    if abs(own.value - 1.0) > max(HONEST, TIE * own.error):
        word = "too small" if own.value > 1.0 else "too large"
        why += f"; the covariance that it states is {word} (NEES {own})"
    return chosen.label, f"Take {chosen.label}: {why}."


class Entry(NamedTuple):
    """A filter with everything that was measured of it."""

    label: str
    family: str
    footprint: Footprint
    scores: Scores


@dataclass(frozen=True, slots=True)
class Row:
    """One filter in the table."""

    label: str
    family: str
    relative: Estimate  # Mean squared error over that of the genie, the mean over states
    rmse: dict[str, Estimate]  # Root of the mean squared error by state
    nees: Estimate  # nees, nis: Per dimension: 1 if the filter is right about itself
    nis: Estimate
    detected: Estimate  # Share of the faults that were declared before they ended
    delay: Estimate  # Samples from the onset of those faults to their declaration
    false_alarms: Estimate  # Share of samples without fault that were declared faulty
    footprint: Footprint
    refused: int  # Samples that the filter refused
    pareto: bool  # No cheaper filter is as good


@dataclass(frozen=True, slots=True)
class Comparison:
    """What `compare` found.

    Attributes
    ----------
    name : str
        Of the plant.
    runs, steps, skip, seed : int
        M trials of T samples, of which those from ``skip`` on count.
    genie : Row
        The genie-aided filter, which is told every fault: a lower bound.
    rows : tuple of Row
        The filters, the smallest error first.
    recommended : str
        Label of one of them.
    recommendation : str
        Which and why, in one sentence.
    notes : tuple of str
        How numbers are to be read.
    """

    name: str
    runs: int
    steps: int
    skip: int
    seed: int
    genie: Row
    rows: tuple[Row, ...]
    recommended: str
    recommendation: str
    notes: tuple[str, ...] = ()

    def row(self, label: str) -> Row:
        """The row of a filter; KeyError if there is none."""
        return {row.label: row for row in (self.genie, *self.rows)}[label]

    def to_json(self) -> str:
        """Everything as JSON; what has no value is null."""
        return json_text(asdict(self))


def ranked(truth: Spec, entries: Sequence[Entry], false_alarm: float, **size: int) -> Comparison:
    """Compare filters, of which the first is the genie-aided one."""
    best = entries[0].scores.squared
    genie, *others = ((_score(each, best), each) for each in entries)
    known = [each for each in others if np.isfinite(each[0].value)]
    known.sort(key=lambda each: each[0].value)
    standing = [score for score, _ in known]
    if not known:
        given = "errors that are zero for the genie, or beyond all numbers for every filter"
        expected = "a plant with noise, and a horizon over which a filter follows it"
        raise DataError("comparison", given=given, expected=expected)
    rows = [_row(truth, *each, pareto=not beaten(each[0], standing)) for each in known]
    chosen, sentence = recommended(standing, {row.label: row.nees for row in rows})
    lost = [score.label for score, _ in others if not np.isfinite(score.value)]
    notes = _notes(truth, size, false_alarm, rows)
    return Comparison(
        name=truth.name,
        **size,
        genie=_row(truth, *genie, pareto=False),
        rows=tuple(rows),
        recommended=chosen,
        recommendation=sentence,
        notes=(*notes, *(f"{label} lost the state: left out" for label in lost)),
    )


def _score(entry: Entry, best: Array) -> Score:
    """MSE (M, n) over that of the genie: the mean over states, and the influence of every trial."""
    label, _, footprint, (squared, *_) = entry
    with np.errstate(invalid="ignore", over="ignore"):
        parts = [influence_of(a, b) for a, b in zip(squared.T, best.T, strict=True)]
    known = [part for part in parts if np.isfinite(part[0])]
    if not known:
        return Score(label, footprint, float("nan"), np.full(len(squared), np.nan))
    values, influences = zip(*known, strict=True)
    return Score(label, footprint, float(np.mean(values)), np.asarray(np.mean(influences, axis=0)))


def _row(truth: Spec, score: Score, entry: Entry, *, pareto: bool) -> Row:
    scores = entry.scores
    states = zip(error_signals(truth.model.states), scores.squared.T, strict=True)
    declared = np.full_like(scores.detection, np.nan) if score.label == GENIE else scores.detection
    found = Detection(*declared.T)
    return Row(
        label=score.label,
        family=entry.family,
        relative=score.relative,
        rmse={state.name: mean(squared).root() for state, squared in states},
        nees=mean(scores.nees),
        nis=mean(scores.nis),
        detected=ratio(found.found, found.onsets),
        delay=ratio(found.waited, found.found),
        false_alarms=ratio(found.alarms, found.healthy),
        footprint=score.footprint,
        refused=int(scores.refused.sum()),
        pareto=pareto,
    )


def _notes(
    truth: Spec, size: Mapping[str, int], false_alarm: float, rows: Sequence[Row]
) -> list[str]:
    faults = fault_section(truth)
    no_faults = "is the Kalman filter of the plant, told of no soft fault but free of them"
    paired = f"+- one standard error over {size['runs']} trials, the same for every filter"
    counting = f"samples {size['skip']} to {size['steps'] - 1} count"
    about = _GENIE_IS.get(faults, no_faults)
    if truth.filter.linearises:
        about = about.replace("a Kalman", "an extended Kalman").replace("the K", "the extended K")
        about += "; it linearises, so that another filter may be better"
    notes = [f"genie {about}", f"{paired}; {counting}"]
    without = [row.family for row in rows if not family(row.family).accepts]
    if without and faults:
        taken = "the same plant with its faults left out; it takes every y and u for good"
        notes.append(f"{without[0]}: {taken}")
    if any(np.isfinite(row.false_alarms.value) for row in rows):
        notes.append(
            "faults are declared where the mode without fault has a probability below one half; "
            f"without modes, by a test of the NIS at {false_alarm:g}"
        )
    refused = [f"{row.label} {row.refused}" for row in rows if row.refused]
    if refused:
        notes.append(f"samples that filters refused: {', '.join(refused)}")
    return notes
