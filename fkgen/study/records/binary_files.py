"""Parquet files, NumPy archives and MATLAB files, in pieces."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import compute as arrow

from fkgen.errors import DataError
from fkgen.study.records.csv_files import Piece
from fkgen.study.records.reading import Reading, as_numpy

_ROWS = 1 << 16  # of a piece
_PARQUET, _ZIP, _HDF = b"PAR1", b"PK\x03\x04", b"\x89HDF\r\n\x1a\n"
_BROKEN = (pa.ArrowException, OSError, UnicodeError)  # what a broken Parquet file raises
_MATLAB = b"MATLAB "
_HDF_IN_MATLAB = 512  # bytes of text before the HDF file that a MATLAB file of version 7.3 is


class BinaryFile:
    """Columns with names and types; samples are counted from 1 as rows."""

    notes: tuple[str, ...] = ()
    stamps: tuple[int, ...] = ()  # columns that are typed as timestamps
    decimal = "."

    def __init__(self, reading: Reading, headings: Sequence[str]) -> None:
        self.file, self.headings = str(reading.path), tuple(headings)

    def pieces(self, columns: Sequence[int], texts: Collection[int]) -> Iterator[Piece]:
        """The columns from the first sample to the last; those of ``texts`` as they are typed."""
        raise NotImplementedError

    def where(self, sample: int) -> str:
        """The place of a sample, for a message."""
        return f"row {sample + 1}"

    def text(self, sample: int, column: int) -> str:
        """A value, for a message."""
        done = 0
        for piece in self.pieces((column,), (column,)):
            values = piece[column]
            if sample < done + len(values):
                return str(values[sample - done])
            done += len(values)
        return "nothing"

    def place(self, column: int | None = None, sample: int | None = None) -> str:
        """File, row and column, as far as they are known."""
        row = "" if sample is None else f", {self.where(sample)}"
        return f"{self.file}{row}{'' if column is None else f', column {self.headings[column]}'}"

    def _numbers(self, column: int, values: Any) -> Any:
        """Numbers of a typed column; NaN where there is none."""
        kind = values.type
        if pa.types.is_dictionary(kind):
            values = values.dictionary_decode()
            kind = values.type
        fit = (pa.types.is_integer, pa.types.is_floating, pa.types.is_decimal, pa.types.is_null)
        if not any(check(kind) for check in fit):
            raise DataError(
                self.place(column), given=f"type {kind}", expected="a column of numbers"
            )
        return as_numpy(arrow.cast(values, pa.float64(), safe=False))


class ParquetFile(BinaryFile):
    """A Parquet file, read by row groups."""

    def __init__(self, reading: Reading) -> None:
        from pyarrow import parquet  # noqa: PLC0415 - for those who have such files

        try:
            self._parquet = parquet.ParquetFile(reading.path)
            schema = self._parquet.schema_arrow
            names = [str(name) for name in schema.names]
        except _BROKEN as error:
            raise _unreadable(reading, error) from None
        super().__init__(reading, names)
        self.stamps = tuple(i for i, t in enumerate(schema.types) if pa.types.is_timestamp(t))

    def pieces(self, columns: Sequence[int], texts: Collection[int]) -> Iterator[Piece]:
        """Pieces of a row group or of less."""
        names = [self.headings[i] for i in columns]
        try:
            for batch in self._parquet.iter_batches(batch_size=_ROWS, columns=names):
                found = {i: batch.column(self.headings[i]) for i in columns}
                yield {i: v if i in texts else self._numbers(i, v) for i, v in found.items()}
        except _BROKEN as error:
            given = f"a Parquet file that breaks off ({_one_line(error)})"
            raise DataError(self.file, given=given, expected="a whole one") from None


class ArrayFile(BinaryFile):
    """Variables of one length; a single number holds for all samples."""

    def __init__(self, reading: Reading, names: Sequence[str], load: Callable[[str], Any]) -> None:
        super().__init__(reading, names)
        self._load = load

    def pieces(self, columns: Sequence[int], texts: Collection[int]) -> Iterator[Piece]:
        """Slices of the variables."""
        found = {i: self._vector(i) for i in columns}
        longest = max(columns, key=lambda i: len(found[i]))
        samples = len(found[longest])
        for i, values in found.items():
            if len(values) not in {1, samples}:
                given = f"{len(values)} values"
                expected = f"{samples}, as {self.headings[longest]} has"
                raise DataError(self.place(i), given=given, expected=expected)
        for start in range(0, samples, _ROWS):
            stop = min(start + _ROWS, samples)
            piece: Piece = {}
            for i, values in found.items():
                part = values[start:stop] if len(values) == samples else values.repeat(stop - start)
                typed = pa.array(part, from_pandas=False)
                piece[i] = typed if i in texts else self._numbers(i, typed)
            yield piece

    def _vector(self, column: int) -> Any:
        name = self.headings[column]
        values = self._load(name)
        array = np.asarray(values)
        if isinstance(values, np.ma.MaskedArray):
            array = np.ma.filled(values.astype(float), np.nan)
        if array.dtype.kind not in "fiuM" or max(array.shape, default=1) != array.size:
            given = f"shape {array.shape} of type {array.dtype.name}"
            raise DataError(self.place(column), given=given, expected="one number per sample")
        if array.dtype.kind == "M":
            return array.ravel().astype("datetime64[ns]")
        if array.dtype == np.float16 or not array.dtype.isnative:
            array = array.astype(
                array.dtype.newbyteorder("=") if array.itemsize > 2 else np.float32
            )
        return array.ravel()


def binary_file(reading: Reading) -> BinaryFile | None:
    """The file if its first bytes, or its ending, say that it is no text."""
    head = _head(reading)
    if head.startswith(_PARQUET):
        return ParquetFile(reading)
    if head.startswith(_ZIP):
        return _npz(reading)
    if head.startswith(_HDF) or head[_HDF_IN_MATLAB:].startswith(_HDF):
        return _hdf(reading)
    if head.startswith(_MATLAB) or reading.path.suffix.lower() == ".mat":
        return _mat(reading)
    if reading.path.suffix.lower() in {".parquet", ".npz"}:
        raise _unreadable(reading, "its first bytes are those of another file")
    return None


def _head(reading: Reading) -> bytes:
    try:
        with reading.path.open("rb") as file:
            return file.read(_HDF_IN_MATLAB + len(_HDF))
    except (OSError, ValueError) as error:
        reason = str(getattr(error, "strerror", None) or error).lower()
        given = f"a path that cannot be read ({reason})"
        raise DataError(str(reading.path), given=given, expected="a record file") from None


def _npz(reading: Reading) -> BinaryFile:
    try:
        with zipfile.ZipFile(reading.path) as archive:
            names = [name.removesuffix(".npy") for name in archive.namelist() if ".npy" in name]
    except Exception as error:  # noqa: BLE001 - of a broken file anything may come
        raise _unreadable(reading, error) from None
    if not names:
        given, expected = "an archive without arrays", "a .npz file; of a spreadsheet, its CSV file"
        raise DataError(str(reading.path), given=given, expected=expected)

    def load(name: str) -> Any:
        try:
            with np.load(reading.path, allow_pickle=False) as arrays:
                return arrays[name]
        except Exception as error:  # noqa: BLE001 - as above
            raise _unreadable(reading, f"{name}: {error}") from None

    return ArrayFile(reading, names, load)


def _mat(reading: Reading) -> BinaryFile:
    from scipy import io  # noqa: PLC0415 - for those who have such files

    def read(call: Callable[..., Any], **options: Any) -> Any:
        try:
            return call(str(reading.path), **options)
        except Exception as error:  # noqa: BLE001 - of a broken file anything may come
            raise _unreadable(reading, error) from None

    names = [name for name, _, _ in read(io.whosmat)]

    def load(name: str) -> Any:
        return read(io.loadmat, variable_names=[name])[name]

    return ArrayFile(reading, names, load)


def _hdf(reading: Reading) -> BinaryFile:
    """A MATLAB file of version 7.3, which is an HDF5 file."""
    try:
        import h5py  # noqa: PLC0415 - no part of fkgen
    except ImportError:
        given, expected = "a MATLAB file of version 7.3", "h5py to read it: pip install h5py"
        raise DataError(
            str(reading.path), given=given, expected=f"{expected}; or save -v7"
        ) from None

    try:
        with h5py.File(reading.path) as file:
            items = [(n, item) for n, item in file.items() if isinstance(n, str)]
            names = [name for name, item in items if isinstance(item, h5py.Dataset)]
    except Exception as error:  # noqa: BLE001 - of a broken file anything may come
        raise _unreadable(reading, error) from None

    def load(name: str) -> Any:
        try:
            with h5py.File(reading.path) as file:
                return file[name][()]
        except Exception as error:  # noqa: BLE001 - as above
            raise _unreadable(reading, error) from None

    return ArrayFile(reading, names, load)


def _unreadable(reading: Reading, reason: object) -> DataError:
    given = f"a file that cannot be read ({_one_line(reason)})"
    expected = f"a whole {reading.path.suffix.lower() or 'record'} file"
    return DataError(str(reading.path), given=given, expected=expected)


def _one_line(reason: object) -> str:
    return " ".join(str(reason).split())[:120].rstrip(".")
