"""A block of trials: drawn, filtered and summed up. Whatever runs a campaign runs these."""

from __future__ import annotations

from dataclasses import dataclass, replace
from threading import Event

import numpy as np
from numpy.typing import NDArray

from fkgen.problem import Spec
from fkgen.runtime.blocks import one_thread
from fkgen.runtime.compiled import CompiledFilter
from fkgen.runtime.results import Run
from fkgen.study.campaigns.sums import Pairs, Sums, merged
from fkgen.study.comparisons.candidates import filter_inputs
from fkgen.study.comparisons.scores import Detection, Outcome, outcome
from fkgen.trials.simulation import Drawing, Simulation

Array = NDArray[np.float64]

#: Within so many standard deviations.
SIGMAS = (1, 2, 3)
#: Bins of a mode's probability.
BINS = 10
#: Of the test of the NIS by which a filter without modes declares a fault.
FALSE_ALARM = 0.01

#: Trials that the compiled filter takes side by side at most.
_LANES = 8
#: Samples of a block, and numbers of covariances in it: what a block takes in memory.
_SAMPLES, _ROOM = 50_000, 1_000_000


class Stopped(Exception):  # noqa: N818 - nobody's error
    """Somebody asked to stop."""


@dataclass(frozen=True, slots=True, eq=False)
class Work:
    """A campaign, ready to be computed block by block, here or elsewhere.

    Attributes
    ----------
    spec : Spec
        Of the filter.
    compiled : CompiledFilter
    drawing : Drawing
        The plant.
    trials, size : int
        Of the campaign, and of a block; the last one may be smaller.
    params : mapping of str to array
        Parameters of the filter that the plant does not have.
    """

    spec: Spec
    compiled: CompiledFilter
    drawing: Drawing
    trials: int
    size: int
    params: dict[str, Array]

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return -(-self.trials // self.size)

    def trials_of(self, blocks: range) -> int:
        """Number of trials in a range of blocks."""
        return min(self.trials, blocks.stop * self.size) - blocks.start * self.size

    def sums(self, blocks: range, stop: Event | None = None) -> Sums:
        """The sums of some blocks; in this thread alone.

        Raises
        ------
        Stopped
            Once ``stop`` is set.
        """
        found = []
        with one_thread():
            for block in blocks:
                if stop is not None and stop.is_set():
                    raise Stopped
                start = block * self.size
                drawn = self.drawing.draw(start, min(start + self.size, self.trials))
                found.append(Sums.of(self._pairs(drawn)))
        return merged(found)

    def _pairs(self, drawn: Simulation) -> Pairs:
        told = bool(self.spec.filter.traits.told)
        given = filter_inputs(drawn, self.spec, genie=told)
        given = replace(given, params={**given.params, **self.params})
        ports = ("innovation", "innovation_covariance")
        found = outcome(self.compiled, given, drawn, 0, FALSE_ALARM, more=ports)
        y = given.y[..., list(given.tested)]
        return pairs_of(found, y, true_mode(drawn, found.run))


def block_size(spec: Spec, steps: int) -> int:
    """Trials of a block: as many as are quick together and fit into little memory.

    It depends on nothing but the sizes of the filter and of a trial: blocks are added up trial by
    trial, and what a block rounds is part of the result.
    """
    cells = spec.model.ne**2 + spec.model.ny**2
    size = min(_SAMPLES, _ROOM // cells) // steps
    if size < _LANES:
        return min(_LANES, max(1, _ROOM // (cells * steps)))
    return size - size % _LANES


def pairs_of(found: Outcome, y: Array, mode: NDArray[np.integer] | None) -> Pairs:
    """What statistics are ratios of, by trial."""
    error, one, steps = found.error, np.ones((1, 1)), found.error.shape[1]
    variance = np.diagonal(found.covariance, axis1=2, axis2=3).astype(np.float64)
    squares = error**2
    inside = [(squares <= each**2 * variance).sum(axis=1) / steps for each in SIGMAS]
    counts = Detection(*np.nan_to_num(found.detection).T)
    mean_square = squares.sum(axis=1) / steps
    pairs = {
        "mse": (mean_square, one),
        "claimed": (mean_square, variance.sum(axis=1) / steps),
        "bias": (error.sum(axis=1) / steps, one),
        "nees": found.nees,
        "nis": found.nis,
        "coverage": (np.stack(inside, axis=2), one[..., np.newaxis]),
        "delay": (counts.waited, counts.found),
        "detected": (counts.found, counts.onsets),
        "false_alarm": (counts.alarms, counts.healthy),
    }
    return pairs | _of_innovations(found, y) | _of_modes(found.run, mode)


def _of_innovations(found: Outcome, y: Array) -> Pairs:
    """Squares of each row's normalised innovation, and its product with that of the next sample."""
    run, there = found.run, np.isfinite(y) & found.used[..., np.newaxis]
    if not {"innovation", "innovation_covariance"} <= set(run.ports):
        nothing = np.zeros((len(y), 0))
        return {"sensor_nis": (nothing, nothing), "whiteness": (nothing, nothing)}
    variance = np.diagonal(run["innovation_covariance"], axis1=2, axis2=3).astype(np.float64)
    there &= variance > 0.0
    scale = np.sqrt(np.where(there, variance, 1.0))
    z = np.where(there, run["innovation"] / scale, 0.0)
    squares, both = z**2, there[:, 1:] & there[:, :-1]
    return {
        "sensor_nis": (squares.sum(axis=1), there.sum(axis=1, dtype=np.float64)),
        "whiteness": ((z[:, 1:] * z[:, :-1]).sum(axis=1), both.sum(axis=1, dtype=np.float64)),
    }


def _of_modes(run: Run, mode: NDArray[np.integer] | None) -> Pairs:
    """Bin by bin of each mode's probability: how often it is the true one, and the probability."""
    runs = len(run.status)
    if mode is None:
        nothing = np.zeros((runs, 0, BINS))
        return {"calibration": (nothing, nothing), "predicted": (nothing, nothing)}
    p = run["mode_probability"].astype(np.float64)
    count = p.shape[2]
    cell = np.minimum((p * BINS).astype(np.intp), BINS - 1)
    cell += BINS * np.arange(count)
    cell += BINS * count * np.arange(runs)[:, np.newaxis, np.newaxis]
    hit = mode[..., np.newaxis] == np.arange(count)
    shape = (runs, count, BINS)
    total, sums, hits = (
        np.bincount(cell.ravel(), weights, runs * count * BINS).reshape(shape).astype(np.float64)
        for weights in (None, p.ravel(), hit.ravel())
    )
    return {"calibration": (hits, total), "predicted": (sums, total), "excess": (hits - sums, total)}


def true_mode(drawn: Simulation, run: Run) -> NDArray[np.integer] | None:
    """Which of the modes of a filter was the true one, (M, T); None if it has none of these."""
    if "mode_probability" not in run.ports:
        return None
    count, found = run["mode_probability"].shape[2], drawn.mode
    if drawn.hypothesis is not None:
        return np.broadcast_to(drawn.hypothesis[:, np.newaxis], run.status.shape)
    if found is None:
        return None
    modes = int(drawn.trials.modes.max()) + 1
    if drawn.spec.faults.sensor is not None and (modes, count) == (4, 3):
        return np.minimum(found, 2)  # without signal both noises are one mode
    return found if modes == count else None
