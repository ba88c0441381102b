"""A spec from a record loads, runs on it, and guesses the noises that it was drawn with."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner

import fkgen
from fkgen.cli import main
from fkgen.errors import DataError
from fkgen.study.records.reading import checked
from fkgen.study.records.table import read_table
from fkgen.study.reports.first_spec import first_spec

Q, R = np.array([0.5, 4.0]), np.array([2.0, 0.3])


def walk(samples=20_000, missing=0.0, seed=2):
    rng = np.random.default_rng(seed)
    x = np.cumsum(rng.normal(size=(samples, 2)) * np.sqrt(Q), axis=0)
    y = x + rng.normal(size=x.shape) * np.sqrt(R)
    y[1:, 0][rng.random(samples - 1) < missing] = np.nan
    return y


def write(path, columns):
    pd.DataFrame(columns).to_csv(path, index=False, sep=";", decimal=",")
    return checked(path)


def spec_of(path, text):
    toml = path.with_suffix(".toml")
    toml.write_text(text, encoding="utf-8")
    return fkgen.load(toml)


@pytest.mark.parametrize("even", [True, False])
def test_noises_and_the_clock_are_those_of_the_record(tmp_path, even):
    y = walk()
    steps = np.full(len(y), 20) if even else np.random.default_rng(0).integers(10, 31, len(y))
    t = np.cumsum(steps)
    path = tmp_path / "walk 2.csv"
    columns = {"Time [ms]": t, "GPS Höhe [m]": y[:, 0], "speed (m/s)": y[:, 1], "flag": "ok"}
    text = first_spec(write(path, columns | {"index": range(len(y))}))
    spec = spec_of(path, text)
    assert spec.name == "walk_2"
    assert [(s.name, s.unit) for s in spec.model.outputs] == [("GPS_Hohe", "m"), ("speed", "m/s")]
    assert dict(spec.record.columns) == {"GPS_Hohe": "GPS Höhe [m]"}
    assert spec.model.sample_time == (0.02 if even else "dt")
    assert spec.period == pytest.approx(0.02, rel=0.06)
    # moments of 20,000 samples: standard errors below 5 %
    np.testing.assert_allclose(np.diag(spec.model.R.values(spec.defaults)), R, rtol=0.2)
    np.testing.assert_allclose(np.diag(spec.model.Q.values(spec.defaults)), Q, rtol=0.2)
    assert "Cov(d[k], d[k+1])" in text


def test_rows_that_come_now_and_then_count_per_sample(tmp_path):
    y = walk(missing=0.75)
    path = tmp_path / "a.csv"
    spec = spec_of(path, first_spec(write(path, {"x": y[:, 0], "v": y[:, 1]})))
    assert spec.model.sample_time is None
    assert spec.model.Q.values()[0, 0] == pytest.approx(Q[0], rel=0.3)
    assert spec.model.R.values()[0, 0] == pytest.approx(R[0], rel=0.3)


def test_a_spec_from_a_record_runs_on_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    y = walk(300)
    columns = {"t": np.arange(300) / 10, "voltage": 1.0, "1 double": y[:, 0], "class": y[:, 1]}
    write(tmp_path / "for.csv", columns | {"y": 5})
    result = CliRunner().invoke(main, ["new", "--from", "for.csv", "-o", "s.toml"])
    assert result.output == "s.toml: try: fkgen run s.toml for.csv\n"
    spec = fkgen.load("s.toml")
    assert [each.name for each in spec.model.inputs] == ["voltage"]
    assert spec.model.ny == 3
    result = CliRunner().invoke(main, ["run", "s.toml", "for.csv"])
    assert result.exit_code == 0, result.output
    assert "300 samples, 900 of 900 rows used" in result.stderr
    result = CliRunner().invoke(main, ["new", "--from", "for.csv", "--inputs", "y"])
    assert 'inputs = [{name = "y"}]' in result.stdout
    assert CliRunner().invoke(main, ["new", "kf", "--from", "for.csv"]).exit_code == 0
    result = CliRunner().invoke(main, ["new", "imm", "--from", "for.csv"])
    assert result.exit_code == 2
    assert "error: FAMILY: given 'imm' beside --from; expected none" in result.stderr


def test_headings_of_any_kind_give_names_that_a_spec_takes(tmp_path):
    headings = ["int", "sin", "I", "a b", "A_B", "__x__", "°", "%", "x" * 99, 'q"\\', "-1a", "dt "]
    path = tmp_path / "double.npz"
    np.savez(path, **{h: np.arange(5.0) ** 2 for h in headings})
    spec = spec_of(path, first_spec(checked(path)))
    assert spec.model.ny == len(headings)
    assert json.dumps(spec.to_dict())


@pytest.mark.parametrize(
    ("columns", "inputs", "message"),
    [
        ({"t": [1, 2], "name": ["a", "b"]}, "", "line 1: given none; expected a column of numbers"),
        ({"t": [1, 2], "y": [1, 2]}, "x", "--inputs: given 'x'; expected one of: y"),
        ({"t": ["a", "b"], "y": [1, 2]}, "", "line 2, column t: given 'a'; expected a time"),
    ],
)
def test_records_without_signals_are_refused(tmp_path, columns, inputs, message):
    with pytest.raises(DataError, match=message):
        first_spec(write(tmp_path / "a.csv", columns), inputs)


def clocks(samples=60):
    """Times as loggers call them, in columns without a usual name, and the sample time."""
    stamps = pd.date_range("2024-05-01 12:00:00", periods=samples, freq="10s")
    german = [str(each) for each in stamps]
    seconds = np.arange(samples) * 0.25
    rough = np.cumsum(np.random.default_rng(0).uniform(0.1, 0.3, samples)).round(4)
    return {
        "Zeitstempel": (german, 10.0),
        "tout": (seconds, 0.25),
        "elapsed": (seconds + 3.0, 0.25),
        "unix time": (1_714_564_800_000 + (1000 * seconds).astype(int), 0.25),
        "Start time [ms]": (1000 * rough, "dt"),
    }


@pytest.mark.parametrize("heading", clocks())
def test_a_clock_of_another_name_is_found_and_named_in_the_spec(tmp_path, heading):
    times, expected = clocks()[heading]
    y = walk(60)
    path = tmp_path / "a.csv"
    spec = spec_of(path, first_spec(write(path, {heading: times, "x": y[:, 0]})))
    assert spec.model.ny == 1
    assert spec.model.sample_time == expected
    assert spec.record.time == heading


def test_what_rises_is_no_clock_unless_it_is_called_so_or_comes_first(tmp_path):
    y = walk(60)
    path = tmp_path / "a.csv"
    columns = {"x": y[:, 0], "ramp": np.arange(60.0), "uneven": np.arange(60.0) ** 1.5}
    text = first_spec(write(path, columns | {"state": "on", "id": range(60)}))
    spec = spec_of(path, text)
    assert [each.name for each in spec.model.outputs] == ["x", "ramp", "uneven"]
    assert spec.model.sample_time is None
    assert "as counters: 'state', 'id'\n" in text


def test_the_index_of_a_frame_is_its_clock(tmp_path):
    y = walk(60)
    path = tmp_path / "a.parquet"
    index = pd.date_range("2024-05-01", periods=60, freq="100ms", tz="Europe/Berlin")
    pd.DataFrame({"x": y[:, 0]}, index=index).to_parquet(path)
    spec = spec_of(path, first_spec(checked(path)))
    assert spec.model.sample_time == pytest.approx(0.1)
    table = read_table(path, spec)
    np.testing.assert_allclose(np.diff(table.time), 0.1, atol=1e-6)
    assert not table.notes


def test_the_start_has_all_the_digits_of_the_first_values(tmp_path):
    path = tmp_path / "a.csv"
    spec = spec_of(path, first_spec(write(path, {"x": 5_432_109.875 + walk(60)[:, 0] * 1e-3})))
    assert np.ravel(spec.model.x0.values())[0] == pd.read_csv(path, sep=";", decimal=",")["x"][0]


def test_a_slow_level_in_strong_noise_is_followed(tmp_path):
    rng = np.random.default_rng(11)
    for _ in range(5):
        x = np.cumsum(0.05 * rng.normal(size=1500))
        path = tmp_path / "a.csv"
        spec = spec_of(path, first_spec(write(path, {"x": x + 0.5 * rng.normal(size=1500)})))
        assert 0.2 < spec.model.Q.values()[0, 0] / 0.05**2 < 8.0
        assert spec.model.R.values()[0, 0] == pytest.approx(0.25, rel=0.25)


def test_numbers_that_mark_what_is_missing_are_asked_about(tmp_path):
    y = walk(60)[:, 0].round(3)
    y[20:30] = -9999.0
    path = tmp_path / "a.csv"
    write(path, {"x": y, "t": np.arange(60) / 10})
    message = "line 22, column x: given -9999; expected --missing -9999"
    with pytest.raises(DataError, match=message):
        first_spec(checked(path))
    spec = spec_of(path, first_spec(checked(path, missing=("-9999",))))
    assert spec.model.R.values()[0, 0] < 10.0
