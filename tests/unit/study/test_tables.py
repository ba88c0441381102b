"""A CSV record is read by the names of its columns; what is wrong with it is told where."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pyarrow as pa
import pytest

import fkgen
from fkgen.errors import DataError
from fkgen.study.records.filtering import batch_of, columns_of, lines_of, run_table, select
from fkgen.study.records.reading import as_arrow, as_numpy
from fkgen.study.records.table import read_table

SPEC = fkgen.Spec.from_dict(
    {
        "name": "cart",
        "parameters": {"dt": 0.1},
        "model": {
            "A": [[1.0, "dt"], [0.0, 1.0]],
            "B": [[0.0], ["dt"]],
            "C": [[1.0, 0.0], [0.0, 1.0]],
            "Q": [[1e-4, 0.0], [0.0, 1e-2]],
            "R": [[1.0, 0.0], [0.0, 1.0]],
            "x0": [0.0, 0.0],
            "P0": [[1.0, 0.0], [0.0, 1.0]],
            "states": [{"name": "position", "unit": "m"}, {"name": "speed", "unit": "m/s"}],
            "inputs": [{"name": "push", "unit": "N"}],
            "outputs": [{"name": "gnss", "unit": "m"}, {"name": "wheel", "unit": "m/s"}],
        },
        "filter": {"family": "kf"},
    }
)
HEAD = "t,push,gnss,wheel,dt\n"


def written(layout, table, run, selection):
    return lines_of(table, batch_of(table, columns_of(layout, run, selection), run.status))


@pytest.fixture
def read(tmp_path):
    def reader(text, spec=SPEC):
        path = tmp_path / "r.csv"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return read_table(path, spec)

    return reader


def test_columns_are_found_by_name_in_any_order(read):
    table = read("wheel,dt,t,gnss,push\n1,1,10,3,5\n2,0.3,11,4,6\n")
    np.testing.assert_array_equal(table.y, [[3, 1], [4, 2]])
    np.testing.assert_array_equal(table.u, [[5], [6]])
    np.testing.assert_array_equal(table.params["dt"], [1, 0.3])
    np.testing.assert_array_equal(table.time, [10, 11])
    assert (table.time_name, table.time_text) == ("t", ("10", "11"))
    assert [table.where(k) for k in range(table.samples)] == ["line 2", "line 3"]
    assert table.notes == ()


@pytest.mark.parametrize("missing", ["", "nan", "NaN", "  "])
def test_missing_measurements_are_nan(read, missing):
    table = read(f"{HEAD}0,1,{missing},2,0.1\n")
    np.testing.assert_array_equal(table.y, [[np.nan, 2]])


def test_a_missing_parameter_column_means_its_default(read):
    table = read("push,gnss,wheel\n1,2,3\n")
    assert table.params == {}
    assert "default of parameter dt" in table.notes[0]


def test_extra_columns_are_ignored_and_said(read):
    table = read("push,gnss,wheel,dt,comment,\n1,2,3,0.1,what,\n")
    assert table.notes[0].endswith("ignored: 'comment'")


@pytest.mark.parametrize("name", ["t", "t_s", "time"])
def test_time_columns(read, name):
    assert read(f"{name},push,gnss,wheel,dt\n7,1,2,3,4\n").time_name == name


def test_without_a_time_samples_are_counted(read):
    table = read("push,gnss,wheel,dt\n1,2,3,4\n1,2,3,4\n")
    np.testing.assert_array_equal(table.time, [0, 1])
    assert (table.time_name, table.time_text) == ("", ())


def test_a_signal_called_t_is_no_time(read):
    table = {"name": "x", "filter": {"family": "kf"}}
    model = {"A": [[1.0]], "C": [[1.0]], "Q": [[1.0]], "R": [[1.0]], "x0": [0.0], "P0": [[1.0]]}
    spec = fkgen.Spec.from_dict(table | {"model": model | {"outputs": [{"name": "t"}]}})
    assert read("t\n5\n3\n", spec).time_name == ""
    np.testing.assert_array_equal(read("t\n5\n\n3\n\n", spec).y, [[5], [3]])


def test_quotes_crlf_bom_and_blank_lines_are_read(read):
    table = read(b'\xef\xbb\xbft,push,gnss,wheel,dt\r\n0,1,"2",3,4\r\n\r\n1,1,2,3,4\r\n')
    assert [table.where(k) for k in range(table.samples)] == ["line 2", "line 4"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1: given an empty file; expected a header"),
        ("\n\n", "line 1: given an empty file"),
        (HEAD, "given a header and nothing below it; expected at least one sample"),
        (
            "t,gnss,wheel\n1,2,3\n",
            r"line 1: given no column push \(there are: t, gnss, wheel\); expected a column for",
        ),
        ("t;push;gnss\n1;2;3\n", r"line 1: given no column wheel \(there are: t, push, gnss\)"),
        (
            "push,gnss,gnss,wheel\n1,2,3,4\n",
            "line 1: column of gnss: given two columns 'gnss'; expected different",
        ),
        ("gnss,GPS [m],wheel\n1,2,3\n", "no column push"),
        ("push,GNSS,gnss [m],wheel\n1,2,3,4\n", "given 'GNSS' and 'gnss \\[m\\]'; expected diff"),
        ("1,2,3,4\n", "line 1: given numbers and no header; expected a header, or --column NAME=1"),
        (f"{HEAD}0,1,2,3,4\n0,1,2,3\n", "line 3: given 4 fields; expected 5, as in the header"),
        (f"{HEAD}0,1,2,3,4,5\n", "line 2: given 6 fields"),
        (f"{HEAD}0,1,2,3,4\n0,1,two,3,4\n", "line 3, column gnss: given 'two'; expected a number"),
        (f"{HEAD}0,1,1_0,3,4\n", "column gnss: given '1_0'"),
        (f'{HEAD}0,1,"1,500",3,4\n', "column gnss: given '1,500'"),
        (f"{HEAD}0,1,1,3,4\n1,1,-9999,3,4\n", "line 3, column gnss: given -9999; .* --missing"),
        (f"{HEAD}0,,2,3,4\n", "line 2, column push: given nothing; expected a finite number: an i"),
        (f"{HEAD}0,nan,2,3,4\n", "line 2, column push: given nan; expected a finite number"),
        (f"{HEAD}0,inf,2,3,4\n", "line 2, column push: given inf"),
        (
            "push,gnss,wheel,dt\n1,2,3,\n1,2,3,4\n",
            "line 2, column dt: given nothing; expected a finite number: a para",
        ),
        (f"{HEAD},1,2,3,4\n", "line 2, column t: given nothing"),
        (
            f"{HEAD}2,1,2,3,4\n\n1,1,2,3,4\n",
            "line 4, column t: given 1 after 2; expected times that increase; --time '' goes with",
        ),
        (f"{HEAD}1,1,2,3,4\n1,1,2,3,4\n", "line 3, column t: given 1 after 1"),
        (f'{HEAD}"0,1,2,3,4\n', "line 2: given 1 fields"),
        (f'{HEAD}0,1,2,3,4\n1,"1,2,3,4\n2,1,2,3,4\n', "several lines: a quote that is not closed"),
        (f"{HEAD}".encode() + b"0,1,\xff,3,4\n", "column gnss: given 'ÿ'"),
    ],
)
def test_what_is_wrong_is_said_with_its_place(read, tmp_path, text, message):
    with pytest.raises(DataError, match=message) as error:
        read(text)
    assert str(error.value).startswith(str(tmp_path / "r.csv"))
    assert "\n" not in str(error.value)


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(DataError, match=r"cannot be read .no such file or directory.; expected"):
        read_table(tmp_path / "none.csv", SPEC)
    with pytest.raises(DataError, match="is a directory"):
        read_table(tmp_path, SPEC)


@pytest.fixture(scope="module")
def cart():
    return fkgen.build(SPEC)


def test_columns_have_the_names_of_signals(read, cart):
    table = read(f"{HEAD}0,1,2,,0.1\n0.1,1,2,3,0.1\n")
    selection = select(cart.layout)
    run = run_table(cart, table, selection)
    columns = dict(columns_of(cart.layout, run, selection))
    assert list(columns) == [
        *("filtered_state.position", "filtered_state.speed"),
        *("filtered_sd.position", "filtered_sd.speed"),
        *("innovation.gnss", "innovation.wheel", "nis"),
    ]
    direct = cart.run(table.y, table.u, {"dt": 0.1})
    np.testing.assert_array_equal(columns["filtered_state.speed"], direct.filtered_state[:, 1])
    deviation = np.sqrt(direct.filtered_covariance[:, 0, 0])
    np.testing.assert_array_equal(columns["filtered_sd.position"], deviation)


def test_covariances_are_written_as_their_lower_triangle(cart):
    selection = select(cart.layout, ["innovation_covariance", "predicted_covariance"])
    run = cart.run(np.zeros((1, 2)), np.zeros((1, 1)), keep=selection.ports)
    assert [name for name, _ in columns_of(cart.layout, run, selection)] == [
        *(f"innovation_covariance.{pair}" for pair in ("gnss.gnss", "wheel.gnss", "wheel.wheel")),
        "predicted_covariance.position.position",
        "predicted_covariance.speed.position",
        "predicted_covariance.speed.speed",
    ]


def test_an_unknown_port_is_refused_with_a_suggestion(cart):
    with pytest.raises(DataError, match="'filtered_stat'; expected 'filtered_state'"):
        select(cart.layout, ["filtered_stat"])


def test_csv_gives_the_same_numbers_back(read, cart):
    table = read(f"{HEAD}0.10,1,0.1,,0.1\n1e0,1,2,3,0.1\n")
    selection = select(cart.layout)
    run = run_table(cart, table, selection)
    lines = written(cart.layout, table, run, selection).decode().splitlines()
    assert lines[0].startswith("t,filtered_state.position,")
    assert lines[0].endswith(",nis,status")
    rows = [line.split(",") for line in lines[1:]]
    assert [row[0] for row in rows] == ["0.10", "1e0"]
    assert [float(row[1]) for row in rows] == run.filtered_state[:, 0].tolist()
    assert rows[0][6] == ""  # the innovation of a missing row
    assert [row[-1] for row in rows] == ["0", "0"]


def test_float_columns_have_nine_digits(read):
    spec = fkgen.Spec.from_dict(SPEC.to_dict() | {"code": {"scalar": "float"}})
    built = fkgen.build(spec)
    table = read(f"{HEAD}0,1,0.1,0.3,0.1\n", spec)
    selection = select(built.layout)
    run = run_table(built, table, selection)
    fields = written(built.layout, table, run, selection).decode().splitlines()[1].split(",")
    assert np.float32(fields[1]) == run.filtered_state[0, 0]
    assert len(fields[1]) < 15


@pytest.mark.exhaustive
def test_a_hundred_thousand_rows_come_out_as_they_went_in(read, cart, tmp_path):
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(100_000, 4)).round(6)
    body = "\n".join(f"{k},{a},{b},{c},{abs(d)}" for k, (a, b, c, d) in enumerate(rows.tolist()))
    path = tmp_path / "r.csv"
    path.write_text(HEAD + body, encoding="utf-8")
    table = read_table(path, SPEC)
    selection = select(cart.layout)
    run = run_table(cart, table, selection)
    lines = written(cart.layout, table, run, selection).decode().splitlines()
    assert len(lines) == 100_001
    at = lines[0].split(",").index("filtered_state.position")
    assert float(lines[-1].split(",")[at]) == run.filtered_state[-1, 0]


@pytest.mark.parametrize("kind", [bool, np.int32, np.float32, np.float64])
def test_numbers_go_to_arrow_and_back(kind):
    values = np.array([[1, 0], [0, 5], [1, 0]], kind)[:, 0]
    there = as_arrow(values)
    assert there.to_pylist() == values.tolist()
    assert there.null_count == 0
    assert as_arrow(np.array([0.5, np.nan, np.inf], np.float32)).to_pylist() == [0.5, None, np.inf]
    back = as_numpy(pa.chunked_array([[1.0, None], [2.0]]).combine_chunks())
    np.testing.assert_array_equal(back, [1.0, np.nan, 2.0])
    assert as_numpy(there.slice(0, 0).cast(pa.float64())).size == 0


def test_pandas_is_not_loaded_for_a_csv_file(tmp_path):
    (tmp_path / "r.csv").write_text("t,y,more\n0,1,a\n0.1,,b\n", encoding="utf-8")
    work = (
        "import sys; from pathlib import Path; from fkgen.study.records.reading import *\n"
        "from fkgen.study.records.record import opened\n"
        "(piece,) = opened(checked(Path('r.csv')), ('y',)).pieces((0, 1), (0,))\n"
        "as_arrow(piece[1])\n"
        "assert 'pandas' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", work], cwd=tmp_path, check=True)
