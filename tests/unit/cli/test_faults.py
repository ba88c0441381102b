"""The commands fault-effect and detectability: what Python gives, and one line where it cannot."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

import fkgen
from fkgen.cli import main
from fkgen.study.reports.starters import starter


@pytest.fixture
def folder(tmp_path, monkeypatch):
    for family in ("kf", "mkf", "imm"):
        (tmp_path / f"{family}.toml").write_text(starter(family), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def call(folder):
    def invoke(*arguments, status=0):
        before = sorted(folder.iterdir())
        result = CliRunner().invoke(main, [str(a) for a in arguments], prog_name="fkgen")
        assert result.exit_code == status, result.output
        assert "Traceback" not in result.output
        if status == 2:
            assert result.stdout == ""
            assert result.stderr.startswith("error: ")
            assert result.stderr.count("\n") == 1
            assert sorted(folder.iterdir()) == before
        return result

    return invoke


STEP = ("--sensor", "gnss", "--amplitude", "5", "--start", "50", "--stop", "70", "--steps", "300")


def test_fault_effect_prints_states_and_what_the_numbers_are(call):
    text = call("fault-effect", "kf.toml", *STEP).stdout
    assert "position" in text
    assert "m/s" in text
    assert "exact: the same in every run" in text
    assert "The NIS finds it at sample 50 with probability" in text


def test_fault_effect_as_json_is_what_python_gives(call):
    told = json.loads(call("fault-effect", "kf.toml", *STEP, "--json").stdout)
    spec = fkgen.load("kf.toml")
    effect = fkgen.fault_effect(spec, fkgen.profiles.step(300, 50, [5.0, 0.0], stop=70))
    assert told["kind"] == "exact"
    assert told["states"] == ["position", "speed"]
    for name in ("state_deviation", "error_deviation", "noncentrality", "state_sd"):
        assert told[name] == getattr(effect, name).tolist()
    assert told["power"] == effect.power(1e-3).tolist()
    over = [int(k) if k < 300 else None for k in effect.settled(0.01)]
    assert told["settled"] == over


def test_a_record_gives_missing_rows_inputs_and_parameters(call, folder):
    rows = "".join(f"{'' if k == 5 else 1.0},0.5,0.1,{0.1 + 0.01 * k}\n" for k in range(12))
    (folder / "r.csv").write_text(f"gnss,odometer,acceleration,dt\n{rows}", encoding="utf-8")
    found = call("fault-effect", "kf.toml", "--sensor", "gnss", "--record", "r.csv", "--json")
    told = json.loads(found.stdout)
    assert told["innovation_deviation"][5][0] is None
    y = np.ones((12, 2))
    y[5, 0] = np.nan
    effect = fkgen.fault_effect(
        fkgen.load("kf.toml"),
        fkgen.profiles.step(12, 0, [1.0, 0.0]),
        params={"dt": 0.1 + 0.01 * np.arange(12)},
        y=y,
    )
    np.testing.assert_allclose(told["state_deviation"], effect.state_deviation, rtol=1e-12)


def test_a_profile_from_a_file(call, folder):
    (folder / "f.csv").write_text("odometer,acceleration\n0,1\n2,0\n0,0\n", encoding="utf-8")
    told = json.loads(call("fault-effect", "kf.toml", "--profile", "f.csv", "--json").stdout)
    effect = fkgen.fault_effect(
        fkgen.load("kf.toml"), [[0.0, 0.0], [0.0, 2.0], [0.0, 0.0]], [[1.0], [0.0], [0.0]]
    )
    assert told["state_deviation"] == effect.state_deviation.tolist()


@pytest.mark.parametrize("shape", ["pulse", "ramp", "drift"])
def test_shapes(call, shape):
    found = call("fault-effect", "kf.toml", *STEP[:6], "--steps", "60", "--shape", shape, "--json")
    assert np.abs(json.loads(found.stdout)["state_deviation"]).max() > 0.0


def test_input_faults_under_mkf_and_simulated_pairs_say_what_they_are(call):
    text = call("fault-effect", "mkf.toml", "--input", "voltage", "--u", "1", "--mode", "plant")
    assert "the mean over lost commands" in text.stdout
    pairs = call(
        "fault-effect", "imm.toml", "--sensor", "odometer", "--steps", "20", "--runs", "8"
    ).stdout
    assert "the mean of 8 simulated pairs" in pairs
    assert "The NIS changes most at sample" in pairs


def test_an_anomaly_that_the_filter_is_told_makes_no_error_and_says_so(call):
    text = call("fault-effect", "kf.toml", "--input", "acceleration", "--steps", "20").stdout
    assert "The estimate moves as the state does, by up to position" in text
    assert "no test sees it" in text


def test_a_picture_is_drawn_and_not_over_another(call, folder):
    result = call("fault-effect", "kf.toml", *STEP, "--plot", "a.png")
    assert "a.png: written" in result.stderr
    assert (folder / "a.png").read_bytes().startswith(b"\x89PNG")
    refused = call("fault-effect", "kf.toml", *STEP, "--plot", "a.png", status=2).stderr
    assert "--force to replace it" in refused
    call("fault-effect", "kf.toml", *STEP, "--plot", "a.png", "--force")


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["kf.toml"], "the fault: given nothing; expected --sensor NAME (gnss, odometer)"),
        (["kf.toml", "--sensor", "gns"], "--sensor: given 'gns'; expected 'gnss'"),
        (["kf.toml", "--input", "x"], "--input: given 'x'"),
        (["kf.toml", *STEP, "--shape", "puls"], "--shape: given 'puls'; expected 'pulse'"),
        (["kf.toml", *STEP, "--start", "300"], "start: given 300; expected a sample from 0 to 299"),
        (["kf.toml", *STEP, "--mode", "x"], "mode: given 'x'; expected one of: both"),
        (["kf.toml", *STEP, "--u", "1,2"], "--u: given '1,2'; expected a finite number"),
        (["kf.toml", *STEP, "--fraction", "2", "--plot", "n.png"], "fraction: given 2.0"),
        (["kf.toml", *STEP, "--plot", "n.gif"], "the ending '.gif'"),
        (["kf.toml", "--profile", "none.csv"], "none.csv: given a path that cannot be read"),
        (["kf.toml", *STEP, "--profile", "kf.toml"], "error: "),
        (["mkf.toml", "--input", "voltage"], "the gain of mkf depends on u"),
        (["imm.toml", "--sensor", "odometer", "--runs", "1"], "runs: given 1"),
    ],
)
def test_what_cannot_be_asked(call, arguments, text):
    assert text in call("fault-effect", *arguments, status=2).stderr


def test_detectability_prints_one_row_per_sensor(call):
    text = call("detectability", "kf.toml").stdout
    spec = fkgen.load("kf.toml")
    for name in ("gnss", "odometer"):
        found = fkgen.detectability(spec, name, window=50)
        assert f"{found.glr:.4g}" in text
        assert f"{found.windowed_nis:.4g}" in text


def test_detectability_of_a_direction_as_json(call):
    options = ("--direction", "1,-1", "--window", "7", "--power", "0.5", "--json")
    told = json.loads(call("detectability", "kf.toml", *options).stdout)
    found = fkgen.detectability(fkgen.load("kf.toml"), [1.0, -1.0], 1e-3, 0.5, 7)
    assert told["windows"] == [7]
    assert told["biases"][0]["glr"] == [found.glr]
    assert told["biases"][0]["plateau_noncentrality"] == found.plateau


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["imm.toml"], "the family imm"),
        (["kf.toml", "--window", "0"], "--window: given '0'"),
        (["kf.toml", "--window", "a"], "--window: given 'a'"),
        (["kf.toml", "--power", "1"], "power: given 1.0"),
        (["kf.toml", "--direction", "1"], "--direction: given '1'; expected 2 finite numbers"),
    ],
)
def test_what_no_test_detects(call, arguments, text):
    assert text in call("detectability", *arguments, status=2).stderr
