"""The part of a report about a record: innovations, whiteness, NIS, faults, gaps, and the truth."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import DataError
from fkgen.problem import Signal, Spec
from fkgen.problem.functions.named import coordinates
from fkgen.runtime.compiled import CompiledFilter
from fkgen.runtime.results import Run
from fkgen.study.campaigns.tally import SIGMAS
from fkgen.study.page.figures import draw_errors, draw_whiteness
from fkgen.study.page.svg import Picture
from fkgen.study.page.trials import spans_of
from fkgen.study.records.filtering import run_table, select
from fkgen.study.records.headings import positions
from fkgen.study.records.reading import Reading
from fkgen.study.records.record import Record, Table, opened
from fkgen.study.records.summary import Summary, several
from fkgen.study.records.table import joined
from fkgen.study.reports.plots import draw, gaps_of, times_of
from fkgen.study.reports.whiteness import correlations
from fkgen.symbolic.interface import VERDICTS
from fkgen.trials.errors import error_signals, errors_of

Array = NDArray[np.floating]

#: Of a list in the page.
_SHOWN = 30
_DECIDED = 0.5
#: Of the interval between samples: how far the times of the truth may be off.
_APART = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Log:
    """A record, filtered; and the truth (T, n), if it is known, NaN where it is not."""

    table: Table
    run: Run
    summary: str
    truth: Array | None


def read_log(
    spec: Spec, table: Table, truth: str | os.PathLike[str] | None, built: CompiledFilter
) -> Log:
    """Filter a record and read the truth.

    Raises
    ------
    DataError
        If the truth has no column for a state, or is that of another record.
    """
    table = replace(table, file=Path(table.file).name)
    true = None if truth is None else _truth(spec, Path(truth), table)
    chosen = select(built.layout)
    extra = [name for name in ("innovation_covariance", "rejected") if name in built.ports]
    ports = tuple(dict.fromkeys((*chosen.ports, *extra)))
    run = run_table(built, table, replace(chosen, ports=ports))
    summary = Summary(spec, built)
    summary.add(table, run)
    return Log(table, run, summary.text(table.file), true)


def _truth(spec: Spec, path: Path, table: Table) -> Array:
    """The states by name, or as `fkgen simulate` calls them, read as measurements of them."""
    names = [name for each in spec.model.states for name in coordinates(each)]
    headings = opened(Reading(path=path), names).headings
    prefixed = {n: f"true.{n}" for n in names if not positions(headings, n)}
    given = {n: h for n, h in prefixed.items() if positions(headings, h)}
    outputs = tuple(Signal(name) for name in names)
    model = replace(spec.model, outputs=outputs, inputs=(), sample_time=None)
    states = replace(spec, model=model, parameters=(), record=type(spec.record)())
    found = joined(list(Record(Reading(path=path, columns=given), states).pieces()))
    if found.samples != table.samples:
        expected = f"{table.samples}, as the record has"
        raise DataError(path.name, given=several(found.samples, "sample"), expected=expected)
    if found.time_name and table.time_name and table.samples > 1:
        off = np.abs(found.time - table.time)
        k = int(np.argmax(off))
        if off[k] > _APART * float(np.median(np.diff(table.time))):
            given_ = f"another time than the record, by {off[k]:.6g} s"
            expected = "the times of the record"
            raise DataError(f"{path.name}: {found.where(k)}", given=given_, expected=expected)
    return found.y


def described(spec: Spec, log: Log) -> dict[str, Any]:
    """What the page says of a record."""
    table, run, file = log.table, log.run, log.table.file
    page: dict[str, Any] = dict.fromkeys(("truth", "innovations", "whiteness", "nis", "verdicts"))
    page |= {"file": file, "summary": f"{log.summary}.", "errors": [], "white": [], "declared": []}
    page["notes"] = [f"{each[:1].upper()}{each[1:]}." for each in _said(table)]
    figure = draw(spec, table, run, parts=("states",), truth=log.truth)
    text = "Estimates within three standard deviations; grey bars where no row of y came."
    page["states"] = Picture.of(figure, "record-states", "Estimates over the record", text)
    if log.truth is not None:
        page |= _errors(spec, log, log.truth)
    if "innovation" in run.ports:
        figure = draw(spec, table, run, parts=("innovation",))
        text = "Measurement less its prediction; crosses were rejected by a test."
        page["innovations"] = Picture.of(figure, "record-innovations", "Innovations", text)
        page |= _whiteness(spec, run)
    if "nis" in run.ports:
        figure = draw(spec, table, run, parts=("nis",))
        text = "Normalised innovation squared of every sample, with the bounds of chi-square."
        page["nis"] = Picture.of(figure, "record-nis", "NIS over the record", text)
    return page | _declared(spec, log) | _gaps(spec, table)


def _said(table: Table) -> Iterator[str]:
    for each in (*table.notes, *table.warnings):
        file, _, text = each.partition(": ")
        yield text if Path(file).name == table.file else each


def _errors(spec: Spec, log: Log, truth: Array) -> dict[str, Any]:
    """Errors against the truth: the picture, and their size by state."""
    error = errors_of(spec.model.states, truth, log.run["filtered_state"])
    variance = np.diagonal(log.run["filtered_covariance"], axis1=-2, axis2=-1)
    sd = np.sqrt(np.maximum(variance, 0.0))
    figure = draw_errors(spec, times_of(spec, log.table), error, sd)
    text = "Truth less estimate, within three of the standard deviations that the filter states."
    rows = []
    for i, signal in enumerate(error_signals(spec.model.states)):
        known = np.isfinite(error[:, i])
        e, s = error[known, i], sd[known, i]
        unit = f" {signal.unit}" if signal.unit else ""
        if not e.size:
            rows.append([signal.name, *["-"] * 5])
            continue
        sizes = [float(np.sqrt(np.mean(np.square(each)))) for each in (e, s)]
        inside = [f"{np.mean(np.abs(e) <= k * s):.1%}" for k in SIGMAS]
        rows.append([signal.name, *(f"{size:.4g}{unit}" for size in sizes), *inside])
    picture = Picture.of(figure, "record-error", "Error in the record against time", text)
    return {"truth": picture, "errors": rows}


def _whiteness(spec: Spec, run: Run) -> dict[str, Any]:
    covariance = None
    if "innovation_covariance" in run.ports:
        covariance = run["innovation_covariance"][np.newaxis]
    found = correlations(run["innovation"][np.newaxis], covariance)
    text = (
        "Correlation of each row's normalised innovations with later ones. Of white innovations"
        " 19 in 20 bars end in the grey band."
    )
    figure = draw_whiteness(spec, found)
    rows = []
    every = zip(found.value, found.bound, found.count, found.probability, strict=True)
    for signal, (values, bound, count, probability) in zip(spec.model.outputs, every, strict=True):
        beyond = f"{int((np.abs(values) > bound).sum())} of {len(values)}"
        rows.append([signal.name, f"{count:.0f}", f"{values[0]:.3f}", beyond, f"{probability:.2g}"])
    picture = Picture.of(figure, "record-whiteness", "Whiteness of innovations", text)
    return {"whiteness": picture, "white": rows}


def _declared(spec: Spec, log: Log) -> dict[str, Any]:
    """The stretches that the filter declares faulty, and the picture of how it decides."""
    run, table = log.run, log.table
    flags, how = _flags(spec, run)
    if flags is None:
        text = "This filter declares no faults; samples beyond the bounds of the NIS are a sign"
        return {"declared_text": f"{text} of one."}
    spans = spans_of(flags)
    text = f"{how}: {several(len(spans), 'stretch')},"
    text += f" {several(int(flags.sum()), 'sample')} of {len(flags)}."
    text += f" The first {_SHOWN} of them:" if len(spans) > _SHOWN else ""
    time, unit = _clock(spec, table)
    rows = [
        [f"{time[begin]:.6g}{unit}", str(length), f"{time[begin + length - 1]:.6g}{unit}"]
        for begin, length in spans[:_SHOWN]
    ]
    found: dict[str, Any] = {"declared_text": text, "declared": rows}
    windows = spec.faults.soft is not None and "test_statistic" in run.ports
    if "mode_probability" in run.ports or windows:
        figure = draw(spec, table, run, parts=("faults",))
        said = (
            "Probabilities of the modes."
            if "mode_probability" in run.ports
            else (
                "Test statistic over its threshold at the ends of windows; crosses are rejections."
            )
        )
        found["verdicts"] = Picture.of(figure, "record-faults", "How faults are declared", said)
    return found


def _flags(spec: Spec, run: Run) -> tuple[NDArray[np.bool_] | None, str]:
    """(T,): samples that are declared faulty, and how that comes about."""
    verdict = np.isin(run.status, [status.value for status in VERDICTS])
    for port in ("fault_declared", "rejected"):
        if port in run.ports:
            flagged = np.asarray(run[port] > 0).reshape(len(run.status), -1).any(axis=1)
            return np.asarray(flagged | verdict), "Rejected by a test"
    faults = spec.faults
    if "mode_probability" in run.ports and (faults.sensor is not None or faults.jump is not None):
        healthy = run["mode_probability"][:, 0]
        if faults.sensor is not None:
            return np.asarray(
                healthy < _DECIDED
            ), "Where the mode without fault has less than one half"
        return np.asarray(healthy < _DECIDED), "Where the first mode has less than one half"
    return (verdict, "Rejected by a test") if verdict.any() else (None, "")


def _gaps(spec: Spec, table: Table) -> dict[str, Any]:
    time, unit = _clock(spec, table)
    found = gaps_of(time, np.asarray(~np.isfinite(table.y).any(axis=1)))
    text = f"{several(len(found), 'gap')} in which no row of y came for longer than usual."
    text += f" The first {_SHOWN} of them:" if len(found) > _SHOWN else ""
    rows = [[f"{begin:.6g}{unit}", f"{length:.6g}{unit}"] for begin, length in found[:_SHOWN]]
    return {"gaps_text": text, "gaps": rows}


def _clock(spec: Spec, table: Table) -> tuple[Array, str]:
    time, label = times_of(spec, table)
    return time, " s" if "(s)" in label else ""
