"""Ports of a run as columns of a CSV file, with names such as ``filtered_state.speed``."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import DataError
from fkgen.runtime import record
from fkgen.runtime.compiled import CompiledFilter
from fkgen.runtime.layout import Layout
from fkgen.runtime.results import Run
from fkgen.study.records.table import Table
from fkgen.symbolic.interface import Port

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


@dataclass(frozen=True, slots=True)
class Selection:
    """What to keep of a run.

    Attributes
    ----------
    shown : tuple of str
        Ports and standard deviations, in the order of the columns.
    ports : tuple of str
        Ports that the run has to store.
    """

    shown: tuple[str, ...]
    ports: tuple[str, ...]


def select(layout: Layout, names: Sequence[str] = ()) -> Selection:
    """Decide what to keep.

    Parameters
    ----------
    layout : Layout
        The filter.
    names : sequence of str
        Ports, ``filtered_sd``, ``predicted_sd``; the default selection if empty.

    Raises
    ------
    DataError
        If the filter has no such port.
    """
    ports = [port.name for port in layout.ports]
    known = [*ports, *DEVIATIONS, _STATUS]
    for name in names:
        if name not in known:
            raise DataError("--keep", given=repr(name), expected=record.choice(name, known))
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
    """Names and values (T,) of the selected columns."""
    ports = {port.name: port for port in layout.ports}
    for name in selection.shown:
        if name in DEVIATIONS:
            values = deviation(run, name)
            for i, state in enumerate(layout.states):
                yield f"{name}.{state}", values[:, i]
            continue
        for label, index in _entries(layout, ports[name]):
            column = run[name]
            for i in index:
                column = column[:, i]
            yield ".".join((name, *label)), column


def _entries(layout: Layout, port: Port) -> Iterator[tuple[tuple[str, ...], tuple[int, ...]]]:
    """Labels and indices of the entries of one sample; the lower triangle of what is symmetric."""
    axes = _labels(layout, port)
    for index in product(*(range(length) for length in port.shape)):
        if not (port.symmetric and index[-1] > index[-2]):
            yield tuple(labels[i] for labels, i in zip(axes, index, strict=True)), index


def _labels(layout: Layout, port: Port) -> list[Sequence[str]]:
    """Names along each axis: states, measurements, inputs, or numbers."""
    names: list[Sequence[str]] = [[str(i) for i in range(length)] for length in port.shape]
    axes: dict[int, Sequence[str]] = {}
    if port.per_row:
        axes = {-1: layout.outputs}
    elif port.name == "innovation_covariance":
        axes = {-1: layout.outputs, -2: layout.outputs}
    elif port.name in {"gain", "filtered_gain"}:
        axes = {-2: layout.states, -1: layout.outputs}
    elif port.name == "success_rate_estimate":
        axes = {-1: layout.inputs}
    elif port.name.endswith("_state"):
        axes = {-1: layout.states}
    elif port.name.endswith("_covariance") and port.symmetric:
        axes = {-1: layout.states, -2: layout.states}
    for axis, labels in axes.items():
        if len(port.shape) >= -axis and port.shape[axis] == len(labels):
            names[axis] = labels
    return names


def to_csv(layout: Layout, table: Table, run: Run, selection: Selection) -> bytes:
    """The whole output file: times as they were given, the selected columns, the status.

    Numbers have the digits that give the same number back; a missing one is an empty field.
    """
    header: list[str] = []
    columns: list[Sequence[object]] = []
    if table.time_name:
        header.append(table.time_name)
        columns.append(table.time_text)
    for name, values in columns_of(layout, run, selection):
        header.append(name)
        columns.append(_texts(values))
    header.append(_STATUS)
    columns.append(run.status.tolist())
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(zip(*columns, strict=True))
    return out.getvalue().encode("utf-8")


def _texts(values: Array) -> Sequence[object]:
    if values.dtype == np.float32:
        return ["" if math.isnan(value) else f"{value:.9g}" for value in values.tolist()]
    if np.isnan(values).any():
        return ["" if math.isnan(value) else value for value in values.tolist()]
    listed: list[object] = values.tolist()
    return listed
