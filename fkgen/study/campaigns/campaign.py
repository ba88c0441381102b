"""Any number of trials of a filter, summed up: the same digits wherever they are computed."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fkgen.console import Advance, progressing
from fkgen.errors import DataError, of_type
from fkgen.pipeline import build
from fkgen.problem import Spec
from fkgen.problem.spec import as_spec
from fkgen.runtime import record
from fkgen.study.campaigns.block import Work, block_size, modes_of
from fkgen.study.campaigns.checkpoint import Checkpoint
from fkgen.study.campaigns.engine import Engine, Lost, check_workers, engine_of
from fkgen.study.campaigns.results import Campaign, campaign_of
from fkgen.study.campaigns.sums import Sums, merged
from fkgen.study.campaigns.tally import Tally, sizes_of
from fkgen.trials.simulation import Request, counted, drawing_of

#: Trials before a campaign may stop by its precision, and how it grows until it is asked again.
_FEWEST, _GROWTH = 100, 1.25
#: Blocks that are computed in one go at most, here and by a worker of a cluster: progress is to be
#: seen, little is to be lost, and a task is to take longer than to send it.
_RANGE, _TASK = 16, 128


def montecarlo(
    spec: Spec,
    trials: int,
    steps: int,
    seed: int = 0,
    *,
    u: ArrayLike | None = None,
    params: Mapping[str, ArrayLike] | None = None,
    truth: Spec | None = None,
    workers: int | None = None,
    scheduler: Any = None,
    checkpoint: str | os.PathLike[str] | None = None,
    precision: float | None = None,
    progress: bool = False,
) -> Campaign:
    """Filter simulated trials and sum up what comes of them: the same digits whoever computes.

    Parameters
    ----------
    spec : Spec
        The filter.
    trials, steps, seed : int
        M trials of T samples, those of ``simulate(truth or spec, trials, steps, seed)``.
    u, params
        As for `simulate`, for plant and filter; what is left out has its own default in each.
    truth : Spec, optional
        The plant, of the same sizes; default: that of ``spec``.
    workers : int, optional
        Threads; default: one for each core.
    scheduler : str or distributed.Client, optional
        Of a Dask cluster, whose workers compute instead.
    checkpoint : path, optional
        File that keeps the sums, to go on from, also with more trials.
    precision : float, optional
        Stop when every relative standard error of the rmse is below it.
    progress : bool, on stderr

    Raises
    ------
    SpecError, DataError, OutputError
        If something does not fit, the plant overflows, or a file is none of ours.
    """
    check_workers(workers, scheduler)
    enough = None if precision is None else _positive("precision", precision)
    work = _asked(spec, truth, (trials, steps, seed), u, params)
    kept = Checkpoint(None if checkpoint is None else _path(checkpoint), work)
    with progressing("montecarlo", trials, shown=progress) as advance:
        advance(kept.ledger.blocks * work.size)
        sums = _Going(work, kept, enough, advance).to_the_end(workers, scheduler)
    return campaign_of(work, sums)


def _asked(
    spec: Spec,
    truth: Spec | None,
    size: tuple[int, int, int],
    u: ArrayLike | None,
    params: Mapping[str, ArrayLike] | None,
) -> Work:
    design = as_spec(spec).whole
    plant = design if truth is None else as_spec(truth, "truth")
    _check_sizes(design, plant)
    trials, steps, seed = size
    request = Request(plant, counted("trials", trials), counted("steps", steps), seed, 0)
    return work_of(design, request, u, params)


def work_of(
    design: Spec,
    request: Request,
    u: ArrayLike | None = None,
    params: Mapping[str, ArrayLike] | None = None,
) -> Work:
    """A campaign of a filter over the trials of a request, checked and compiled."""
    plant = request.spec
    given = {} if params is None else of_type("params", params, Mapping, "a mapping of names")
    own, of_plant = ({each.name for each in s.stated_parameters} for s in (design, plant))
    told = {name: value for name, value in given.items() if name in of_plant or name not in own}
    drawing = drawing_of(request, u, told)
    compiled = build(design)
    stated = [(each.name, each.default) for each in design.stated_parameters]
    own_told = {name: given[name] for name, _ in stated if name in given}
    values = record.values_of(stated, own_told, request.steps, np.float64)
    of_filter = dict(zip((name for name, _ in stated), values, strict=True))
    soft, modes = design.faults.soft, modes_of(compiled, plant)
    tested = design.model.ny if soft is None else len(soft.host)
    return Work(
        spec=design,
        compiled=compiled,
        drawing=drawing,
        tally=Tally(sizes_of(compiled, design.model.ne, tested, modes)),
        modes=modes,
        trials=request.runs,
        size=block_size(design, request.steps),
        params=of_filter,
    )


def _check_sizes(spec: Spec, truth: Spec) -> None:
    sizes = [
        f"{s.model.nx} states, {s.model.nu} inputs, {s.model.ny} measurements"
        for s in (truth, spec)
    ]
    kinds = [[(e.wrap, e.manifold) for e in s.model.states] for s in (truth, spec)]
    if sizes[0] != sizes[1]:
        raise DataError("truth", given=sizes[0], expected=f"{sizes[1]}, as the filter has")
    if kinds[0] != kinds[1]:
        given, expected = "other states that are angles or attitudes", "those of the filter"
        raise DataError("truth", given=given, expected=expected)


def _path(checkpoint: Any) -> Path:
    return Path(of_type("checkpoint", checkpoint, str | os.PathLike, "the path of a file"))


def _positive(what: str, value: Any) -> float:
    expected = "a positive number, such as 0.01"
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = -1.0
    if isinstance(value, bool) or not 0.0 < number < np.inf:
        raise DataError(what, given=repr(value), expected=expected)
    return number


@dataclass(frozen=True, slots=True, eq=False)
class _Going:
    """A campaign on its way."""

    work: Work
    kept: Checkpoint
    precision: float | None
    advance: Advance

    def to_the_end(self, workers: int | None, scheduler: Any) -> Sums:
        """The sums, by way of the checkpoint, which is written whatever happens."""
        try:
            with engine_of(self.work, workers, scheduler) as (engine, threads):
                most = _RANGE if scheduler is None else _TASK
                return self._summed(engine, threads, most)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(f"interrupted{self._how_to_go_on}") from None
        except Lost as lost:
            expected = f"{lost.expected}{self._how_to_go_on}"
            raise DataError(lost.what, given=lost.given, expected=expected) from None
        finally:
            self.kept.write()

    @property
    def _how_to_go_on(self) -> str:
        if self.kept.path is None:
            return "; nothing is kept without a checkpoint"
        done = self.kept.ledger.blocks * self.work.size
        there = f"{done} of {self.work.trials} trials"
        return f"; {self.kept.path} holds {there}: the same call goes on from there"

    def _summed(self, engine: Engine, threads: int, most: int) -> Sums:
        """The sums of whole blocks, until they are precise or all there; then the smaller last."""
        work, ledger = self.work, self.kept.ledger
        whole = work.trials // work.size
        for stop in _ends(work, whole, self.precision):
            size = min(most, max(1, stop // (4 * threads)))
            missing = [part for each in ledger.missing(stop) for part in _parts(each, size)]
            for blocks, sums in engine(missing):
                self.kept.add(blocks, sums)
                self.advance(sums.trials)
            so_far = ledger.total()
            if self.precision is not None and so_far and _precise(so_far, self.precision):
                return so_far
        found = [] if (total := ledger.total()) is None else [total]
        if whole < work.blocks:
            found += [sums for _, sums in engine([range(whole, work.blocks)])]
            self.advance(work.trials - whole * work.size)
        return merged(found)


def _ends(work: Work, whole: int, precision: float | None) -> Iterator[int]:
    """Numbers of blocks at which to look; which ones depends on nothing else."""
    at = whole if precision is None else -(-_FEWEST // work.size)
    while at < whole:
        yield at
        at = max(at + 1, int(_GROWTH * at))
    if whole:
        yield whole


def _parts(blocks: range, size: int) -> Iterator[range]:
    for start in range(blocks.start, blocks.stop, size):
        yield range(start, min(start + size, blocks.stop))


def _precise(sums: Sums, precision: float) -> bool:
    """Whether every relative standard error of the rmse is small: half that of its square."""
    value, error = sums.ratio("mse")
    return bool((0.5 * error <= precision * value).all())
