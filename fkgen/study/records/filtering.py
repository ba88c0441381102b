"""Filter a record from a file: ports of the run as columns, such as ``filtered_state.speed``."""

from __future__ import annotations

import csv
import io
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain, product, repeat
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
from numpy.typing import NDArray

from fkgen.console import counting
from fkgen.errors import DataError
from fkgen.pipeline import build
from fkgen.problem import Spec
from fkgen.runtime import cache
from fkgen.runtime.compiled import CompiledFilter, Pieces
from fkgen.runtime.layout import Layout
from fkgen.runtime.record import choice
from fkgen.runtime.results import Run, Smoothed
from fkgen.study.records.files import kept_whole, refuse_targets, write_whole, written_whole
from fkgen.study.records.reading import Reading, as_arrow
from fkgen.study.records.record import Record, Table
from fkgen.study.records.summary import Summary, several
from fkgen.study.records.table import joined, separated
from fkgen.symbolic.interface import Port, Status

Array = NDArray[np.floating]

#: What is written unless somebody asks for something else, as far as a filter has it.
DEFAULT = (
    *("filtered_state", "filtered_sd", "lagged_state", "lagged_sd", "innovation", "nis"),
    *("mode_probability", "success_rate_estimate"),
    *("test_statistic", "test_dof", "fault_declared"),
)
#: Square roots of the diagonals of covariances: easier to read, and to plot.
DEVIATIONS = {f"{of}_sd": f"{of}_covariance" for of in ("filtered", "predicted", "lagged")}
_STATUS = "status"
GROUP = 1 << 18  # samples of a row group of a Parquet file, about
#: What the last axes of a port are, by its name or the last word of it.
_AXES = {
    "innovation_covariance": ("outputs", "outputs"),
    "gain": ("errors", "outputs"),
    "filtered_gain": ("errors", "outputs"),
    "success_rate_estimate": ("inputs",),
    "state": ("states",),
    "covariance": ("errors", "errors"),
}


@dataclass(frozen=True, slots=True)
class Selection:
    """What to keep of a run."""

    shown: tuple[str, ...]  # ports and standard deviations, in the order of the columns
    ports: tuple[str, ...]  # what the run has to store


def select(layout: Layout, names: Sequence[str] = ()) -> Selection:
    """Decide what to keep: ports and deviations by name, or the default selection."""
    ports = [port.name for port in layout.ports]
    known = [*ports, *(name for name, of in DEVIATIONS.items() if of in ports), _STATUS]
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
            yield from ((f"{name}.{s}", values[:, i]) for i, s in enumerate(layout.errors))
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


def batch_of(table: Table, values: Iterable[tuple[str, Array]], status: NDArray[np.int32]) -> Any:
    """Columns of an output file: times as they were given, values, the status."""
    import pyarrow as pa  # noqa: PLC0415 - slow to import

    columns: list[tuple[str, Any]] = []
    if table.time_name:
        columns.append((table.time_name, pa.array(table.time_text, pa.string())))
    columns += [(name, as_arrow(v)) for name, v in values]
    columns.append((_STATUS, as_arrow(status)))
    names, arrays = zip(*columns, strict=True)
    return pa.RecordBatch.from_arrays(list(arrays), list(names))


def lines_of(table: Table, batch: Any, *, header: bool = True) -> bytes:
    """Such columns as lines of a CSV file.

    Numbers have the digits that give the same number back; a missing one is an empty field.
    """
    from pyarrow import csv as arrow  # noqa: PLC0415 - slow to import

    out = io.BytesIO(csv_text(batch.schema.names, []).encode() if header else b"")
    out.seek(0, io.SEEK_END)
    texts = _some(batch.column(0)) if table.time_name else []
    style = "needed" if any(set(text) & set(',"\n') for text in texts) else "none"
    options = arrow.WriteOptions(include_header=False, quoting_style=style)
    arrow.write_csv(batch, out, options)
    return out.getvalue()


def _some(texts: Any) -> list[str]:
    """Texts among which is one with a comma or a quote, if there is any."""
    from pyarrow import compute  # noqa: PLC0415 - slow to import

    found = compute.match_substring_regex(texts, '[,"\n]')
    return [str(text) for text in texts.filter(found)[:1]]


def csv_text(header: Sequence[str], columns: Sequence[Sequence[object]]) -> str:
    """Columns below their names, as a CSV file."""
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(zip(*columns, strict=True))
    return out.getvalue()


class _Groups:
    """Row groups of a Parquet file, of many pieces each: what there is of them stays in memory."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file, self._writer, self._waiting = file, cast("Any", None), list[Any]()

    def add(self, batch: Any) -> None:
        """Take in a piece, and write what is large enough."""
        self._waiting.append(batch)
        if sum(each.num_rows for each in self._waiting) >= GROUP:
            self._write()

    def close(self) -> None:
        """Write what is left, and the end of the file."""
        self._write()
        if self._writer is not None:
            self._writer.close()

    def _write(self) -> None:
        import pyarrow as pa  # noqa: PLC0415 - slow to import
        from pyarrow import parquet  # noqa: PLC0415

        if self._waiting:
            whole = pa.Table.from_batches(self._waiting)
            self._writer = self._writer or parquet.ParquetWriter(self._file, whole.schema)
            self._writer.write_table(whole)
            self._waiting = []


@dataclass(frozen=True, slots=True)
class Told:
    """What to say of a run that is done."""

    notes: list[str]
    warnings: list[str]
    refused: list[str]
    summary: str


def run(
    spec: Spec,
    reading: Reading,
    *,
    output: Path | None,
    plot: Path | None,
    keep: str,
    force: bool,
    resume: bool = False,
) -> Told:
    """Read, build, filter, write the columns ``keep`` and a picture; all of it or nothing.

    A record passes through in pieces; only a picture needs all of it. An ``output`` that ends in
    .parquet is one, any other a CSV file. Without one, the columns go to the standard output, after
    the last of them is known. To ``resume`` is to keep what was written when something stops it,
    and to go on from there.
    """
    refuse_targets(output, plot, force=force)
    record = Record(reading, spec)
    built = build(spec)
    selection = select(built.layout, separated(keep))
    drawn = () if plot is None else select(built.layout).ports
    summary, refusals = Summary(spec, built), _Refusals(built.name)
    stored = tuple(dict.fromkeys((*selection.ports, *drawn, *summary.ports)))
    filtered, done = built.pieces(stored), list[tuple[Table, Run]]()
    facts = _facts(spec, reading, keep) if resume else None
    lines, shown = _Lines(built.layout, selection), sys.stderr.isatty() and output is not None
    with _written(lines, output, facts, force=force) as write, counting(shown=shown) as advance:
        for table in record.pieces():
            found = filtered.filter(table.y, table.u if built.layout.inputs else None, table.params)
            write(table, found)
            summary.add(table, found)
            refusals.add(table, found, filtered)
            advance(table.samples)
            if plot is not None:
                done.append((table, found))
        if plot is not None:
            from fkgen.study.reports.plots import draw, rendered  # noqa: PLC0415 - slow to import

            whole, runs = joined([each for each, _ in done]), Run.joined([r for _, r in done])
            write_whole(plot, rendered(draw(spec, whole, runs), plot), force=force)
    samples = f"written, {several(summary.samples, 'sample')}"
    written = [f"{path}: {samples}" for path in (output, plot) if path is not None]
    told = Told([*record.notes, *written], list(record.warnings), [], summary.text(table.file))
    told.refused.extend(refusals.sentences(table))
    return told


#: Why smoothed states are not exact, by whether the plant is linearised.
_APPROXIMATE = {
    True: "approximate: the plant is linearised",
    False: "approximate: mixtures over modes are merged (Kim's smoother)",
}


def smooth(
    spec: Spec, reading: Reading, *, output: Path | None, plot: Path | None, force: bool
) -> Told:
    """Read all of a record, filter and smooth it, and write states with standard deviations."""
    refuse_targets(output, plot, force=force)
    record = Record(reading, spec)
    built = build(spec)
    summary, refusals = Summary(spec, built), _Refusals(built.name)
    filtered, tables = built.pieces(summary.ports), list[Table]()
    for table in record.pieces():
        found = filtered.filter(table.y, table.u if built.layout.inputs else None, table.params)
        summary.add(table, found)
        refusals.add(table, found, filtered)
        tables.append(table)
    whole = joined(tables)
    smoothed = built.smooth(whole.y, whole.u if built.layout.inputs else None, whole.params)
    variances = np.diagonal(smoothed.covariance, axis1=-2, axis2=-1)
    named = {"state": (built.layout.states, smoothed.state)}
    named["sd"] = built.layout.errors, np.sqrt(np.maximum(variances, 0.0))
    columns = (
        (f"smoothed_{of}.{name}", values[:, i])
        for of, (names, values) in named.items()
        for i, name in enumerate(names)
    )
    with _target(output, force=force) as file:
        file.write(lines_of(whole, batch_of(whole, columns, smoothed.status)))
        if plot is not None:
            _draw_smoothed(spec, whole, smoothed, plot, force=force)
    notes = [*record.notes, *([_APPROXIMATE[spec.filter.linearises]] * smoothed.approximate)]
    samples = f"written, {several(summary.samples, 'sample')}"
    notes += [f"{path}: {samples}" for path in (output, plot) if path is not None]
    told = Told(notes, list(record.warnings), [], summary.text(whole.file))
    told.refused.extend(refusals.sentences(whole))
    return told


def _draw_smoothed(spec: Spec, table: Table, found: Smoothed, plot: Path, *, force: bool) -> None:
    """A panel per state."""
    from fkgen.study.reports.plots import draw, rendered  # noqa: PLC0415 - slow to import

    values = {"filtered_state": found.state, "filtered_covariance": found.covariance}
    states = Run(values, found.status, np.zeros(len(found.status), np.bool_))
    picture = rendered(draw(spec, table, states, estimate="smoothed"), plot)
    write_whole(plot, picture, force=force)


def _facts(spec: Spec, reading: Reading, keep: str) -> dict[str, Any]:
    """What has to be the same for a run to go on."""
    stat = reading.path.stat()
    return {
        "version": cache.identity(),
        "spec": cache.key_of(spec.canonical()),
        "record": [repr(reading), stat.st_size, stat.st_mtime_ns],
        "keep": keep,
    }


@dataclass(frozen=True, slots=True)
class _Lines:
    """What becomes a file: a run as columns of the selected ports."""

    layout: Layout
    selection: Selection

    def batch(self, table: Table, run: Run) -> Any:
        values = columns_of(self.layout, run, self.selection)
        return batch_of(table, values, run.status)

    def text(self, table: Table, run: Run, *, header: bool) -> bytes:
        return lines_of(table, self.batch(table, run), header=header)


@contextmanager
def _written(
    lines: _Lines, output: Path | None, facts: Mapping[str, Any] | None, *, force: bool
) -> Iterator[Callable[[Table, Run], None]]:
    """What writes a piece after the other: into a CSV file, a Parquet file or the output."""
    in_groups = output is not None and output.suffix.lower() == ".parquet"
    if facts is not None:
        if output is None or in_groups:
            given = "the standard output" if output is None else str(output)
            raise DataError("--resume", given=given, expected="a CSV file as --output")
        with kept_whole(output, facts, force=force) as kept:
            done, there = 0, kept.samples

            def go_on(table: Table, run: Run) -> None:
                nonlocal done
                if done >= there:
                    kept.add(lines.text(table, run, header=done == 0), table.samples)
                done += table.samples

            yield go_on
        return
    with _target(output, force=force) as file:
        if in_groups:
            groups = _Groups(file)
            yield lambda table, run: groups.add(lines.batch(table, run))
            groups.close()
            return
        header = chain([True], repeat(object=False))

        def line_up(table: Table, run: Run) -> None:
            file.write(lines.text(table, run, header=next(header)))

        yield line_up


@contextmanager
def _target(output: Path | None, *, force: bool) -> Iterator[IO[bytes]]:
    """A file that is there in full when all went well; without a name the standard output."""
    if output is not None:
        with written_whole(output, force=force) as file:
            yield file
        return
    with tempfile.TemporaryFile() as file:
        yield file
        file.seek(0)
        sys.stdout.flush()
        shutil.copyfileobj(file, sys.stdout.buffer)
        sys.stdout.buffer.flush()


class _Refusals:
    """Samples that were refused: per reason how often, and where first."""

    def __init__(self, name: str) -> None:
        self._name, self._done = name, 0
        self._found: dict[int, tuple[int, int, int]] = {}
        self._reasons: dict[int, str] = {}

    def add(self, table: Table, run: Run, filtered: Pieces) -> None:
        """Count a piece, the one that was filtered last."""
        for value in np.unique(run.status[run.refused]).tolist():
            where = np.flatnonzero(run.status == value)
            held = int(run.held[where].sum())
            if value not in self._found:
                self._reasons[value] = filtered.reason(int(where[0]))
            count, before, first = self._found.get(value, (0, 0, self._done + int(where[0])))
            self._found[value] = count + where.size, before + held, first
        self._done += table.samples

    def sentences(self, table: Table) -> Iterator[str]:
        """One sentence per reason."""
        for value, (count, held, first) in sorted(self._found.items()):
            status, several = Status(value), f"{count} samples refused, the first in"
            reason = self._reasons[value] and f": {self._reasons[value]}"
            yield (
                f"{table.file}: {'1 sample refused, in' if count == 1 else several} "
                f"{table.where(first)}: {f'{self._name}_{status.name}'.upper()}: {status.meaning}"
                f"{reason}; {_course(count, held)}"
            )


def _course(count: int, held: int) -> str:
    """What became of samples that were refused."""
    if held == count:
        return "held: no time passed there"
    return "taken for missing" + (f", but for {held} that were held" if held else "")
