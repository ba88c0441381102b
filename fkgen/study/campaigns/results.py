"""What a campaign found: estimates with standard errors, and what they say about the filter."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fkgen.console import html_table
from fkgen.problem import Spec
from fkgen.study.campaigns.block import Work
from fkgen.study.campaigns.roc import Roc, roc_of
from fkgen.study.campaigns.sums import Statistic, Sums
from fkgen.study.campaigns.tally import SIGMAS
from fkgen.study.comparisons.ranking import Estimate
from fkgen.study.reports.jsonable import json_text
from fkgen.trials.errors import error_signals

Array = NDArray[np.float64]

CONSISTENT, OPTIMISTIC, CONSERVATIVE = "consistent", "optimistic", "conservative"
#: Probability that a filter which is right is called something else, for all tests together.
LEVEL = 0.002
#: Statistics that sum up all others, and share half of that level.
_FIRST = ("nees", "nis")
#: Events, or trials with one, from which on a count is taken to be normal.
_ENOUGH = 25.0

_STATISTICS = ("rmse", "bias", "nees", "nis", "coverage", "calibration", "delay", "false_alarm")
_MORE = ("detected", "sensor_nis", "whiteness")


@dataclass(frozen=True, eq=False)
class Campaign:
    """Statistics of x(k|k) over all samples of all trials.

    Each has ``value`` and ``standard_error`` of the same shape.

    Attributes
    ----------
    rmse, bias : Statistic, (ne,)
        Root mean square, and mean, of the error; of an attitude by body axes.
    nees, nis : Statistic, scalar
        Normalised squares of error and innovation, per degree of freedom: 1 if the filter is right.
    coverage : Statistic, (ne, 3)
        How often the error is within 1, 2, 3 standard deviations.
    calibration : Statistic, (N, 10)
        Of mode i and bin b of its probability: how often it is the true mode. (0, 10) without
        modes; ``predicted`` is the mean probability in the bin.
    delay, false_alarm, detected : Statistic, scalar
        Samples between a fault and its declaration; declarations per sample without fault; share
        of faults that were declared before they ended. NaN where nothing is declared.
    sensor_nis, whiteness : Statistic, (p,)
        Mean square of each row's normalised innovation (1), and its correlation with the next
        one (0).
    roc : Roc
        By thresholds of a mode's probability, how often the mode is declared rightly and wrongly.
    verdicts : mapping of str to str
        By statistic "consistent", "optimistic" (errors are larger than the filter says) or
        "conservative".
    name, trials, steps, seed
        What it is about.
    """

    name: str
    states: tuple[str, ...]
    outputs: tuple[str, ...]
    trials: int
    steps: int
    seed: int
    rmse: Statistic
    bias: Statistic
    nees: Statistic
    nis: Statistic
    coverage: Statistic
    calibration: Statistic
    predicted: Statistic
    delay: Statistic
    false_alarm: Statistic
    detected: Statistic
    sensor_nis: Statistic
    whiteness: Statistic
    roc: Roc
    verdicts: Mapping[str, str]

    @property
    def consistent(self) -> bool:
        """Whether every verdict is "consistent"."""
        return set(self.verdicts.values()) <= {CONSISTENT}

    @property
    def facts(self) -> dict[str, Any]:
        """Everything, by the names of the attributes."""
        facts: dict[str, Any] = {key: getattr(self, key) for key in _HEAD}
        for key in (*_STATISTICS, "predicted", *_MORE):
            facts[key] = getattr(self, key)._asdict()
        return facts | {"roc": self.roc.facts, "verdicts": dict(self.verdicts)}

    def to_json(self) -> str:
        """The same as JSON."""
        return json_text(self.facts)

    def __repr__(self) -> str:
        return f"<Campaign {self.name}: {self.trials} trials of {self.steps} samples>"

    def _repr_html_(self) -> str:
        """The table of the command, for a notebook."""
        return html_table(repr(self).strip("<>"), *table_of(self))


_HEAD = ("name", "trials", "steps", "seed", "states", "outputs")


def campaign_of(work: Work, sums: Sums) -> Campaign:
    """What the sums say."""
    states = tuple(each.name for each in error_signals(work.spec.model.states))
    request = work.drawing.request
    plain = {key: sums.ratio(key) for key in (*_STATISTICS[1:], "predicted", *_MORE)}
    return Campaign(
        name=work.spec.name,
        states=states,
        outputs=_rows(work.spec, sums),
        trials=sums.trials,
        steps=request.steps,
        seed=request.seed,
        rmse=_root(sums.ratio("mse")),
        roc=roc_of(sums),
        verdicts=verdicts_of(tests_of(sums, work.spec, sums.trials * request.steps), sums.trials),
        **plain,
    )


def _rows(spec: Spec, sums: Sums) -> tuple[str, ...]:
    """The measurements that innovations are about: those of the host where others wait."""
    soft, names = spec.faults.soft, [each.name for each in spec.model.outputs]
    tested = names if soft is None else [names[i] for i in soft.host]
    return tuple(tested) if sums.shapes["sensor_nis"] == (len(tested),) else ()


def _root(square: Statistic) -> Statistic:
    root = np.sqrt(square.value)
    over = np.where(root > 0.0, 2.0 * root, 1.0)
    return Statistic(root, square.standard_error / over)


class Test(NamedTuple):
    """Numbers that are ``expected`` of a filter which is right; those above are optimistic."""

    value: Array
    error: Array
    expected: Array
    optimistic: Array  # 1 if a larger number is, -1 if a smaller one; 0 if any other one


def tests_of(sums: Sums, spec: Spec, samples: int) -> dict[str, Test]:
    """What is known of a filter that is right, next to what was found."""
    found = {}
    for key, of, expected, sign in (
        ("rmse", "claimed", 1.0, 1.0),  # over what the filter says of its error
        ("bias", "bias", 0.0, 0.0),
        ("nees", "nees", 1.0, 1.0),
        ("nis", "nis", 1.0, 1.0),
        ("sensor_nis", "sensor_nis", 1.0, 1.0),
        ("whiteness", "whiteness", 0.0, 1.0),  # the gain is too small
    ):
        value, error = sums.ratio(of)
        if key == "sensor_nis" and np.size(value) == 1:
            continue  # it is the nis
        found[key] = Test(value, error, *(np.full(value.shape, each) for each in (expected, sign)))
    if not spec.faults.plain() or spec.filter.traits.told:  # else errors are no normal numbers
        found["coverage"] = _coverage(sums, samples)
    if math.prod(sums.shapes["excess"]):
        found["calibration"] = _calibration(sums)
    return found


def _coverage(sums: Sums, samples: int) -> Test:
    """Coverage of normal numbers; NaN where too few trials hold a number outside.

    A spread of few events is not known by their own: it is at least that of the first row, by the
    ratio that independent samples have.
    """
    value, error = sums.ratio("coverage")
    expected = np.array([math.erf(each / math.sqrt(2.0)) for each in SIGMAS])
    spread = np.sqrt(expected * (1.0 - expected))
    error = np.maximum(error, error[:, :1] * spread / spread[0])
    error = np.maximum(error, spread / math.sqrt(samples))
    enough = sums.trials * (1.0 - expected) >= _ENOUGH
    value = np.where(enough, value, np.nan)
    return Test(value, error, np.broadcast_to(expected, value.shape), -np.ones(value.shape))


def _calibration(sums: Sums) -> Test:
    """How much more often a mode is true than its probability says: 0, in every bin.

    Too seldom where it is probable, too often where it is not: the filter is too sure of itself.
    """
    value, error = sums.ratio("excess")
    predicted, count = sums.ratio("predicted").value, sums.total("predicted")
    events = np.minimum(predicted, 1.0 - predicted) * count
    value = np.where(events >= 4.0 * _ENOUGH, value, np.nan)
    return Test(value, error, np.zeros(value.shape), np.where(predicted < 0.5, 1.0, -1.0))


def verdicts_of(tests: Mapping[str, Test], trials: int) -> dict[str, str]:
    """A verdict for each statistic that can be tested; `LEVEL` is that of all of them.

    Bonferroni, half of it for `_FIRST` and half for the others; Student's distribution, with one
    degree of freedom less than there are trials.
    """
    from scipy.special import stdtrit  # noqa: PLC0415 - scipy takes long to import

    if trials < 2:
        return {}
    scores = {key: each for key, test in tests.items() if (each := _scores(test)).size}
    counts = {True: 0, False: 0}
    for key, each in scores.items():
        counts[key in _FIRST] += each.size
    limits = {
        first: float(stdtrit(trials - 1, 1.0 - 0.25 * LEVEL / max(1, count)))
        for first, count in counts.items()
    }
    return {key: _verdict(each, limits[key in _FIRST]) for key, each in scores.items()}


def _scores(test: Test) -> Array:
    """How many standard errors each number that is known is off, above zero if optimistic."""
    value, error, expected, sign = (np.ravel(each) for each in test)
    known = np.isfinite(value)
    off, error, sign = (value - expected)[known], error[known], sign[known]
    with np.errstate(divide="ignore"):
        far = np.divide(np.abs(off), error, out=np.zeros_like(off), where=off != 0.0)
    return np.asarray(np.where(sign == 0.0, 1.0, np.sign(off) * sign) * far)


def _verdict(scores: Array, limit: float) -> str:
    worst = float(scores[np.argmax(np.abs(scores))])
    if abs(worst) <= limit:
        return CONSISTENT
    return OPTIMISTIC if worst > 0.0 else CONSERVATIVE


def table_of(found: Campaign) -> tuple[Sequence[str], list[list[str]]]:
    """Head and rows of a table: statistic, of what, estimate, verdict.

    Of each mode's calibration the bin that is farthest off is shown.
    """
    rows = list[list[str]]()

    def add(key: str, of: Sequence[str], statistic: Statistic) -> None:
        verdict = found.verdicts.get(key, "")
        values, errors = (np.ravel(each).tolist() for each in statistic)
        for name, value, error in zip(of, values, errors, strict=True):
            if math.isfinite(value):
                rows.append([key, name, str(Estimate(value, error)), verdict])
                verdict = ""

    within = [f"{name}, {k} sigma" for name in found.states for k in SIGMAS]
    names = {"rmse": found.states, "bias": found.states, "coverage": within}
    names |= {"sensor_nis": found.outputs, "whiteness": found.outputs}
    order = ("rmse", "bias", "nees", "nis", "sensor_nis", "whiteness", "coverage")
    for key in (*order, "detected", "delay", "false_alarm"):
        add(key, names.get(key, [""]), getattr(found, key))
    farthest = [_farthest(found, i) for i in range(len(found.calibration.value))]
    of = [f"mode {i} where p = {p:.2f}" for i, (p, _, _) in enumerate(farthest)]
    add("calibration", of, Statistic(*np.array(farthest).reshape(-1, 3).T[1:]))
    add("roc", [f"mode {i}, area" for i in range(len(farthest))], found.roc.area)
    return ("statistic", "of", "estimate", "verdict"), rows


def _farthest(found: Campaign, mode: int) -> tuple[float, float, float]:
    """Probability, frequency and its error in the bin that is farthest off, by its error."""
    p = found.predicted.value[mode]
    value, error = (each[mode] for each in found.calibration)
    with np.errstate(invalid="ignore", divide="ignore"):
        far = np.nan_to_num(np.abs(value - p) / error, posinf=0.0)
    i = int(np.argmax(far))
    return float(p[i]), float(value[i]), float(error[i])
