"""CSV files as loggers and spreadsheets write them give the numbers that were meant."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

import fkgen
from fkgen.errors import DataError
from fkgen.study.records import csv_files
from fkgen.study.records.reading import checked
from fkgen.study.records.table import read_table

ONE, TWO = [[1.0, 0.0], [0.0, 1.0]], [0.0, 0.0]
TABLE = {
    "name": "walk",
    "parameters": {"dt": 0.1},
    "model": {
        "A": [[1.0, "dt"], [0.0, 1.0]],
        "C": ONE,
        "Q": ONE,
        "R": ONE,
        "x0": TWO,
        "P0": ONE,
        "outputs": [{"name": "gps", "unit": "m"}, {"name": "speed", "unit": "m/s"}],
        "sample_time": "dt",
    },
    "filter": {"family": "kf"},
}
SPEC = fkgen.Spec.from_dict(TABLE)
NAN = np.nan
MEANT = np.array([[0.2, 0.3], [NAN, 0.4], [-1500.0, 0.5]])
PLAIN = "t,gps,speed\n0,0.2,0.3\n0.1,,0.4\n0.3,-1.5e3,0.5\n"
COMMAS = PLAIN.replace(",", ";").replace(".", ",")
LATIN = PLAIN.replace("\n", ",°\n").replace("speed,°", "speed,temp [°C]")
DIALECTS = {
    "plain": PLAIN,
    "no line end": PLAIN.rstrip(),
    "BOM and CRLF": "\ufeff" + PLAIN.replace("\n", "\r\n"),
    "old line ends": PLAIN.replace("\n", "\r"),
    "blanks after commas": PLAIN.replace(",", ", "),
    "blanks around commas": PLAIN.replace(",", " , "),
    "quotes": PLAIN.replace(",", '","').replace("\n", '"\n"').join('""')[:-2],
    "comma at every end": PLAIN.replace("\n", ",\n"),
    "comma at every end but the header's": PLAIN.replace("\n", ",\n").replace("speed,", "speed"),
    "semicolons": PLAIN.replace(",", ";"),
    "semicolons, decimal commas": COMMAS,
    "tabs, decimal commas": COMMAS.replace(";", "\t"),
    "bars": PLAIN.replace(",", "|"),
    "decimal commas in quotes": '"' + COMMAS.replace(";", '","').replace("\n", '"\n"')[:-1],
    "tabs": PLAIN.replace(",", "\t"),
    "blanks": PLAIN.replace(",,", ",nan,").replace(",", " "),
    "aligned": PLAIN.replace(",,", ",nan,").replace(",", "   ").replace("\n", "\n  "),
    "numpy.savetxt": "# " + PLAIN.replace(",,", ",nan,").replace(",", " "),
    "plus signs": PLAIN.replace("0.2", "+0.2").replace("0.4", "+0.4"),
    "units": PLAIN.replace("t,gps,speed", "t [s],gps [m],speed (m/s)"),
    "capitals": PLAIN.replace("t,gps,speed", "T,GPS,Speed"),
    "a line of units": PLAIN.replace("speed\n", "speed\ns,m,m/s\n"),
    "a comment": "# logger 1.2\n" + PLAIN,
    "lines before": "Device;A;7\nStart;2024-05-01\n\n" + PLAIN,
    "sep=": "sep=;\n" + PLAIN.replace(",", ";"),
    "blank lines": "\n" + PLAIN.replace("\n", "\n\n"),
    "other columns of one name": PLAIN.replace("\n", ",7,8\n").replace("speed,7,8", "speed,a,a"),
    "zeros": PLAIN + "\0" * 500,
    "zeros within": PLAIN.replace("0.4", "0\0\0.4"),
    "columns in another order": "speed,x,t,gps\n0.3,,0,0.2\n0.4,a,0.1,\n0.5,,0.3,-1500\n",
    **{f"missing as {mark}": PLAIN.replace(",,", f",{mark},") for mark in ("nan", "NaN", "NULL")},
    **{f"missing as {mark}": PLAIN.replace(",,", f",{mark},") for mark in ("None", "NA", "N/A")},
    **{f"missing as {mark}": PLAIN.replace(",,", f",{mark},") for mark in ("#N/A", "-nan(ind)")},
    **{f"missing as {mark}": PLAIN.replace(",,", f",{mark},") for mark in ("1.#QNAN", "-1.#IND")},
    **{f"missing as {mark}": PLAIN.replace(",,", f",{mark},") for mark in ("-", "--", " n/a ")},
}
ENCODED = {
    "latin-1": (LATIN.encode("latin-1"), None),
    "utf-16": (LATIN.encode("utf-16"), None),
    "utf-16-be": (b"\xfe\xff" + LATIN.encode("utf-16-be"), None),
    "utf-16-le without a mark": (LATIN.encode("utf-16-le"), "utf-16-le"),
    "utf-8": (LATIN.encode(), "utf-8"),
    "utf-8 with a mark": (b"\xef\xbb\xbf" + LATIN.encode(), "utf-8"),
    "cp500": (LATIN.encode("cp500"), "cp500"),
}
TOLD = {
    "delimiter": (PLAIN.replace(",", "^"), {"delimiter": "^"}),
    "a tab by name": (PLAIN.replace(",", "\t"), {"delimiter": "tab"}),
    "decimal": (
        't,gps,speed\n0,"0,200","0,300"\n"0,100",,"0,400"\n"0,300","-1500,000","0,500"\n',
        {"decimal": ","},
    ),
    "lines before the header": ("gps,speed\n1,2\n" + PLAIN, {"skip_rows": 2}),
    "a mark": (PLAIN.replace(",,", ",void,"), {"missing": ("void",)}),
    "a number as a mark": (PLAIN.replace(",,", ",-9999.00,"), {"missing": ("-9999",)}),
    "another mark": (PLAIN.replace(",,", ",999,"), {"missing": ("x", "999.0")}),
    "headings": (PLAIN.replace("gps", "Höhe [m]"), {"columns": ("gps=Höhe [m]",)}),
    "headings without their unit": (PLAIN.replace("gps", "Höhe [m]"), {"columns": ("gps=höhe",)}),
    "headings with signs of equality": (PLAIN.replace("gps", "a=b"), {"columns": ("gps=a=b",)}),
    "numbers of columns": (PLAIN.replace("speed", "gps"), {"columns": ("gps=2", "speed=3")}),
    "no header": (PLAIN[12:], {"columns": ("gps=2", "speed=3"), "time": "1"}),
    "a time": (PLAIN.replace("t,", "stamp,", 1), {"time": "stamp"}),
}


@pytest.fixture
def write(tmp_path):
    def writer(content):
        path = tmp_path / "r.csv"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return writer


def meant(table, *, y=MEANT):
    np.testing.assert_array_equal(table.y, y)
    np.testing.assert_allclose(table.time, [0.0, 0.1, 0.3], rtol=1e-15)
    np.testing.assert_allclose(table.params["dt"], [0.1, 0.2, 0.2], rtol=1e-15)


@pytest.mark.parametrize("text", DIALECTS.values(), ids=DIALECTS)
def test_what_is_not_said_is_found_out(write, text):
    meant(read_table(write(text), SPEC))


@pytest.mark.parametrize("text", DIALECTS.values(), ids=DIALECTS)
def test_row_by_row_gives_the_same(write, text, monkeypatch):
    def refuse(*_):
        raise pa.ArrowInvalid

    monkeypatch.setattr(csv_files.CsvFile, "_fast", refuse)
    monkeypatch.setattr(csv_files, "_ROWS", 2)
    meant(read_table(write(text), SPEC))


@pytest.mark.parametrize(("content", "encoding"), ENCODED.values(), ids=ENCODED)
def test_encodings(write, content, encoding):
    table = read_table(checked(write(content), encoding=encoding), SPEC)
    meant(table)
    assert any("ignored: 'temp [°C]'" in note for note in table.notes)


@pytest.mark.parametrize(("text", "options"), TOLD.values(), ids=TOLD)
def test_what_is_said_counts(write, text, options):
    meant(read_table(checked(write(text), **options), SPEC))


def test_the_command_line_beats_the_spec(write):
    spec = fkgen.Spec.from_dict(
        TABLE | {"record": {"columns": {"gps": "height", "speed": "v"}, "time": "stamp"}}
    )
    path = write(PLAIN.replace("t,gps,speed", "stamp,height,v"))
    meant(read_table(path, spec))
    path = write(PLAIN.replace("t,gps,speed", "t,gps,v"))
    meant(read_table(checked(path, columns=("gps=gps",), time="t"), spec))
    with pytest.raises(DataError, match="column of gps: given 'height', which is no heading"):
        read_table(path, spec)


def test_a_record_in_many_pieces_is_the_same_record(write, monkeypatch):
    rng = np.random.default_rng(3)
    y = rng.normal(size=(4000, 2)).round(3)
    y[rng.random(y.shape) < 0.2] = NAN
    t = np.cumsum(rng.integers(1, 50, 4000)) / 1000
    rows = (",".join("" if v != v else repr(v) for v in row) for row in y.tolist())  # noqa: PLR0124
    text = "".join(f"{time:.3f},{row}\n" for time, row in zip(t.tolist(), rows, strict=True))
    monkeypatch.setattr(csv_files, "BLOCK", 1000)
    table = read_table(write("t,gps,speed\n" + text), SPEC)
    np.testing.assert_array_equal(table.y, y)
    np.testing.assert_allclose(table.params["dt"][:-1], np.diff(t), atol=1e-12)
    assert table.params["dt"][-1] == table.params["dt"][-2]
    assert table.where(3999) == "line 4001"
    late = text.replace(f"{t[3000]:.3f},", f"{t[2990]:.3f},")
    with pytest.raises(DataError, match=f"line 3002, column t: given .* after {t[2999]:.3f}"):
        read_table(write("t,gps,speed\n" + late), SPEC)
    wrong = text.replace(f"{t[3500]:.3f},", f"{t[3500]:.3f},o")
    with pytest.raises(DataError, match="line 3502, column gps: given 'o"):
        read_table(write("t,gps,speed\n" + wrong), SPEC)


def test_a_sign_beyond_what_was_looked_at_is_no_obstacle(write, monkeypatch):
    monkeypatch.setattr(csv_files, "HEAD", 64)
    text = PLAIN + "".join(f"{k},   0.5   ,1\n" for k in range(1, 20)) + "20,  na ,\t1\n"
    table = read_table(write(text), SPEC)
    assert table.samples == 23
    np.testing.assert_array_equal(table.y[-1], [NAN, 1.0])


@pytest.mark.parametrize("text", [COMMAS.replace("0,4", "0.4"), PLAIN.replace("0.4", '"0,4"')])
def test_points_and_commas_are_never_mixed(write, text):
    with pytest.raises(
        DataError, match=r"line \d, column (gps|speed|t): given .*; expected a numb"
    ):
        read_table(write(text), SPEC)


def test_a_number_that_may_be_a_mark_is_asked_for_unless_it_is_near(write):
    path = write(PLAIN.replace("0.4", "-9999"))
    with pytest.raises(DataError, match="column speed: given -9999; expected --missing -9999 if"):
        read_table(path, SPEC)
    assert read_table(checked(path, missing=("",)), SPEC).y[1, 1] == -9999
    counted = "t,gps,speed\n" + "".join(f"{k},{-9990 - k},1\n" for k in range(20))
    assert -9999 in read_table(write(counted), SPEC).y


def test_a_unit_that_is_another_is_said(write):
    table = read_table(write(PLAIN.replace("gps", "gps [cm]")), SPEC)
    assert any("'gps [cm]' is taken as it stands, in m" in note for note in table.notes)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"delimiter": "ab"}, "--delimiter: given 'ab'; expected one character"),
        ({"delimiter": "7"}, "--delimiter"),
        ({"decimal": ";"}, "--decimal: given ';'; expected '.' or ','"),
        ({"encoding": "latin-99"}, "--encoding: given 'latin-99'"),
        ({"encoding": "hex"}, "--encoding"),
        ({"skip_rows": -1}, "--skip-rows: given -1"),
        ({"skip_rows": 99}, "an empty file"),
        ({"columns": ("gps",)}, "--column: given 'gps'; expected NAME=HEADING"),
        ({"columns": ("gqs=a",)}, "--column: given 'gqs'; expected 'gps'"),
        ({"columns": ("gps=gqs",)}, "column of gps: given 'gqs', which is no heading.*'gps'"),
        ({"columns": ("gps=9",)}, "column of gps: given '9', which is no heading"),
        ({"time": "stamp"}, "time column: given 'stamp', which"),
        ({"time": "gps"}, "line 3, column gps: given nothing; expected a time"),
    ],
)
def test_options_that_mean_nothing_are_refused(write, options, message):
    with pytest.raises(DataError, match=message):
        read_table(checked(Path(write(PLAIN)), **options), SPEC)


@pytest.mark.parametrize(("header", "first"), [("x\n", ""), ("x\n", "0;"), ("", "0;")])
def test_a_decimal_comma_is_none_between_columns(tmp_path, header, first):
    numbers = ["5432109,87", "5432109", "-0,25"]
    rows = [f"{first}{number}" for number in numbers]
    path = tmp_path / "a.csv"
    path.write_text(f"{first and header and 'n;'}{header}" + "\n".join(rows), encoding="utf-8")
    renamed = () if header else ("x=2",)
    one = [[1.0]]
    model = {"A": one, "C": one, "Q": one, "R": one, "x0": [0.0], "P0": one}
    table = {"name": "a", "model": model | {"outputs": [{"name": "x"}]}, "filter": {"family": "kf"}}
    read = read_table(checked(path, columns=renamed), fkgen.Spec.from_dict(table))
    assert read.y[:, 0].tolist() == [5432109.87, 5432109.0, -0.25]


@pytest.mark.parametrize("mark", ["-99,9", "-99.9", "-999e-1"])
def test_a_mark_that_is_a_number_is_one_in_any_spelling(tmp_path, mark):
    path = tmp_path / "a.csv"
    path.write_text("t;gps;speed\n0;0,2;0,3\n0,1;-99,90;0,4\n", encoding="utf-8")
    read = read_table(checked(path, missing=(mark,)), SPEC)
    np.testing.assert_array_equal(read.y, [[0.2, 0.3], [NAN, 0.4]])
