"""A block of trials: drawn, filtered and summed up. Whatever runs a campaign runs these."""

from __future__ import annotations

from dataclasses import dataclass, replace
from threading import Event

import numpy as np
from numpy.typing import NDArray

from fkgen.problem import Spec
from fkgen.runtime.blocks import one_thread
from fkgen.runtime.compiled import CompiledFilter
from fkgen.study.campaigns.sums import Sums, merged
from fkgen.study.campaigns.tally import Tally
from fkgen.study.comparisons.candidates import filter_inputs
from fkgen.study.comparisons.scores import outcome
from fkgen.trials.simulation import Drawing, Simulation

#: Of the test of the NIS by which a filter without modes declares a fault.
FALSE_ALARM = 0.01

#: Trials that the compiled filter takes side by side at most.
_LANES = 8
#: Samples of a block, and numbers of covariances in it: what a block takes in memory.
_SAMPLES, _ROOM = 50_000, 1_000_000


class Stopped(Exception):
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
        Parameters of the filter, whose defaults are its own.
    """

    spec: Spec
    compiled: CompiledFilter
    drawing: Drawing
    tally: Tally
    modes: int
    trials: int
    size: int
    params: dict[str, NDArray[np.floating]]

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
                found.append(self._block(drawn))
        return merged(found)

    def _block(self, drawn: Simulation) -> Sums:
        given = filter_inputs(drawn, self.spec, genie=bool(self.spec.filter.traits.told))
        given = replace(given, params={**given.params, **self.params})
        ports = ("innovation", "innovation_covariance")
        found = outcome(self.compiled, given, drawn, FALSE_ALARM, more=ports)
        y, mode = given.y[..., list(given.tested)], true_mode(drawn, self.modes)
        return self.tally.sums(found, y, mode)


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


def modes_of(compiled: CompiledFilter, plant: Spec) -> int:
    """How many modes of a filter are those of a plant, one by one; 0 if they are others."""
    ports = {port.name: port for port in compiled.layout.ports}
    if "mode_probability" not in ports:
        return 0
    (count,), faults = ports["mode_probability"].shape, plant.faults
    if faults.actuator is not None:
        drawn = 0 if faults.actuator.success_rate else len(plant.filter.option("prior", ()))
        return count if count == drawn else 0
    if faults.sensor is not None:
        return count if count in {3, 4} else 0
    return count if faults.jump is not None and count == len(faults.jump.modes) else 0


def true_mode(drawn: Simulation, count: int) -> NDArray[np.integer] | None:
    """Which of so many modes was the true one, (M, T)."""
    found = drawn.mode
    if not count:
        return None
    if drawn.hypothesis is not None:
        return np.broadcast_to(drawn.hypothesis[:, np.newaxis], drawn.y.shape[:2])
    # of three modes of a sensor the last is that without signal, whatever its noise
    return found if found is None else np.minimum(found, count - 1)
