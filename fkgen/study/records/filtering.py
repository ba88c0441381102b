"""Filter a record from a file into a file and a picture: what ``fkgen run`` does."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fkgen.pipeline import build
from fkgen.problem import Spec
from fkgen.runtime.compiled import CompiledFilter
from fkgen.runtime.results import Run
from fkgen.study.records.columns import Selection, run_table, select, to_csv
from fkgen.study.records.files import refuse_existing, refuse_format, write_whole
from fkgen.study.records.table import Table, read_table
from fkgen.symbolic.interface import Status

#: What the picture needs besides what the user keeps.
_DRAWN = (
    *("filtered_state", "filtered_sd", "innovation", "nis", "mode_probability"),
    *("test_statistic", "test_dof", "fault_declared"),
)


@dataclass(frozen=True, slots=True)
class Job:
    """What to read and what to write.

    Attributes
    ----------
    record : Path
        The CSV file with the measurements.
    output, plot : Path or None
        Files to write; without ``output`` the text is handed back.
    keep : tuple of str
        Ports to write; the usual ones if empty.
    force : bool
        Replace files that exist.
    """

    record: Path
    output: Path | None = None
    plot: Path | None = None
    keep: tuple[str, ...] = ()
    force: bool = False


@dataclass(frozen=True, slots=True)
class Outcome:
    """What there is to say afterwards.

    Attributes
    ----------
    text : str
        The CSV text if no file was asked for, else empty.
    notes : tuple of str
        What was ignored or taken for granted, and what was written.
    problems : tuple of str
        Samples that were refused.
    """

    text: str
    notes: tuple[str, ...]
    problems: tuple[str, ...]


def run(spec: Spec, job: Job) -> Outcome:
    """Read, build, filter, write.

    Raises
    ------
    DataError, OutputError, CompilerError
        If the record does not fit the spec, a file cannot be written, or there is no compiler; no
        file is written then.
    """
    for path in (job.output, job.plot):
        if path is not None:
            refuse_existing(path, force=job.force, hint=", or --force to replace it")
    if job.plot is not None:
        refuse_format(job.plot)
    table = read_table(job.record, spec)
    built = build(spec)
    selection = select(built.layout, job.keep)
    stored = selection.ports
    if job.plot is not None:
        drawn = select(built.layout, [name for name in _DRAWN if _has(built, name)])
        stored = tuple(dict.fromkeys((*stored, *drawn.ports)))
    result = run_table(built, table, Selection(selection.shown, stored))
    picture = _picture(spec, table, result, job.plot) if job.plot is not None else b""
    data = to_csv(built.layout, table, result, selection)
    notes = list(table.notes)
    for path, content in ((job.output, data), (job.plot, picture)):
        if path is not None:
            write_whole(path, content, force=job.force)
            notes.append(f"{path}: written, {len(table.lines)} samples")
    text = "" if job.output is not None else data.decode("utf-8")
    return Outcome(text, tuple(notes), refusals(built, table, result))


def _has(built: CompiledFilter, name: str) -> bool:
    return name.endswith("_sd") or name in built.ports


def _picture(spec: Spec, table: Table, result: Run, path: Path) -> bytes:
    from fkgen.study.reports.plots import draw, rendered  # noqa: PLC0415 - slow to import

    return rendered(draw(spec, table, result), path)


def refusals(built: CompiledFilter, table: Table, result: Run) -> tuple[str, ...]:
    """One sentence per reason for which samples were refused: how often, where first, why."""
    sentences = []
    for value in np.unique(result.status[result.refused]).tolist():
        status, where = Status(value), np.flatnonzero(result.status == value)
        name = f"{built.name}_{status.name}".upper()
        samples = "1 sample" if where.size == 1 else f"{where.size} samples"
        line = table.lines[int(where[0])]
        first = "in" if where.size == 1 else "the first in"
        sentences.append(
            f"{table.file}: {samples} refused, {first} line {line}: {name}: {status.meaning}; "
            "the filter went on unchanged"
        )
    return tuple(sentences)
