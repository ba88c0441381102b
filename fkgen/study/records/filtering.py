"""Filter a record from a file into a file and a picture: what ``fkgen run`` does."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fkgen.pipeline import build
from fkgen.problem import Spec
from fkgen.runtime.compiled import CompiledFilter
from fkgen.runtime.results import Run
from fkgen.study.records.columns import Selection, run_table, select, to_csv
from fkgen.study.records.files import refuse_targets, write_whole
from fkgen.study.records.table import Table, read_table
from fkgen.symbolic.interface import Status


def run(
    spec: Spec, record: Path, *, output: Path | None, plot: Path | None, keep: str, force: bool
) -> tuple[str, list[str], list[str]]:
    """Read, build, filter, write the columns ``keep`` and a picture; all of it or nothing.

    What to say afterwards: the CSV text if no file was asked for; notes on what was ignored, taken
    for granted or written; samples that were refused.
    """
    refuse_targets(output, plot, force=force)
    table = read_table(record, spec)
    built = build(spec)
    names = [name.strip() for name in keep.split(",") if name.strip()]
    selection = select(built.layout, names)
    drawn = () if plot is None else select(built.layout).ports
    stored = tuple(dict.fromkeys((*selection.ports, *drawn)))
    result = run_table(built, table, Selection(selection.shown, stored))
    picture = b""
    if plot is not None:
        from fkgen.study.reports.plots import draw, rendered  # noqa: PLC0415 - slow to import

        picture = rendered(draw(spec, table, result), plot)
    data = to_csv(built.layout, table, result, selection)
    notes = list(table.notes)
    for path, content in ((output, data), (plot, picture)):
        if path is not None:
            write_whole(path, content, force=force)
            notes.append(f"{path}: written, {len(table.lines)} samples")
    text = "" if output is not None else data.decode("utf-8")
    return text, notes, _refusals(built, table, result)


def _refusals(built: CompiledFilter, table: Table, result: Run) -> list[str]:
    """One sentence per reason for which samples were refused: how often, where first, why."""
    sentences = []
    for value in np.unique(result.status[result.refused]).tolist():
        status, where = Status(value), np.flatnonzero(result.status == value)
        several = f"{where.size} samples refused, the first in"
        sentences.append(
            f"{table.file}: {'1 sample refused, in' if where.size == 1 else several} line "
            f"{table.lines[where[0]]}: {f'{built.name}_{status.name}'.upper()}: {status.meaning}; "
            "the filter went on unchanged"
        )
    return sentences
