"""Several filters for one plant and its faults: paired simulation, costs, a recommendation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from fkgen.console import progressing
from fkgen.errors import DataError
from fkgen.families import family
from fkgen.pipeline import build
from fkgen.problem import Spec
from fkgen.runtime.compiled import CompiledFilter
from fkgen.study.comparisons.candidates import (
    Candidate,
    candidates_of,
    default_families,
    filter_inputs,
    genie_of,
)
from fkgen.study.comparisons.footprint import footprint
from fkgen.study.comparisons.ranking import Comparison, Entry, Experiment, ranked
from fkgen.study.comparisons.scores import Scores, score
from fkgen.trials.simulation import counted, simulate

#: Samples that are simulated and filtered before the next ones: what they take in memory.
CHUNK = 400_000


def compare(
    specs: Spec | Sequence[Spec],
    families: Sequence[str] | None = None,
    *,
    runs: int = 2000,
    steps: int = 200,
    seed: int = 0,
    skip: int | None = None,
    false_alarm: float = 0.01,
    u: ArrayLike | None = None,
    params: Mapping[str, ArrayLike] | None = None,
    sensor: ArrayLike | None = None,
    input: ArrayLike | None = None,  # noqa: A002 - the field's word, as in `simulate`
    present: ArrayLike | None = None,
    progress: bool = False,
) -> Comparison:
    """Compare filters on the same trials of one plant with its faults, in C.

    Parameters
    ----------
    specs : Spec or sequence of Spec
        The first one is the truth; several are all filters as well.
    families : sequence of str, optional
        ``family`` or ``family:key=value``, derived from the truth: ``kf`` is the same plant with
        its faults left out. Of one spec, all families that fit are the default.
    runs, steps, seed, skip : int
        M trials of T samples, of which the first ``skip`` (a quarter by default) do not count.
    false_alarm : float
        Of the NIS test by which filters without modes declare a fault.
    u, params, sensor, input, present
        Inputs, parameters, soft faults and rows that are measured, as for `simulate`.
    progress : bool
        Show how far it is, on stderr.

    Raises
    ------
    SpecError, DataError
        If a family does not fit the faults, a number is out of range, or the plant overflows.
    """
    given = (specs,) if isinstance(specs, Spec) else tuple(specs)
    left_out: tuple[str, ...] = ()
    ready = counted("steps", steps) // 4 if skip is None else counted("skip", skip, least=0)
    size = Experiment(runs, steps, seed, ready, false_alarm)
    experiment = replace(size, u=u, params=params, sensor=sensor, input=input, present=present)
    if families is None and len(given) == 1:
        families, left_out = default_families(given[0])
    found = _compared(given, families or (), experiment, progress=progress)
    return replace(found, notes=(*found.notes, *left_out))


def _compared(
    specs: tuple[Spec, ...], families: Sequence[str], experiment: Experiment, *, progress: bool
) -> Comparison:
    if not specs:
        raise DataError("specs", given="none", expected="at least one spec")
    truth, compiled = specs[0], []
    everyone = (genie_of(truth), *candidates_of(specs, families))
    with progressing("build", len(everyone), shown=progress) as advance:
        for each in everyone:
            compiled.append(build(each.spec))
            advance(1)
        with ThreadPoolExecutor() as pool:
            costs = list(pool.map(footprint, compiled))
    scores = _scored(truth, everyone, compiled, experiment, progress=progress)
    entries = [
        Entry(each.label, each.spec.filter.family, result, cost)
        for each, result, cost in zip(everyone, scores, costs, strict=True)
    ]
    found = ranked(truth, entries, experiment)
    caveats = (
        f"{each.label}: {finding.message}"
        for each in everyone[1:]
        for finding in family(each.spec.filter.family).caveats(each.spec)
    )
    return replace(found, notes=(*found.notes, *caveats))


def _scored(
    truth: Spec,
    everyone: Sequence[Candidate],
    compiled: Sequence[CompiledFilter],
    experiment: Experiment,
    *,
    progress: bool,
) -> list[Scores]:
    """Simulate and filter in chunks: only scores are kept; the first candidate is the genie."""
    from scipy.special import gammainccinv  # noqa: PLC0415 - scipy.stats would take a second

    runs, steps = experiment.runs, experiment.steps
    rows = np.arange(1, truth.model.ny + 1)
    # What the NIS of 0, 1, ... rows exceeds with the probability of a false alarm.
    limits = np.array([np.inf, *(2.0 * gammainccinv(0.5 * rows, experiment.false_alarm))])
    parts: list[list[Scores]] = [[] for _ in everyone]
    with progressing("simulate and filter", runs * len(everyone), shown=progress) as advance:
        for start in range(0, runs, size := max(1, CHUNK // steps)):
            stop = min(start + size, runs)
            drawn = simulate(
                truth,
                stop - start,
                steps,
                experiment.seed,
                _part(experiment.u, start, stop),
                params=experiment.params,
                sensor=_part(experiment.sensor, start, stop),
                input=_part(experiment.input, start, stop),
                present=_part(experiment.present, start, stop),
                first=start,
            )
            for at, each in enumerate(everyone):
                given = filter_inputs(drawn, each.spec, genie=at == 0)
                part = score(compiled[at], given, drawn, skip=experiment.skip, limits=limits)
                parts[at].append(part)
                advance(stop - start)
    return [Scores.joined(each) for each in parts]


def _part(signal: ArrayLike | None, start: int, stop: int) -> ArrayLike | None:
    """The trials of a chunk, if a signal has one record for each."""
    array = None if signal is None else np.asarray(signal)
    return array[start:stop] if array is not None and array.ndim == 3 else signal
