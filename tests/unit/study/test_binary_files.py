"""Parquet, npz and mat files give the record that the CSV file gives."""

from __future__ import annotations

import sys

import h5py
import numpy as np
import pandas as pd
import polars as pl
import pytest
from scipy import io

import fkgen
from fkgen.errors import DataError
from fkgen.study.records import binary_files
from fkgen.study.records.reading import checked
from fkgen.study.records.table import read_table

ONE, TWO = [[1.0, 0.0], [0.0, 1.0]], [0.0, 0.0]
MODEL = {"A": [[1.0, "dt"], [0.0, "decay"]], "B": [[0.0], ["dt"]], "C": ONE, "Q": ONE, "R": ONE}
MODEL |= {"x0": TWO, "P0": ONE, "inputs": [{"name": "push"}], "sample_time": "dt"}
MODEL |= {"outputs": [{"name": "gps"}, {"name": "speed"}]}
TABLE = {"name": "x", "parameters": {"dt": 0.1, "decay": 1.0}, "model": MODEL}
SPEC = fkgen.Spec.from_dict(TABLE | {"filter": {"family": "kf"}})
NAN = np.nan
COLUMNS = {
    "time": np.array([0.0, 0.1, 0.3, 0.4]),
    "push": np.array([1, 2, 3, 4], np.int16),
    "GPS [m]": np.array([1.0, NAN, 3.0, -9999.0]),
    "speed": np.array([1.0, 2.0, NAN, 4.0], np.float32),
    "decay": np.array([0.9, 0.9, 0.9, 0.9]),
}


def parquet(path, columns):
    frame = pd.DataFrame(columns | {"name": ["a"] * 4})
    frame.astype({"push": "Int64"}).to_parquet(path, row_group_size=3)


def parquet_with_nulls(path, columns):
    floats = pl.selectors.float()
    pl.DataFrame(columns).with_columns(floats.fill_nan(None)).write_parquet(path)


def npz(path, columns):
    np.savez_compressed(path, **columns | {"decay": np.array(0.9), "words": np.array(["a"])})


def mat(path, columns):
    columns = columns | {"decay": 0.9, "text": "abc", "gps": columns["GPS [m]"][:, None]}
    io.savemat(path, {name: each for name, each in columns.items() if name.isalpha()})


def old_mat(path, columns):
    columns = columns | {"decay": 0.9, "gps": columns["GPS [m]"]}
    io.savemat(path, {n: e for n, e in columns.items() if n.isalpha()}, format="4")


def new_mat(path, columns):
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, each in columns.items():
            file[name] = each[:, None]
        file["#refs#/a"] = 1.0
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file")


WRITERS = {
    "r.parquet": parquet,
    "s.pq": parquet_with_nulls,
    "r.npz": npz,
    "r.mat": mat,
    "old.mat": old_mat,
    "new.mat": new_mat,
}


@pytest.mark.parametrize(("name", "write"), WRITERS.items(), ids=WRITERS)
def test_every_file_gives_the_same_record(tmp_path, monkeypatch, name, write):
    monkeypatch.setattr(binary_files, "_ROWS", 3)
    write(tmp_path / name, COLUMNS)
    table = read_table(checked(tmp_path / name, missing=("-9999",)), SPEC)
    np.testing.assert_array_equal(table.y, [[1, 1], [NAN, 2], [3, NAN], [NAN, 4]])
    np.testing.assert_array_equal(table.u, [[1], [2], [3], [4]])
    np.testing.assert_allclose(table.params["dt"], [0.1, 0.2, 0.1, 0.1], atol=1e-15)
    np.testing.assert_array_equal(table.params["decay"], [0.9] * 4)
    assert table.time_text[:3] == ("0", "0.1", "0.3")
    assert table.where(3) == "row 4"


@pytest.mark.parametrize(("name", "write"), WRITERS.items(), ids=WRITERS)
def test_what_is_wrong_names_row_and_column(tmp_path, name, write):
    def message(**changes):
        columns = {name: each for name, each in (COLUMNS | changes).items() if each is not None}
        write(tmp_path / name, columns)
        with pytest.raises(DataError) as error:
            read_table(checked(tmp_path / name, missing=("-9999",)), SPEC)
        assert str(error.value).startswith(str(tmp_path / name))
        assert "\n" not in str(error.value)
        return str(error.value)

    assert ": given no column speed (there are: " in message(speed=None)
    late = message(time=COLUMNS["time"][::-1].copy())
    assert ", row 2, column time: given 0.3 after 0.4" in late
    if name != "r.parquet":  # whose inputs are whole numbers
        missing = message(push=np.array([1, 2, NAN, 4.0]))
        assert ", row 3, column push: given" in missing
        assert missing.endswith("an input is never missing")


@pytest.mark.parametrize("name", ["r.npz", "r.mat", "new.mat"])
def test_variables_of_another_length_are_named(tmp_path, name):
    WRITERS[name](tmp_path / name, COLUMNS | {"speed": np.zeros(3)})
    with pytest.raises(DataError, match="column speed: given 3 values; expected 4, as "):
        read_table(checked(tmp_path / name, missing=("-9999",)), SPEC)
    WRITERS[name](tmp_path / name, COLUMNS | {"speed": np.zeros((4, 2))})
    with pytest.raises(DataError, match=r"column speed: given shape \((4, 2|4, 1, 2)\) of type"):
        read_table(checked(tmp_path / name, missing=("-9999",)), SPEC)


def test_a_column_of_texts_is_no_signal(tmp_path):
    frame = pd.DataFrame(COLUMNS | {"speed": ["a", "b", "c", "d"]})
    frame.to_parquet(tmp_path / "r.parquet")
    with pytest.raises(DataError, match=r"column speed: given type .*string; expected a column of"):
        read_table(tmp_path / "r.parquet", SPEC)


@pytest.mark.parametrize("name", WRITERS)
def test_broken_files_are_told_in_one_line(tmp_path, name):
    path = tmp_path / name
    WRITERS[name](path, COLUMNS)
    whole = path.read_bytes()
    expected = read_table(checked(path, missing=("-9999",)), SPEC)
    for length in (0, 3, 10, 600, len(whole) // 2, len(whole) - 9):
        path.write_bytes(whole[:length])
        try:
            table = read_table(checked(path, missing=("-9999",)), SPEC)
        except DataError as error:
            message = str(error)
        else:  # what is lost are variables that nobody asked for
            assert length > 0.9 * len(whole)
            np.testing.assert_array_equal(table.y, expected.y)
            continue
        assert "\n" not in message
        assert message.startswith(str(path))


def test_other_archives_and_new_matlab_files_say_what_to_do(tmp_path, monkeypatch):
    new_mat(tmp_path / "new.mat", COLUMNS)
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(
        DataError, match=r"version 7\.3; expected h5py to read it: pip install h5py"
    ):
        read_table(tmp_path / "new.mat", SPEC)
    (tmp_path / "sheet.xlsx").write_bytes(b"PK\x05\x06" + bytes(18))
    with pytest.raises(DataError):
        read_table(tmp_path / "sheet.xlsx", SPEC)
