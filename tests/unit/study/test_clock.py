"""Times of a record in every form give the same intervals, to the last digit."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta, timezone
from fractions import Fraction

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest

import fkgen
from fkgen.errors import DataError
from fkgen.study.records.clock import read_times
from fkgen.study.records.reading import checked
from fkgen.study.records.table import read_table

ONE = [[1.0]]
MODEL = {"A": [["dt"]], "C": ONE, "Q": ONE, "R": ONE, "x0": [0.0], "P0": ONE}
MODEL |= {"outputs": [{"name": "y"}]}


def spec(sample_time="dt", **parameters):
    model = MODEL if sample_time is None else MODEL | {"sample_time": sample_time}
    table = {"name": "x", "parameters": {"dt": 0.5} | parameters, "filter": {"family": "kf"}}
    return fkgen.Spec.from_dict(table | {"model": model})


NANO = np.array([0, 1, 20_000_001, 250_000_000, 7_200_000_000_123])  # ns since the first
START = datetime(2024, 5, 1, 23, 59, 59, tzinfo=UTC)
EPOCH = int(START.timestamp())


def iso(nano, zone=UTC, mark=".", ending=""):
    moment = (START + timedelta(seconds=int(nano) // 10**9)).astimezone(zone).replace(tzinfo=None)
    return f"{moment.isoformat()}{mark}{int(nano) % 10**9:09d}{ending}"


def decimal(nano, power):
    whole, rest = divmod(int(nano), 10**power)
    return f"{whole}.{rest:0{power}d}"


FORMS = {
    "seconds": ("t", [decimal(n, 9) for n in NANO]),
    "milliseconds": ("Time [ms]", [decimal(n, 6) for n in NANO]),
    "microseconds": ("TIMESTAMP (us)", [decimal(n, 3) for n in NANO]),
    "nanoseconds": ("t_ns", list(map(str, NANO))),
    "epoch s": ("time", [decimal(EPOCH * 10**9 + n, 9) for n in NANO]),
    "epoch s, signed": ("time", [f"+{decimal(EPOCH * 10**9 + n, 9)}" for n in NANO]),
    "epoch ms": ("time", [decimal(EPOCH * 10**9 + n, 6) for n in NANO]),
    "epoch us": ("time", [decimal(EPOCH * 10**9 + n, 3) for n in NANO]),
    "epoch ns": ("timestamp", [str(EPOCH * 10**9 + n) for n in NANO]),
    "epoch ms with its unit": ("t [ms]", [decimal(EPOCH * 10**9 + n, 6) for n in NANO]),
    "ISO": ("t", [iso(n) for n in NANO]),
    "ISO with a zone": ("t", [iso(n, ending="Z") for n in NANO]),
    "ISO with an offset": (
        "t",
        [iso(n, timezone(timedelta(hours=5.5)), ending="+05:30") for n in NANO],
    ),
    "ISO with a blank": ("t", [iso(n).replace("T", " ") for n in NANO]),
    "ISO with a comma": ("t", [f'"{iso(n, mark=",")}"' for n in NANO]),
}
INTERVALS = [float(Fraction(int(n), 10**9)) for n in np.diff(NANO)]


@pytest.fixture
def write(tmp_path):
    def writer(heading, times, more=""):
        path = tmp_path / "r.csv"
        rows = (f"{time},{k}{more}" for k, time in enumerate(times))
        path.write_text("\n".join([f"{heading},y{',dt' if more else ''}", *rows]), encoding="utf-8")
        return path

    return writer


@pytest.mark.parametrize(("heading", "times"), FORMS.values(), ids=FORMS)
def test_intervals_are_exact(write, heading, times):
    table = read_table(write(heading, times), spec())
    assert table.params["dt"].tolist() == [*INTERVALS, INTERVALS[-1]]
    assert list(table.time_text) == [time.strip('"') for time in times]
    np.testing.assert_allclose(table.time - table.time[0], NANO * 1e-9, atol=5e-7)


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        (pa.timestamp("ns"), EPOCH * 10**9 + NANO),
        (pa.timestamp("ns", "Europe/Berlin"), EPOCH * 10**9 + NANO),
        (pa.int64(), EPOCH * 10**9 + NANO),
        (pa.duration("ns"), NANO),
        (pa.time64("ns"), NANO),
    ],
)
def test_times_with_a_type_are_exact(tmp_path, kind, values):
    path = tmp_path / "r.parquet"
    columns = {"time": pa.array(values, pa.int64()).cast(kind), "y": pa.array(range(5))}
    pa.parquet.write_table(pa.table(columns), path)
    assert read_table(path, spec()).params["dt"].tolist() == [*INTERVALS, INTERVALS[-1]]


@pytest.mark.parametrize(("unit", "scale"), [("min", 60.0), ("h", 3600.0), ("s", 1.0)])
def test_units_scale_the_times(write, unit, scale):
    table = read_table(write(f"t [{unit}]", [1, 2, 4]), spec())
    assert table.params["dt"].tolist() == [scale, 2 * scale, 2 * scale]
    assert table.time_label == "time (s)"


def test_times_of_the_day_and_forms_of_few_digits(write):
    expected = [0.5, 59.5, 59.5]
    for times in (
        ["12:00:00", "12:00:00.5", "12:01:00"],
        ["20240501T120000Z", "2024-05-01T12:00:00.5Z", "20240501T120100Z"],
        ["2024-05-01T12:00Z", "2024-05-01T12:00:00.5Z", "2024-05-01T14:01+02:00"],
        ["1e0", "1.5", "0.61e2"],
    ):
        assert read_table(write("t", times), spec()).params["dt"].tolist() == expected


def test_the_last_sample_repeats_and_one_alone_takes_the_default(write):
    assert read_table(write("t", [1, 3]), spec()).params["dt"].tolist() == [2.0, 2.0]
    table = read_table(write("t", [1]), spec())
    assert table.params == {}
    assert fkgen.build(spec()).run(table.y, params=table.params).predicted_state[0, 0] == 0.0


def test_a_column_that_contradicts_the_times_is_told_once_with_line_and_both_numbers(write):
    table = read_table(write("t", [0, 1, 3, 4], ",1"), spec())
    (warning,) = table.warnings
    assert "line 3, column dt: 1 contradicts the times, which say 2 to the next" in warning
    assert table.params["dt"].tolist() == [1.0, 2.0, 1.0, 1.0]


@pytest.mark.parametrize(
    ("times", "stated"),
    [
        ([0, 1, 2], ",1"),
        (["0.000", "0.020", "0.041"], ",0.0204"),  # rounded to the last digit of the times
        (["0.1", "0.2", "0.30000000000000004"], ",0.1"),
    ],
)
def test_a_column_that_agrees_is_taken_as_it_stands(write, times, stated):
    table = read_table(write("t", times, stated), spec())
    assert table.warnings == ()
    assert set(table.params["dt"]) == {float(stated[1:])}


def test_a_column_without_times_may_miss_its_last_value(tmp_path):
    path = tmp_path / "r.csv"
    path.write_text("y,dt\n1,0.1\n2,0.3\n3,\n", encoding="utf-8")
    assert read_table(path, spec()).params["dt"].tolist() == [0.1, 0.3, 0.3]


def test_which_parameter_is_the_clock(write):
    path = write("t", [0, 1, 3])
    assert "dt" in read_table(path, spec(None)).params  # by its name
    assert read_table(path, spec(0.1)).params == {}
    table = read_table(path, spec("step", step=1.0))
    assert table.params["step"].tolist() == [1.0, 2.0, 2.0]
    assert any("default of parameter dt" in note for note in table.notes)


def test_without_times_a_note_names_the_parameter(write):
    table = read_table(write("clock", [0, 1, 3]), spec())
    assert any("parameter dt: no such column and no time column" in note for note in table.notes)
    assert read_table(checked(write("t", [3, 1]), time=""), spec()).params == {}
    stamped = read_table(checked(write("clock", [0, 1, 3]), time="clock"), spec())
    assert stamped.params["dt"].tolist() == [1.0, 2.0, 2.0]


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([0, 1, 1], "line 4, column t: given 1 after 1; expected times that increase"),
        ([0, 2, 1], "line 4, column t: given 1 after 2"),
        ([0, "", 1], "line 3, column t: given nothing; expected a time: seconds, an epoch"),
        ([0, "nan", 1], "line 3, column t: given nothing"),
        ([0, "inf", 1], "line 3, column t: given inf"),
        (["1_0", "2_0"], "line 2, column t: given '1_0'; expected a time"),
        (['"1,000"', '"2,000"'], "line 2, column t: given '1,000'; expected a time"),
        ([0, "noon", 1], "line 3, column t: given 'noon'; expected a time"),
        (["2024-05-01", "01.05.2024"], "line 3, column t: given '01.05.2024'"),
        (["2024-05-01T12:00:00Z", "2024-05-01T12:00:00Z"], "2024-05-01T12:00:00Z after 2024"),
    ],
)
def test_times_that_are_none_name_their_line(write, times, message):
    with pytest.raises(DataError, match=message):
        read_table(write("t", times), spec())


@pytest.mark.parametrize("times", [["0,00", "0,25", "1"], ["0,000", "0,250", "1,000"]])
def test_times_may_have_a_decimal_comma_of_their_own(write, times):
    quoted = [f'"{time}"' for time in times]
    table = read_table(write("t", quoted, more=",0.25"), spec())
    assert table.params["dt"][0] == 0.25


def test_times_that_are_not_those_of_a_fixed_sample_time_are_told_once(write):
    fixed = spec(0.5)
    assert not read_table(write("t", ["0", "0.6", "0.9", "1.4"]), fixed).warnings
    path = write("t", ["0", "0.5", "1.0", "1.9", "9"])
    (warning,) = read_table(path, fixed).warnings
    assert warning.startswith(f"{path}, line 4, column t: 0.9 s to the next sample; model.sample_")
    assert "is 0.5 s" in warning
    assert not read_table(path, spec()).warnings


def test_a_piece_and_the_next_of_another_form_are_apart_by_what_they_say():
    first, second = (read_times(pa.array([text]), None) for text in ("12.5", "13.12345678912"))
    assert first.interval_to(second) == pytest.approx(0.62345678912, abs=1e-12)
