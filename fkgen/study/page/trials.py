"""What a report shows of a filter: a campaign, its errors over trials, a run with a fault in it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fkgen.problem import Spec
from fkgen.runtime.compiled import CompiledFilter
from fkgen.runtime.results import Run
from fkgen.study.campaigns.block import FALSE_ALARM
from fkgen.study.campaigns.campaign import montecarlo
from fkgen.study.campaigns.results import Campaign
from fkgen.study.comparisons.candidates import FilterInputs, filter_inputs
from fkgen.study.comparisons.scores import Outcome, outcome, weighted_squares
from fkgen.study.records.filtering import run_table, select
from fkgen.study.records.record import Table
from fkgen.trials.simulation import Simulation, simulate

Array = NDArray[np.float64]
Span = tuple[int, int]  # first sample and number of samples

#: Trials of a report, and samples of each; a filter with windows sees so many of them.
TRIALS, STEPS, WINDOWS, LONGEST = 400, 200, 4, 3000
#: Numbers of covariances that are kept at once.
_ROOM = 4_000_000
#: A bias that is put on a sensor where a model has no faults: in deviations of the innovation.
_BIAS, _SEED = 6.0, 0
#: Parts of a run: when a bias begins, and how long it lasts.
_BEGIN, _LASTS = 0.5, 0.2
#: A trial to be shown has faults in a share of its samples; false alarms count against it.
_MOST, _AGAINST = 0.6, 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """One trial, filtered."""

    table: Table
    run: Run
    truth: Array  # (T, n)
    faults: tuple[Span, ...]
    text: str  # what happens in it


@dataclass(frozen=True, slots=True, eq=False)
class Trials:
    """What many trials say."""

    campaign: Campaign
    found: Outcome  # of some of the trials
    sample: Sample

    @property
    def rms(self) -> Array:
        """(T, ne): root mean square of errors over trials."""
        return np.asarray(np.sqrt((self.found.error**2).mean(axis=0)))

    @property
    def claimed(self) -> Array:
        """(T, ne): the same by what the filter says of its errors."""
        variance = np.diagonal(self.found.covariance, axis1=-2, axis2=-1).astype(np.float64)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0).mean(axis=0)))

    @property
    def nees(self) -> Array:
        """(T,): mean normalised square of the error over trials, per degree of freedom."""
        M, T, n = self.found.error.shape
        unit = float(np.finfo(self.found.covariance.dtype).eps)
        e = self.found.error.reshape(-1, 1, n)
        total, degrees = weighted_squares(e, self.found.covariance.reshape(-1, 1, n, n), unit)
        degrees = degrees.reshape(M, T).sum(axis=0)
        over = np.where(degrees > 0.0, degrees, np.nan)
        return np.asarray(total.reshape(M, T).sum(axis=0) / over)


@dataclass(frozen=True, slots=True, kw_only=True)
class Drive:
    """What drives the plant: inputs (q,) or (T, q), and parameters."""

    u: Array | None
    params: Mapping[str, Array] = field(default_factory=dict)
    text: str = ""  # in words

    def cut(self, steps: int) -> Drive:
        """The first samples."""
        u = self.u if self.u is None or self.u.ndim < 2 else self.u[:steps]
        return replace(self, u=u, params={k: v[:steps] for k, v in self.params.items()})


def steps_of(spec: Spec, drive: Drive) -> int:
    """Samples of a trial: some windows, and no more than there are inputs."""
    soft = spec.faults.soft
    steps = STEPS if soft is None else max(STEPS, min(LONGEST, WINDOWS * soft.window + 1))
    known = [len(each) for each in drive.params.values()]
    known += [] if drive.u is None or drive.u.ndim < 2 else [len(drive.u)]
    return min([steps, *known])


def trials_of(spec: Spec, built: CompiledFilter, drive: Drive) -> Trials:
    """Run the campaign of a report.

    Raises
    ------
    UserError
        If there is nothing to be drawn: faults without a law, a plant that overflows.
    """
    steps = steps_of(spec, drive)
    given = drive.cut(steps)
    campaign = montecarlo(spec, TRIALS, steps, _SEED, u=given.u, params=given.params)
    cells = steps * (spec.model.ne**2 + spec.model.ny**2 + spec.model.nx)
    runs = max(8, min(TRIALS, _ROOM // cells))
    drawn = simulate(spec, runs, steps, _SEED, given.u, params=given.params)
    told = filter_inputs(drawn, spec, genie=bool(spec.filter.traits.told))
    found = outcome(built, told, drawn, FALSE_ALARM, more=("innovation_covariance",))
    return Trials(campaign, found, _sample(spec, built, given, drawn, found))


def _sample(
    spec: Spec, built: CompiledFilter, drive: Drive, drawn: Simulation, found: Outcome
) -> Sample:
    """A trial with a fault, drawn with the others or put into one."""
    at, sensor, text = _telling(drawn, found), None, ""
    if at is None:
        at, (sensor, text) = 0, _bias(spec, found, drawn.request.steps)
    steps = drawn.request.steps
    one = simulate(spec, 1, steps, _SEED, drive.u, params=drive.params, sensor=sensor, first=at)
    told = filter_inputs(one, spec, genie=bool(spec.filter.traits.told))
    seen = outcome(built, told, one, FALSE_ALARM)
    faults = _struck(one, seen)
    table = _table(told, steps)
    run = run_table(built, table, select(built.layout))
    spans = spans_of(faults)
    if not text:
        text = _drawn_text(spec, one, at)
    return Sample(table, run, one.state[0], spans, f"{text} {_noticed(spans, seen)}".strip())


def _table(told: FilterInputs, steps: int) -> Table:
    """One trial as a record."""
    u = np.zeros((steps, 0)) if told.u is None else np.asarray(told.u, np.float64)
    params = {name: np.asarray(each, float) for name, each in told.params.items()}
    return Table(
        file="simulation",
        time=np.arange(steps, dtype=float),
        y=told.y[0],
        u=u[0] if u.ndim == 3 else u,
        params={k: v[0] if v.ndim == 2 else v for k, v in params.items()},
    )


def _telling(drawn: Simulation, found: Outcome) -> int | None:
    """The trial in which most of a fault is declared; None where faults have to be put in."""
    faults, mode = found.faults, drawn.mode
    if faults is not None and not faults.any():
        return None
    if faults is not None and found.alarms is not None:
        at_once = np.logical_and.accumulate(faults, axis=1)  # nobody sees how it begins
        hits = (faults & found.alarms & ~at_once).sum(axis=1)
        score = hits - _AGAINST * (~faults & found.alarms).sum(axis=1)
        score = np.where(faults.mean(axis=1) > _MOST, -np.inf, score)
        return int(np.argmax(score))
    if mode is not None:
        return int(np.argmax((np.diff(mode.astype(int), axis=1) != 0).any(axis=1)))
    return None if drawn.gamma is None and drawn.hypothesis is None else 0


def _bias(spec: Spec, found: Outcome, steps: int) -> tuple[Array, str]:
    """A step on the first row of y, or a ramp on the first that waits for a test; and words."""
    soft, run = spec.faults.soft, found.run
    row = 0 if soft is None else soft.groups[0][0]
    variance = spec.model.R.values(spec.defaults)[row, row]
    if soft is None and "innovation_covariance" in run.ports:
        variance = float(np.median(run["innovation_covariance"][:, steps // 2 :, row, row]))
    size = _BIAS * float(np.sqrt(variance))
    start = int(_BEGIN * steps)
    stop = start + max(1, int(_LASTS * steps))
    profile, signal = np.zeros((steps, spec.model.ny)), spec.model.outputs[row]
    unit = f" {signal.unit}" if signal.unit else ""
    if soft is None:
        profile[start:stop, row] = size
        how = f"a bias of {size:.3g}{unit} is added to it"
    else:
        stop = steps
        profile[start:, row] = np.linspace(0.0, 2.0 * size, steps - start)
        how = f"it drifts, up to {2.0 * size:.3g}{unit}"
    name = signal.name.replace("_", " ")
    return profile, f"From sample {start} to {stop - 1} {name} is faulty: {how}."


def _struck(one: Simulation, seen: Outcome) -> NDArray[np.bool_]:
    """(T,): samples of a trial that are struck by its fault."""
    if seen.faults is not None:
        return np.asarray(seen.faults[0])
    if one.gamma is not None:
        gamma = one.gamma[0]
        return np.asarray(gamma < 0.5 if gamma.ndim == 1 else (gamma < 0.5).any(axis=1))
    if one.mode is not None:
        return np.asarray(one.mode[0] != one.mode[0, 0])
    return np.zeros(one.request.steps, bool)


def _drawn_text(spec: Spec, one: Simulation, at: int) -> str:
    of = f"Trial {at} of seed {_SEED}"
    if spec.faults.sensor is not None or one.arrival is not None:
        return f"{of}, as the law of the faults drew it."
    if one.gamma is not None:
        return f"{of}: shaded where an input fails. Every sample may fail, and none is declared."
    return f"{of}: shaded where the plant is in another mode than at the beginning."


def _noticed(spans: tuple[Span, ...], seen: Outcome) -> str:
    """When the filter declares what it is to declare."""
    if seen.faults is None or seen.alarms is None or not spans:
        return ""
    alarms = np.flatnonzero(seen.alarms[0])
    begin, length = max(spans, key=lambda span: span[1])
    inside = alarms[(alarms >= begin) & (alarms < begin + length)]
    lasts = f"The longest fault lasts from sample {begin} to {begin + length - 1}; the filter"
    if not inside.size:
        return f"{lasts} does not declare it in that time."
    late = int(inside[0]) - begin
    after = "at once" if late == 0 else f"{late} sample{'s' * (late > 1)} after it began"
    share = inside.size / length
    return f"{lasts} declares it {after}, and in {share:.0%} of its samples."


def spans_of(flags: NDArray[np.bool_]) -> tuple[Span, ...]:
    """Begin and length of every stretch of flags."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    pairs: Any = edges.reshape(-1, 2).tolist()
    return tuple((begin, end - begin) for begin, end in pairs)
