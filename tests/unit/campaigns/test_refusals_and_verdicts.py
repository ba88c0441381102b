"""What campaigns refuse, what they make of a filter that is right, and of one that is not."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest
from click.testing import CliRunner

import fkgen
from fkgen.cli import main
from fkgen.runtime import cache
from fkgen.study.campaigns import engine

CART = {
    "name": "cart",
    "model": {
        "A": [[1.0, 0.1], [0.0, 0.95]],
        "C": [[1.0, 0.0]],
        "Q": [[0.001, 0.0], [0.0, 0.01]],
        "R": [[0.04]],
        "x0": [0.0, 1.0],
        "P0": [[1.0, 0.0], [0.0, 0.5]],
    },
    "filter": {"family": "kf"},
}
TOML = """
name = "cart"
[model]
A = [[1.0, 0.1], [0.0, 0.95]]
C = [[1.0, 0.0]]
Q = [[0.001, 0.0], [0.0, 0.01]]
R = [[{r}]]
x0 = [0.0, 1.0]
P0 = [[1.0, 0.0], [0.0, 0.5]]
[filter]
family = "kf"
"""


def cart(**changes):
    return fkgen.Spec.from_dict(CART | {"model": CART["model"] | changes})


def scaled(factor, letters="QR"):
    return cart(**{x: (factor * np.array(CART["model"][x])).tolist() for x in letters})


@pytest.fixture(scope="module")
def spec():
    return cart()


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "cart.toml").write_text(TOML.format(r=0.04), encoding="utf-8")
    (tmp_path / "loud.toml").write_text(TOML.format(r=0.08), encoding="utf-8")
    return tmp_path


def call(folder, *arguments):
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        return CliRunner().invoke(main, ["montecarlo", *map(str, arguments)])


WRONG = {
    "workers 0": ({"workers": 0}, "workers: given 0; expected a whole number from 1"),
    "both": (
        {"workers": 2, "scheduler": "tcp://x:1"},
        "workers: given a number beside a scheduler",
    ),
    "trials": ({"trials": 0}, "trials: given 0"),
    "steps": ({"steps": -1}, "steps: given -1"),
    "seed": ({"seed": -1}, "seed: given -1"),
    "precision": ({"precision": 0.0}, "precision: given 0.0; expected a positive number"),
    "no number": ({"precision": "much"}, "precision: given 'much'"),
    "truth": ({"truth": "x.toml"}, "truth: given a value of type str; expected a Spec"),
    "checkpoint": ({"checkpoint": 7}, "checkpoint: given a value of type int"),
    "u": ({"u": 1.0}, "u: given inputs; expected none"),
    "params": ({"params": {"tau": 1.0}}, "params.tau: given an unknown name"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_does_not_fit_is_refused_in_one_line(spec, case):
    changes, message = WRONG[case]
    with pytest.raises(fkgen.DataError) as refused:
        fkgen.montecarlo(spec, **({"trials": 10, "steps": 5} | changes))
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_truth_has_the_sizes_of_the_filter(spec):
    other = cart(C=[[1.0, 0.0], [0.0, 1.0]], R=[[1.0, 0.0], [0.0, 1.0]])
    with pytest.raises(fkgen.DataError, match="truth: given 2 states, 0 inputs, 2 measurements"):
        fkgen.montecarlo(spec, 10, 5, truth=other)


@pytest.mark.parametrize(("growth", "steps"), [(1.5, 3000), (1.5, 900)])
def test_a_plant_that_overflows_is_one_line(spec, growth, steps):
    """Its states, or the squares of errors alone."""
    wild = cart(A=[[growth, 0.1], [0.0, 0.95]])
    with pytest.raises(fkgen.DataError, match=r"^steps: given .*not stable"):
        fkgen.montecarlo(spec, 10, steps, truth=wild)


def test_checkpoints_of_something_else_are_refused_and_left_alone(spec, tmp_path, monkeypatch):
    file = tmp_path / "kept.json"
    fkgen.montecarlo(spec, 400, 300, 1, checkpoint=file)
    before = file.read_bytes()
    wrong = {
        "seed 1; expected seed 2": {"seed": 2},
        "steps 300; expected steps 301": {"steps": 301},
        "spec another one": {"spec": scaled(2.0)},
        "truth another one": {"truth": scaled(2.0)},
    }
    for message, changes in wrong.items():
        given = {"spec": spec, "trials": 400, "steps": 300, "seed": 1} | changes
        with pytest.raises(fkgen.DataError, match=message):
            fkgen.montecarlo(**given, checkpoint=file)
    with monkeypatch.context() as patch:
        patch.setattr(cache, "identity", lambda: "99.0")
        with pytest.raises(
            fkgen.DataError, match=r"a checkpoint with version .*expected version 99"
        ):
            fkgen.montecarlo(spec, 400, 300, 1, checkpoint=file)
    assert file.read_bytes() == before
    file.write_text('{"kind": "checkpoint of fkgen montecarlo", "version": "0.0", "more": 1}')
    with pytest.raises(fkgen.DataError, match=r"a checkpoint with version 0\.0; expected version"):
        fkgen.montecarlo(spec, 400, 300, 1, checkpoint=file)
    for text in ("", "{}", "[1]", "no checkpoint", '{"kind": 3}', "\x00\xff"):
        file.write_text(text, encoding="latin-1")
        with pytest.raises(fkgen.DataError, match="no checkpoint"):
            fkgen.montecarlo(spec, 400, 300, 1, checkpoint=file)
        assert file.read_text(encoding="latin-1") == text
    with pytest.raises(fkgen.OutputError, match="a folder that does not exist"):
        fkgen.montecarlo(spec, 400, 300, 1, checkpoint=tmp_path / "no" / "kept.json")


def test_a_small_campaign_leaves_a_checkpoint_too(spec, tmp_path):
    """Fewer trials than one block: nothing to keep yet but what it is about."""
    file = tmp_path / "kept.json"
    fkgen.montecarlo(spec, 20, 30, 1, checkpoint=file)
    before = file.read_bytes()
    with pytest.raises(fkgen.DataError, match="seed 1; expected seed 2"):
        fkgen.montecarlo(spec, 20, 30, 2, checkpoint=file)
    with pytest.raises(fkgen.DataError, match="steps 30; expected steps 31"):
        fkgen.montecarlo(spec, 20, 31, 1, checkpoint=file)
    assert file.read_bytes() == before
    more = fkgen.montecarlo(spec, 50, 30, 1, checkpoint=file)
    assert more.to_json() == fkgen.montecarlo(spec, 50, 30, 1).to_json()


def test_a_scheduler_that_is_not_there(spec, monkeypatch):
    monkeypatch.setattr(engine, "PATIENCE", 0.2)
    with pytest.raises(fkgen.DataError, match=r"tcp://127\.0\.0\.1:9', where none answers"):
        fkgen.montecarlo(spec, 10, 5, scheduler="tcp://127.0.0.1:9")
    with pytest.raises(fkgen.DataError, match="expected the address of a running Dask scheduler"):
        fkgen.montecarlo(spec, 10, 5, scheduler="nonsense://")
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(fkgen.DataError, match=r"pip install 'fkgen\[cluster\]'"):
        fkgen.montecarlo(spec, 10, 5, scheduler="tcp://127.0.0.1:9")


def found_wrong(spec, truth, seeds):
    every = (fkgen.montecarlo(spec, 1000, 200, seed, truth=truth) for seed in seeds)
    return [each.verdicts for each in every if not each.consistent]


def test_a_right_filter_is_accepted(spec):
    assert len(found_wrong(spec, spec, range(40))) <= 1


@pytest.mark.parametrize(("factor", "verdict"), [(1.05, "conservative"), (1 / 1.05, "optimistic")])
def test_a_covariance_off_by_5_percent_is_found(spec, factor, verdict):
    for letters in ("Q", "R", "QR"):
        wrong = found_wrong(scaled(factor, letters), spec, range(15))
        assert len(wrong) >= 13, letters
        assert all(verdict in each.values() for each in wrong)


@pytest.mark.exhaustive
def test_acceptance_and_power_over_many_seeds(spec):
    assert len(found_wrong(spec, spec, range(100, 350))) <= 3  # of 250
    for letters in ("Q", "R", "QR"):
        assert len(found_wrong(scaled(1.05, letters), spec, range(100))) >= 95, letters


def test_a_bias_is_found(spec):
    model = CART["model"] | {"d": [0.05]}
    off = fkgen.Spec.from_dict(CART | {"model": model})
    assert fkgen.montecarlo(spec, 1000, 200, truth=off).verdicts["bias"] == "optimistic"


def test_few_trials_are_no_evidence(spec):
    assert fkgen.montecarlo(spec, 1, 5).verdicts == {}
    assert np.isnan(fkgen.montecarlo(spec, 1, 5).nees.standard_error)
    assert fkgen.montecarlo(spec, 3, 5).consistent


def test_the_command(folder):
    right = call(folder, "cart.toml", "--trials", 300, "--json")
    assert right.exit_code == 0
    facts = json.loads(right.stdout)
    names = ("rmse", "bias", "nees", "nis", "coverage", "calibration", "delay", "false_alarm")
    assert all({"value", "standard_error"} == set(facts[name]) for name in names)
    assert set(facts["verdicts"].values()) == {"consistent"}
    wrong = call(folder, "cart.toml", "--trials", 300, "--truth", "loud.toml")
    assert wrong.exit_code == 1
    assert "optimistic" in wrong.stdout
    drawn = call(folder, "cart.toml", "--trials", 300, "--plot", "a.png", "--checkpoint", "a.json")
    assert drawn.exit_code == 0
    assert (folder / "a.png").read_bytes()[:4] == b"\x89PNG"
    for arguments in (
        ("--workers", 0),
        ("--truth", "missing.toml"),
        ("--precision", "-1"),
        ("--u", "1"),
        ("--plot", "a.png"),
        ("--checkpoint", "cart.toml"),
        ("--checkpoint", "b.json", "--sweep", "model.R=0.01:0.1:3"),
        ("--sweep", "model.R=0.01:0.1:3", "--sweep", "model.R=0.01:0.1:3"),
        ("--sweep", "model.R"),
    ):
        refused = call(folder, "cart.toml", "--trials", 10, *arguments)
        assert refused.exit_code == 2, arguments
        assert refused.stderr.count("\n") == 1
        assert refused.stderr.startswith("error: ")
