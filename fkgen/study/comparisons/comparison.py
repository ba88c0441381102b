"""Several filters on the same trials of one plant with its faults, and trials as a record."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fkgen.console import progressing
from fkgen.errors import DataError, names_of, of_type
from fkgen.families import family
from fkgen.pipeline import build
from fkgen.problem import Signal, Spec
from fkgen.problem.functions.named import coordinates
from fkgen.problem.spec import as_spec
from fkgen.runtime.record import probability
from fkgen.study.comparisons.candidates import (
    GENIE,
    candidates_of,
    default_families,
    filter_inputs,
    genie_of,
)
from fkgen.study.comparisons.footprint import footprint
from fkgen.study.comparisons.ranking import Comparison, Entry, ranked
from fkgen.study.comparisons.scores import Scores, score
from fkgen.study.records.files import refuse_targets
from fkgen.study.records.filtering import csv_text
from fkgen.study.records.reading import Reading
from fkgen.study.records.record import Table
from fkgen.study.records.table import Say, constants_or_record, profile_of, separated
from fkgen.trials.simulation import Simulation, counted, simulate

Array = NDArray[Any]

#: Samples of a trial, unless a file or somebody says how many.
STEPS = 200
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
    several = specs if isinstance(specs, list | tuple) else (specs,)
    given = tuple(as_spec(each, "specs").whole for each in several)
    if families is not None:
        families = names_of("families", families, "names of families, such as 'kf'")
    if params is not None:
        of_type("params", params, Mapping, "a mapping of names to numbers or (T,) arrays")
    ready = counted("steps", steps) // 4 if skip is None else counted("skip", skip, least=0)
    size = {"runs": runs, "steps": steps, "skip": ready, "seed": seed}
    signals = {"u": u, "params": params, "sensor": sensor, "input": input, "present": present}
    return _compared(given, families, size, signals, false_alarm=false_alarm, shown=progress)


def _compared(
    specs: Sequence[Spec],
    families: Sequence[str] | None,
    size: Mapping[str, int],
    signals: Mapping[str, Any],
    *,
    false_alarm: float,
    shown: bool,
) -> Comparison:
    counted("runs", size["runs"], least=2)
    steps = counted("steps", size["steps"])
    if size["skip"] >= steps:
        expected = f"from 0 to {steps - 1}: some of the {steps} samples have to count"
        raise DataError("skip", given=str(size["skip"]), expected=expected)
    probability("false_alarm", false_alarm)
    if not specs:
        raise DataError("specs", given="none", expected="at least one spec")
    truth, own = specs[0], families is None and len(specs) == 1
    fitting, left_out = default_families(truth) if own else (families or (), ())
    candidates = candidates_of(specs, fitting)
    everyone = [(GENIE, genie_of(truth)), *candidates.items()]
    compiled = []
    with progressing("build", len(everyone), shown=shown) as advance:
        for _, spec in everyone:
            compiled.append(build(spec))
            advance(1)
        with ThreadPoolExecutor() as pool:
            costs = list(pool.map(footprint, compiled))
    results: list[list[Scores]] = [[] for _ in everyone]
    with progressing("simulate and filter", size["runs"] * len(everyone), shown=shown) as advance:
        for trials in _chunks(truth, size, signals):
            for parts, built, (_, spec) in zip(results, compiled, everyone, strict=True):
                told = filter_inputs(trials, spec, genie=parts is results[0])
                parts.append(score(built, told, trials, size["skip"], false_alarm))
                advance(len(trials.y))
    entries = []
    for (label, spec), cost, parts in zip(everyone, costs, results, strict=True):
        whole = Scores(*map(np.concatenate, zip(*parts, strict=True)))
        entries.append(Entry(label, spec.filter.family, cost, whole))
    found = ranked(truth, entries, false_alarm, **size)
    caveats = (
        f"{label}: {finding.message}"
        for label, spec in candidates.items()
        for finding in family(spec.filter.family).remarks(spec)
    )
    return replace(found, notes=(*found.notes, *caveats, *left_out))


def _chunks(
    truth: Spec, size: Mapping[str, int], signals: Mapping[str, Any]
) -> Iterator[Simulation]:
    """All trials, so many at a time as memory should hold."""
    runs, steps = size["runs"], size["steps"]
    for start in range(0, runs, most := max(1, CHUNK // steps)):
        part = slice(start, min(start + most, runs))
        # what has three axes has one record for each trial
        given = {n: s[part] if np.ndim(s) == 3 else s for n, s in signals.items()}
        yield simulate(truth, part.stop - start, steps, size["seed"], first=start, **given)


def drawn(spec: Spec, *, trial: int, **options: Any) -> str:
    """One trial as a CSV text: what a filter is told, then the truth.

    Columns are the times of the record as they stand there, if it has some, the measurements,
    inputs and parameters by name, then ``true.<state>`` and the fault indicators: ``gamma`` and
    ``delta`` of sensors, ``gamma.<input>`` of actuators.
    """
    circumstances, table = _circumstances(spec, **options)
    columns = _columns(spec, simulate(spec, 1, first=trial, **circumstances))
    names = list(columns)
    texts = [["" if math.isnan(v) else v for v in values.tolist()] for values in columns.values()]
    if table is not None and table.time_name:
        names.insert(0, table.time_name)
        texts.insert(0, list(map(str, table.time_text[: circumstances["steps"]])))
    return csv_text(names, texts)


def compared(
    specs: tuple[Spec, ...], *, families: str, plot: Path | None, force: bool, **options: Any
) -> Comparison:
    """Compare, and draw the figure if one is asked for; progress is shown on a terminal."""
    refuse_targets(None, plot, force=force)
    given, _ = _circumstances(specs[0], **options)
    names = tuple(separated(families))
    found = compare(specs, names or None, progress=sys.stderr.isatty(), **given)
    if plot is not None:
        from fkgen.study.comparisons.report import draw_comparison  # noqa: PLC0415 - slow to import
        from fkgen.study.reports.plots import save  # noqa: PLC0415

        save(draw_comparison(found), plot, force=force)
    return found


def _circumstances(
    spec: Spec,
    *,
    steps: int | None,
    record: Reading | None,
    inputs: str,
    profile: Path | None,
    say: Say,
    **sizes: Any,
) -> tuple[dict[str, Any], Table | None]:
    """Number of samples, inputs, parameters, missing rows and soft faults, beside other sizes.

    The record that they come from, if there is one, is the second.
    """
    signals: dict[str, Any] = {}
    lengths: dict[int, Path] = {}
    if profile is not None:
        signals["sensor"], signals["input"] = profile_of(spec, profile)
        lengths[len(signals["sensor"])] = profile
    constants, table = constants_or_record(spec, inputs, record, say)
    params = {} if table is None else table.params
    if table is not None and record is not None:
        lengths[table.samples] = record.path
        signals |= {"present": np.isfinite(table.y), "u": table.u if spec.model.nu else None}
    elif spec.model.nu and constants is None:
        names = ", ".join(signal.name for signal in spec.model.inputs)
        raise DataError("--u", given="nothing", expected=f"numbers for {names}, or a --record")
    most = min(lengths, default=STEPS)
    wanted = most if steps is None else steps
    if lengths and wanted > most:
        expected = f"at most {most}: {lengths[most]} has no more samples"
        raise DataError("--steps", given=str(wanted), expected=expected)
    first = {name: None if each is None else each[:wanted] for name, each in signals.items()}
    over = {name: values[:wanted] for name, values in params.items()}
    return {"u": constants, "params": over, "steps": wanted, **first, **sizes}, table


def _columns(spec: Spec, found: Simulation) -> dict[str, Array]:
    def named(signals: Sequence[Signal], values: Array, prefix: str = "") -> dict[str, Array]:
        return {f"{prefix}{signal.name}": values[:, i] for i, signal in enumerate(signals)}

    model, y = spec.model, found.y[0]
    columns = named(model.outputs, y) | named(model.inputs, found.u)
    columns |= {name: np.broadcast_to(each, len(y)) for name, each in found.params.items()}
    states = [Signal(name) for each in model.states for name in coordinates(each)]
    columns |= named(states, found.state[0], "true.")
    if found.gamma is not None and found.delta is not None:
        columns |= {"gamma": found.gamma[0], "delta": found.delta[0]}
    elif found.gamma is not None:
        columns |= named(model.inputs, found.gamma[0], "gamma.")
    elif found.mode is not None:
        columns["mode"] = found.mode[0]
    if found.arrival is not None:
        columns["arrival"] = found.arrival[0].astype(float)
    return columns
