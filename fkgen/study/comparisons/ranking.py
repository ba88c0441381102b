"""Which filter to take: the cheapest of those that are as good as the best, as far as is known.

From scores to a table, a Pareto front and one recommendation that the numbers bear out.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import DataError
from fkgen.families import family
from fkgen.problem import Spec
from fkgen.study.comparisons.candidates import YARDSTICK, fault_section
from fkgen.study.comparisons.estimates import Estimate, error_of, influence_of, mean, ratio
from fkgen.study.comparisons.experiment import Experiment
from fkgen.study.comparisons.footprint import Footprint
from fkgen.study.comparisons.scores import Scores

Array = NDArray[np.float64]

#: Paired differences within so many standard errors may be chance.
TIE = 2.0
#: They are ties if they cannot be larger than this share of the smaller error; else, not decided.
MARGIN = 0.1
#: A filter whose NEES is farther from 1 is not believed about its own error.
HONEST = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Standing:
    """What counts for the choice."""

    label: str
    footprint: Footprint
    value: float
    influence: Array

    @property
    def price(self) -> tuple[int, int, int]:
        """Operations, then code, then memory."""
        print_ = self.footprint
        return print_.cost, min(print_.flash.values(), default=0), print_.state

    def not_worse_than(self, other: Standing) -> bool:
        """Whether its error is smaller, or a tie, over the same trials."""
        gap, doubt = self.value - other.value, TIE * self.apart(other)
        return gap <= 0.0 or (gap <= doubt and gap + doubt <= MARGIN * other.value)

    def undecided_against(self, other: Standing) -> bool:
        """Whether its larger error may be chance, and may as well be much larger."""
        gap = self.value - other.value
        return 0.0 < gap <= TIE * self.apart(other) and not self.not_worse_than(other)

    def apart(self, other: Standing) -> float:
        """Standard error of the paired difference."""
        return error_of(self.influence - other.influence)


def beaten(one: Standing, everyone: Sequence[Standing]) -> bool:
    """Whether a cheaper filter is not worse, or one of the same price is better."""
    return any(
        other.not_worse_than(one)
        and (
            other.price < one.price or (other.price == one.price and not one.not_worse_than(other))
        )
        for other in everyone
        if other is not one
    )


def recommended(everyone: Sequence[Standing], nees: dict[str, Estimate]) -> tuple[str, str]:
    """The cheapest of those whose error is not worse than the smallest, and why."""
    best = everyone[0]
    ties = [one for one in everyone if one.not_worse_than(best)]
    chosen = min(ties, key=lambda one: one.price)
    about = f"its mean squared error, {_of(chosen)} times that of the genie,"
    if len(everyone) == 1:
        why = f"{about} has nothing to be compared with"
    elif chosen is not best:
        share = chosen.footprint.cost / max(1, best.footprint.cost)
        why = (
            f"{about} is that of {best.label} within {TIE:g} standard errors (difference "
            f"{_gap(chosen, best)}), at {share:.0%} of the operations"
        )
    elif len(ties) > 1:
        names = " and ".join(one.label for one in ties if one is not best)
        why = f"{about} is the smallest, and {names}, which may be as good, costs no less"
    else:
        second = everyone[1]
        why = f"{about} is the smallest, {_gap(second, best)} below that of {second.label}"
        if second.undecided_against(best):
            why += ", which more trials would have to decide"
    return chosen.label, f"Take {chosen.label}: {why}{_caution(nees[chosen.label])}."


def _gap(worse: Standing, better: Standing) -> Estimate:
    return Estimate(worse.value - better.value, worse.apart(better))


def _of(one: Standing) -> Estimate:
    return Estimate(one.value, error_of(one.influence))


def _caution(nees: Estimate) -> str:
    """A clause about a covariance that is not to be believed."""
    away = abs(nees.value - 1.0)
    if not away > max(HONEST, TIE * nees.error):
        return ""
    word = "too small" if nees.value > 1.0 else "too large"
    return f"; the covariance that it states is {word} (NEES {nees})"


@dataclass(frozen=True, slots=True, eq=False)
class Entry:
    """A filter with everything that was measured of it."""

    label: str
    family: str
    scores: Scores
    footprint: Footprint


@dataclass(frozen=True, slots=True)
class Row:
    """One filter in the table.

    Attributes
    ----------
    label, family : str
    relative : Estimate
        Mean squared error over that of the genie, the mean over states.
    rmse : dict of str to Estimate
        Root of the mean squared error by state.
    nees, nis : Estimate
        Per dimension: 1 if the filter is right about itself.
    detected : Estimate
        Share of the faults that were declared before they ended.
    delay : Estimate
        Samples from the onset of those faults to their declaration.
    false_alarms : Estimate
        Share of samples without fault that were declared faulty.
    footprint : Footprint
    refused : int
        Samples that the filter refused.
    pareto : bool
        No cheaper filter is as good.
    """

    label: str
    family: str
    relative: Estimate
    rmse: dict[str, Estimate]
    nees: Estimate
    nis: Estimate
    detected: Estimate
    delay: Estimate
    false_alarms: Estimate
    footprint: Footprint
    refused: int
    pareto: bool


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
        The yardstick, which is told every fault.
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
    notes: tuple[str, ...] = field(default=())

    def row(self, label: str) -> Row:
        """The row of a filter; KeyError if there is none."""
        return {row.label: row for row in (self.genie, *self.rows)}[label]

    def to_json(self) -> str:
        """Everything as JSON; what has no value is null."""
        return json.dumps(_without_nan(asdict(self)), indent=2)


def judged(truth: Spec, entries: Sequence[Entry], experiment: Experiment) -> Comparison:
    """Compare entries, of which the first is the genie.

    Raises
    ------
    DataError
        If there is nothing to compare.
    """
    genie, others = entries[0], list(entries[1:])
    relative = {id(e): _relative(e.scores.squared, genie.scores.squared) for e in entries}
    lost = [e.label for e in others if not np.isfinite(relative[id(e)][0])]
    others = [e for e in others if e.label not in lost]
    if not others:
        raise DataError(
            "comparison",
            given="errors that are zero for the genie, or beyond all numbers for every filter",
            expected="a plant with noise, and a horizon over which a filter follows it",
        )
    others.sort(key=lambda e: relative[id(e)][0])
    field_of = [Standing(e.label, e.footprint, *relative[id(e)]) for e in others]
    front = {one.label for one in field_of if not beaten(one, field_of)}
    states = [signal.name for signal in truth.model.states]
    chosen, sentence = recommended(field_of, {e.label: mean(e.scores.nees) for e in others})
    rows = [_row(e, relative[id(e)], states, pareto=e.label in front) for e in others]
    return Comparison(
        name=truth.name,
        runs=experiment.runs,
        steps=experiment.steps,
        skip=experiment.skip,
        seed=experiment.seed,
        genie=_row(genie, relative[id(genie)], states, pareto=False),
        rows=tuple(rows),
        recommended=chosen,
        recommendation=sentence,
        notes=_notes(truth, experiment, rows)
        + tuple(f"{each} lost the state: left out" for each in lost),
    )


def _relative(squared: Array, best: Array) -> tuple[float, Array]:
    """MSE over that of the genie: the mean over states, and the influence of every trial."""
    with np.errstate(invalid="ignore", over="ignore"):
        parts = [influence_of(a, b) for a, b in zip(squared.T, best.T, strict=True)]
    known = [part for part in parts if np.isfinite(part[0])]
    if not known:
        return float("nan"), np.full(len(squared), np.nan)
    values, influences = zip(*known, strict=True)
    return float(np.mean(values)), np.asarray(np.mean(influences, axis=0))


def _row(
    entry: Entry, relative: tuple[float, Array], states: Sequence[str], *, pareto: bool
) -> Row:
    scores, found = entry.scores, entry.scores.found
    rmse = {}
    for i, state in enumerate(states):
        squared = mean(scores.squared[:, i])
        root = float(np.sqrt(squared.value))
        rmse[state] = Estimate(root, squared.error / (2.0 * root) if root > 0.0 else 0.0)
    told = entry.label == YARDSTICK or not np.isfinite(found.healthy).all()
    unknown = Estimate(float("nan"), float("nan"))
    return Row(
        label=entry.label,
        family=entry.family,
        relative=Estimate(relative[0], error_of(relative[1])),
        rmse=rmse,
        nees=mean(scores.nees),
        nis=mean(scores.nis),
        detected=unknown if told else ratio(found.found, found.onsets),
        delay=unknown if told else ratio(found.waited, found.found),
        false_alarms=unknown if told else ratio(found.alarms, found.healthy),
        footprint=entry.footprint,
        refused=int(scores.refused.sum()),
        pareto=pareto,
    )


def _notes(truth: Spec, experiment: Experiment, rows: Sequence[Row]) -> tuple[str, ...]:
    genie = {
        "sensor": "is told gamma and delta of every sample",
        "actuator": "is a Kalman filter that is told what reaches the plant",
        "jump": "is a Kalman filter that is told the mode of every sample, and what was lost",
    }.get(
        fault_section(truth),
        "is the Kalman filter of the plant, told of no soft fault but free of them",
    )
    counted = f"samples {experiment.skip} to {experiment.steps - 1} count"
    paired = f"+- one standard error over {experiment.runs} trials, the same for every filter"
    without = [row.family for row in rows if not family(row.family).accepts]
    notes = [f"genie {genie}", f"{paired}; {counted}"]
    if without and fault_section(truth):
        notes.append(
            f"{without[0]}: the same plant with its faults left out;"
            " it takes every y and u for good"
        )
    if any(np.isfinite(row.false_alarms.value) for row in rows):
        notes.append(
            "faults are declared where the mode without fault has a probability below one half; "
            f"without modes, by a test of the NIS at {experiment.false_alarm:g}"
        )
    refused = [f"{row.label} {row.refused}" for row in rows if row.refused]
    if refused:
        notes.append(f"samples that filters refused: {', '.join(refused)}")
    return tuple(notes)


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(entry) for entry in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
