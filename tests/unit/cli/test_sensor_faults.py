"""Sensor faults from the command line: mistakes in a spec, starters, records, pictures."""

from __future__ import annotations

import csv
import json

import pytest
from click.testing import CliRunner

import fkgen
from fkgen.cli import main
from fkgen.study.reports.starters import starter

FAMILIES = ("linear_optimal", "one_step", "imm", "genie")
COLUMNS = {"one_step": ("level_gauge", "pump"), "imm": ("gnss", "odometer", "acceleration")}

MISTAKES = {
    "rate": ("one_step", "gamma_rate = 0.9", "gamma_rate = 1.9", "gamma_rate: given 1.9"),
    "factor": ("imm", "noise_factor = 100.0", "noise_factor = 0", "noise_factor: given 0.0"),
    "rows": ("imm", '["odometer"]', '["odo"]', "rows[0]: given 'odo'"),
    "row": ("genie", '["odometer"]', "[2]", "rows[0]: given 2; expected a row of y, 0..1"),
    "sum": ("imm", "[0.02, 0.98]", "[0.02, 0.97]", "gamma_chain[1]: given probabilities that su"),
    "size": ("imm", "[[0.99, 0.01],", "[[0.99, 0.01], [0, 1],", "delta_chain: given 3 rows"),
    "key": ("one_step", "gamma_rate", "joint", "joint: given joint with problem 1"),
    "problem": ("linear_optimal", "problem = 1", "problem = 5", "problem: given 5; expected 1"),
}


@pytest.fixture
def invoke(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def call(*arguments, status=0):
        result = CliRunner().invoke(main, [str(a) for a in arguments], prog_name="fkgen")
        assert result.exit_code == status, result.output
        assert "Traceback" not in result.output
        return result

    return call


@pytest.fixture
def spec(tmp_path):
    def write(family, *changes):
        text = starter(family)
        for old, new in changes:
            assert old in text
            text = text.replace(old, new, 1)
        path = tmp_path / f"{family}.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


@pytest.mark.parametrize("mistake", MISTAKES.values(), ids=MISTAKES)
@pytest.mark.parametrize("command", ["check", "generate"])
def test_a_mistake_is_one_line_with_its_place(invoke, spec, tmp_path, command, mistake):
    family, old, new, message = mistake
    path = spec(family, (old, new))
    result = invoke(command, path.name, status=2)
    assert result.stdout == ""
    assert result.stderr.startswith(f"error: {family}.toml: faults.sensor.{message}")
    assert result.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("family", "change", "message"),
    [
        ("imm", ("# modes = 4", "modes = 5"), "filter.modes: given 5.0; expected 4, or 3"),
        ("imm", ("[0.0, 0.01]]\n\n# W", "[0.0, 0.0]]\n\n# W"), "model.R: given a singular matrix"),
        ("genie", ("dt = 0.1", "dt = 0.1\ngamma = 1"), "parameters.gamma: given a parameter gamma"),
        ("one_step", ("# covariance", "form = 1 #"), "filter.form: given form for the family one"),
    ],
)
def test_mistakes_outside_the_section(invoke, spec, family, change, message):
    result = invoke("check", spec(family, change).name, status=2)
    assert result.stderr.startswith(f"error: {family}.toml: {message}")
    assert result.stderr.count("\n") == 1


def test_sensor_faults_are_not_for_the_kalman_filter(invoke, tmp_path):
    text = starter("kf") + "\n[faults.sensor]\nnoise_factor = 10.0\n"
    (tmp_path / "s.toml").write_text(text, encoding="utf-8")
    line = invoke("check", "s.toml", status=2).stderr
    assert "faults.sensor: given sensor faults; expected none for the family kf" in line


def test_the_families_are_listed(invoke):
    assert set(FAMILIES) <= set(invoke("families").stdout.split())


@pytest.mark.parametrize("family", FAMILIES)
def test_starters_have_nothing_that_needs_a_warning(invoke, spec, family):
    told = json.loads(invoke("check", spec(family), "--json").stdout)
    assert {finding["severity"] for finding in told["findings"]} <= {"note"}


@pytest.mark.parametrize(("family", "modes"), [("one_step", 4), ("imm", 4), ("imm", 3)])
def test_run_writes_and_draws_the_probabilities(invoke, spec, tmp_path, family, modes):
    names = COLUMNS[family]
    lines = [",".join(names), *[",".join(["0.5"] * len(names))] * 5]
    (tmp_path / "r.csv").write_text("\n".join(lines), encoding="utf-8")
    path = spec(family, ("# modes = 4", f"modes = {modes}")) if family == "imm" else spec(family)
    invoke("run", path, "r.csv", "-o", "o.csv", "--plot", "o.png")
    assert (tmp_path / "o.png").read_bytes().startswith(b"\x89PNG")
    with (tmp_path / "o.csv").open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            found = [float(v) for name, v in row.items() if name.startswith("mode_probability.")]
            assert len(found) == modes
            assert sum(found) == pytest.approx(1.0, rel=1e-15)


# The genie is told gamma and delta by columns of the record


@pytest.fixture
def told(spec, tmp_path):
    def write(rows):
        text = "gnss,odometer,gamma,delta\n" + "".join(f"{row}\n" for row in rows)
        (tmp_path / "r.csv").write_text(text, encoding="utf-8")
        return spec("genie")

    return write


def test_a_genie_reads_gamma_and_delta_from_the_record(invoke, told, tmp_path):
    path = told(["1,2,1,1", "2,0,0,1", "2,9,1,100", "3,0,0,100"])
    stderr = invoke("run", path, "r.csv", "-o", "o.csv").stderr
    assert "parameter gamma" not in stderr
    assert "parameter delta" not in stderr
    with (tmp_path / "o.csv").open(encoding="utf-8") as file:
        found = [float(row["filtered_state.speed"]) for row in csv.DictReader(file)]
    y = [[1, 2], [2, 0], [2, 9], [3, 0]]
    params = {"gamma": [1, 0, 1, 0], "delta": [1, 1, 100, 100]}
    expected = fkgen.build(fkgen.load(path)).run(y, params=params).filtered_state
    assert found == expected[:, 1].tolist()


def test_a_row_without_signal_tells_a_genie_what_a_missing_row_does(told):
    genie = fkgen.build(fkgen.load(told(["0,0,1,1"])))
    gamma = [1.0, 0.0, 0.0, 1.0]
    lost = genie.run([[1, 2], [2, 7], [3, -7], [4, 2]], params={"gamma": gamma})
    nan = float("nan")
    missing = genie.run([[1, 2], [2, nan], [3, nan], [4, 2]])
    assert lost.filtered_state.tolist() == missing.filtered_state.tolist()
    assert lost.filtered_covariance.tolist() == missing.filtered_covariance.tolist()


def test_a_genie_that_is_told_nothing_says_so(invoke, spec, tmp_path):
    (tmp_path / "r.csv").write_text("gnss,odometer\n1,2\n", encoding="utf-8")
    stderr = invoke("run", spec("genie"), "r.csv", "-o", "o.csv").stderr
    for name in ("gamma", "delta"):
        assert f"default of parameter {name}: no such column" in stderr


@pytest.mark.parametrize("values", ["0.5,1", "2,1", "1,10", "0,0", "1,1.0000001"])
def test_other_values_than_the_model_has_refuse_the_sample(invoke, told, tmp_path, values):
    path = told(["1,2,1,1", f"1,2,{values}", "1,2,0,100"])
    result = invoke("run", path, "r.csv", "-o", "o.csv", status=1)
    assert "1 sample refused, in line 3: MY_FILTER_PARAMETER_OUT_OF_RANGE" in result.stderr
    with (tmp_path / "o.csv").open(encoding="utf-8") as file:
        assert [row["status"] for row in csv.DictReader(file)] == ["0", "-4", "0"]


def test_an_indicator_is_never_missing(invoke, told):
    line = invoke("run", told(["1,2,,1"]), "r.csv", status=2).stderr
    assert "line 2, column gamma: given nothing; expected a finite number" in line
