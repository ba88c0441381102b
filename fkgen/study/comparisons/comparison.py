"""Several filters for one plant and its faults: paired simulation, costs, a recommendation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fkgen.console import Advance, progressing
from fkgen.errors import DataError
from fkgen.families import family
from fkgen.pipeline import build
from fkgen.problem import Spec
from fkgen.runtime.compiled import CompiledFilter
from fkgen.runtime.record import probability
from fkgen.study.comparisons.candidates import (
    Candidate,
    candidates_of,
    default_families,
    filter_inputs,
    genie_of,
)
from fkgen.study.comparisons.footprint import footprint
from fkgen.study.comparisons.ranking import Comparison, ranked
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
    ready = counted("steps", steps) // 4 if skip is None else counted("skip", skip, least=0)
    counted("runs", runs, least=2)
    counted("steps", steps)
    if ready >= steps:
        expected = f"from 0 to {steps - 1}: some of the {steps} samples have to count"
        raise DataError("skip", given=str(ready), expected=expected)
    probability("false_alarm", false_alarm)
    left_out: tuple[str, ...] = ()
    if families is None and len(given) == 1:
        families, left_out = default_families(given[0])
    if not given:
        raise DataError("specs", given="none", expected="at least one spec")
    everyone = (genie_of(given[0]), *candidates_of(given, families or ()))
    compiled = []
    with progressing("build", len(everyone), shown=progress) as advance:
        for each in everyone:
            compiled.append(build(each.spec))
            advance(1)
        with ThreadPoolExecutor() as pool:
            costs = list(pool.map(footprint, compiled))
    signals = {"u": u, "params": params, "sensor": sensor, "input": input, "present": present}
    size = {"runs": runs, "steps": steps, "skip": ready, "seed": seed}
    with progressing("simulate and filter", runs * len(everyone), shown=progress) as advance:
        pairs = list(zip(everyone, compiled, strict=True))
        results = _scored(given[0], pairs, false_alarm, signals, advance, **size)
    found = ranked(given[0], everyone, results, costs, false_alarm, **size)
    caveats = (
        f"{each.label}: {finding.message}"
        for each in everyone[1:]
        for finding in family(each.spec.filter.family).caveats(each.spec)
    )
    return replace(found, notes=(*found.notes, *caveats, *left_out))


def _scored(
    truth: Spec,
    filters: Sequence[tuple[Candidate, CompiledFilter]],
    false_alarm: float,
    signals: Mapping[str, Any],
    advance: Advance,
    *,
    runs: int,
    steps: int,
    skip: int,
    seed: int,
) -> list[Scores]:
    """Simulate and filter in chunks: only scores are kept; the first candidate is the genie."""
    from scipy.special import gammainccinv  # noqa: PLC0415 - scipy.stats would take a second

    rows = np.arange(1, truth.model.ny + 1)
    # What the NIS of 0, 1, ... rows exceeds with the probability of a false alarm.
    limits = np.array([np.inf, *(2.0 * gammainccinv(0.5 * rows, false_alarm))])
    parts: list[list[Scores]] = [[] for _ in filters]
    for start in range(0, runs, size := max(1, CHUNK // steps)):
        count = min(size, runs - start)
        given = {name: _part(each, start, start + count) for name, each in signals.items()}
        drawn = simulate(truth, count, steps, seed, first=start, **given)
        for found, (each, compiled) in zip(parts, filters, strict=True):
            told = filter_inputs(drawn, each.spec, genie=found is parts[0])
            found.append(score(compiled, told, drawn, skip=skip, limits=limits))
            advance(count)
    return [Scores(*map(np.concatenate, zip(*each, strict=True))) for each in parts]


def _part(signal: Any, start: int, stop: int) -> Any:
    """The trials of a chunk, if a signal has one record for each."""
    array = np.asarray(signal)
    return array[start:stop] if array.ndim == 3 else signal
