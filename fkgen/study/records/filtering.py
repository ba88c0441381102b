"""Filter a record from a file: ports of the run as columns, such as ``filtered_state.speed``."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import DataError
from fkgen.pipeline import build
from fkgen.problem import Spec
from fkgen.runtime.compiled import CompiledFilter
from fkgen.runtime.layout import Layout
from fkgen.runtime.record import choice
from fkgen.runtime.results import Run
from fkgen.study.records.files import refuse_targets, write_whole
from fkgen.study.records.table import Table, read_table
from fkgen.symbolic.interface import Port, Status

Array = NDArray[np.floating]

#: What is written unless somebody asks for something else, as far as a filter has it.
DEFAULT = (
    *("filtered_state", "filtered_sd", "innovation", "nis"),
    *("mode_probability", "success_rate_estimate"),
    *("test_statistic", "test_dof", "fault_declared"),
)
#: Square roots of the diagonals of covariances: easier to read, and to plot.
DEVIATIONS = {"filtered_sd": "filtered_covariance", "predicted_sd": "predicted_covariance"}
_STATUS = "status"
#: What the last axes of a port are, by its name or the last word of it.
_AXES = {
    "innovation_covariance": ("outputs", "outputs"),
    "gain": ("states", "outputs"),
    "filtered_gain": ("states", "outputs"),
    "success_rate_estimate": ("inputs",),
    "state": ("states",),
    "covariance": ("states", "states"),
}


@dataclass(frozen=True, slots=True)
class Selection:
    """What to keep of a run."""

    shown: tuple[str, ...]  # ports and standard deviations, in the order of the columns
    ports: tuple[str, ...]  # what the run has to store


def select(layout: Layout, names: Sequence[str] = ()) -> Selection:
    """Decide what to keep: ports and deviations by name, or the default selection."""
    known = [*(port.name for port in layout.ports), *DEVIATIONS, _STATUS]
    for name in names:
        if name not in known:
            raise DataError("--keep", given=repr(name), expected=choice(name, known))
    shown = dict.fromkeys(names or (name for name in DEFAULT if name in known))
    shown.pop(_STATUS, None)
    stored = dict.fromkeys(DEVIATIONS.get(name, name) for name in shown)
    return Selection(tuple(shown), tuple(stored))


def run_table(built: CompiledFilter, table: Table, selection: Selection) -> Run:
    """Filter the record of a table."""
    u = table.u if built.layout.inputs else None
    return built.run(table.y, u, table.params, keep=selection.ports)


def deviation(run: Run, name: str) -> Array:
    """Standard deviations (T, n) from the diagonal of a covariance port."""
    variance = np.diagonal(run[DEVIATIONS[name]], axis1=-2, axis2=-1)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def columns_of(layout: Layout, run: Run, selection: Selection) -> Iterator[tuple[str, Array]]:
    """Names and values (T,) of the selected columns; of what is symmetric the lower triangle."""
    ports = {port.name: port for port in layout.ports}
    for name in selection.shown:
        if name in DEVIATIONS:
            values = deviation(run, name)
            yield from ((f"{name}.{s}", values[:, i]) for i, s in enumerate(layout.states))
            continue
        port, entries = ports[name], np.moveaxis(run[name], 0, -1)
        axes = _labels(layout, port)
        for index in product(*map(range, port.shape)):
            if not (port.symmetric and index[-1] > index[-2]):
                label = (labels[i] for labels, i in zip(axes, index, strict=True))
                yield ".".join((name, *label)), entries[index]


def _labels(layout: Layout, port: Port) -> list[Sequence[str]]:
    """Names along each axis: states, measurements, inputs, or numbers."""
    names: list[Sequence[str]] = [[str(i) for i in range(length)] for length in port.shape]
    kind = port.name.rpartition("_")[2]
    axes = _AXES.get(port.name, _AXES.get(kind, ()) if port.symmetric or kind == "state" else ())
    for axis, signals in enumerate(reversed(("outputs",) if port.per_row else axes), 1):
        labels = getattr(layout, signals)
        if len(port.shape) >= axis and port.shape[-axis] == len(labels):
            names[-axis] = labels
    return names


def to_csv(layout: Layout, table: Table, run: Run, selection: Selection) -> bytes:
    """The whole output file: times as they were given, the selected columns, the status.

    Numbers have the digits that give the same number back; a missing one is an empty field.
    """
    columns: list[tuple[str, Sequence[object]]] = [(table.time_name, table.time_text)]
    columns += [(name, _texts(values)) for name, values in columns_of(layout, run, selection)]
    columns.append((_STATUS, run.status.tolist()))
    header, texts = zip(*columns[0 if table.time_name else 1 :], strict=True)
    return csv_text(header, texts).encode("utf-8")


def csv_text(header: Sequence[str], columns: Sequence[Sequence[object]]) -> str:
    """Columns below their names, as a CSV file."""
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(zip(*columns, strict=True))
    return out.getvalue()


def _texts(values: Array) -> Sequence[object]:
    """Digits that give the same number back: nine for a float."""
    shown = "{:.9g}".format if values.dtype == np.float32 else float
    return ["" if math.isnan(value) else shown(value) for value in values.tolist()]


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
            f"{_passage(result.held[where])}"
        )
    return sentences


def _passage(held: NDArray[np.bool_]) -> str:
    """What became of samples that were refused."""
    if not held.any():
        return "it counts as missing" if held.size == 1 else "they count as missing"
    if held.all():
        return "no time passed for the filter"
    return f"they count as missing, but for {np.count_nonzero(held)} at which no time passed"
