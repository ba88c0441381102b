"""The tables of examples/markov_jump from fewer runs, beside those of another program."""

from __future__ import annotations

import re
import sys
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import fkgen

pytestmark = pytest.mark.compiled

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "markov_jump"
RUNS, SEED = 400, 11


@pytest.fixture(scope="module")
def example():
    """The scripts of the example."""
    names = ("losses", "figure", "reproduce")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLE))
        found = {name: import_module(name) for name in names}
        for name in names:
            sys.modules.pop(name, None)
    return SimpleNamespace(**found)


#: RMS and its standard error over 1000 runs with other random numbers, by a program of its own;
#: false alarms and detections.
PUBLISHED = {
    (0, "no losses at all"): (0.9119, 0.0019),
    (0, "told the losses"): (1.1287, 0.0043),
    (0, "no detection"): (14.44, 0.19),
    (0, "linear, rate only"): (9.168, 0.107),
    (0, "llr"): (1.330, 0.016, 0.0070, 0.895),
    (0, "nis, alpha .01"): (32.5, 0.7, 0.183, 0.709),
    (0, "energy (the paper's rule)"): (45.7, 0.6, 0.730, 0.450),
    (0, "imm, no losses at all"): (0.8873, 0.0020),
    (0, "imm, loss as a mode"): (1.1510, 0.0058),
    (2, "no losses at all"): (0.4115, 0.0007),
    (2, "told the losses"): (0.4528, 0.0008),
    (2, "no detection"): (2.724, 0.006),
    (2, "linear, rate only"): (0.9464, 0.0022),
    (2, "llr"): (0.4528, 0.0008, 0.0000, 1.0),
    (2, "nis, alpha .01"): (0.5037, 0.0014, 0.0177, 1.0),
    (2, "nis, alpha .001"): (0.4661, 0.0010, 0.0034, 1.0),
    (2, "energy (the paper's rule)"): (0.8519, 0.0026, 0.370, 1.0),
    (2, "energy, mean of 5"): (0.9473, 0.0030, 0.706, 1.0),
    (2, "imm, no losses at all"): (0.4046, 0.0007),
    (2, "imm, loss as a mode"): (0.4442, 0.0006),
}


@pytest.fixture(scope="module")
def results(example):
    """Every filter over the target with 15 % of its samples lost, and over the scalar plant."""
    found = {}
    for at in (0, 2):
        study = example.losses.STUDIES[at]
        records = example.losses.simulate(study, RUNS, SEED)
        specs = example.losses.filters(study)
        names = [name for name in specs if name != example.losses.IMM_PAIRS]
        found[at] = (
            records,
            {name: example.reproduce.run(name, specs[name], records) for name in names},
        )
    return found


@pytest.mark.parametrize(("at", "name"), list(PUBLISHED))
def test_errors_are_those_of_another_program(at, name, example, results):
    records, found = results[at]
    each, (rms, error, *shares) = found[name], PUBLISHED[at, name]
    assert abs(each.rms - rms) < 4.0 * np.hypot(each.error, error)
    if not shares:
        assert not each.declared.size
        return
    declared = each.declared
    # Shares of runs, which differ from each other: the standard error over runs, of both programs.
    for which, share in zip((~records.lost, records.lost), shares, strict=True):
        count = which.sum(axis=1)
        own = (declared & which).sum(axis=1) / np.maximum(1, count)
        spread = own.std(ddof=1) / np.sqrt(RUNS) * np.hypot(1.0, np.sqrt(RUNS / 1000))
        # One unit of the last digit given.
        assert abs((declared & which).sum() / count.sum() - share) < 4.0 * spread + 1e-3


def test_the_likelihood_ratio_comes_close_to_the_filter_that_is_told(example, results):
    records, found = results[0]
    llr = found[example.losses.LLR]
    false, caught = example.reproduce.rates(llr, records.lost)
    assert llr.rms < 1.25 * found[example.losses.KNOWN].rms
    assert false < 0.012
    assert caught > 0.87
    records, found = results[2]
    told = found[example.losses.KNOWN].rms
    assert found[example.losses.LLR].rms == pytest.approx(told, rel=0.01)


@pytest.mark.parametrize("at", [0, 2])
def test_the_filters_are_ordered_as_the_page_says(at, example, results):
    assert example.reproduce.violations(example.losses.STUDIES[at], results[at][1]) == []


def test_linear_filters_state_their_errors(example, results):
    """Neither of them decides anything: e^2 - P has the mean zero over independent runs."""
    for at in (0, 2):
        for name in (example.losses.TRUTH, example.losses.KNOWN, example.losses.NAHI):
            each = results[at][1][name]
            z = (each.squares.mean() - each.stated) / (each.squares.std(ddof=1) / np.sqrt(RUNS))
            assert abs(z) < 4.0, (at, name, z)


def test_the_literal_rule_rejects_before_anything_is_lost(example):
    study = example.losses.STUDIES[1]
    records = example.losses.simulate(study, 100, SEED)
    specs = example.losses.filters(study)
    names = (example.losses.LLR, example.losses.ENERGY, example.losses.CONSTANT)
    before = {
        name: example.reproduce.run(name, specs[name], records).declared[:, :200].mean()
        for name in names
    }
    assert before[example.losses.LLR] < 0.01
    assert before[example.losses.ENERGY] > 0.4
    assert before[example.losses.CONSTANT] > 0.8


def test_every_number_of_the_page_stands_in_the_tables(example):
    page = (EXAMPLE / "README.md").read_text(encoding="utf-8")
    tables = (EXAMPLE / "tables.md").read_text(encoding="utf-8")
    assert example.reproduce.unsupported(page, tables) == []
    assert example.reproduce.unsupported("RMS 1.2345", tables) == ["1.2345"]


def test_the_costs_of_the_page_are_those_of_the_code(example):
    page = (EXAMPLE / "README.md").read_text(encoding="utf-8")
    specs = example.losses.filters(example.losses.STUDIES[0])
    for name in (example.losses.IMM, example.losses.LLR):
        flops = fkgen.generate(fkgen.validate(specs[name])).program.flops
        assert re.search(rf"\| {flops} \|$", page, re.MULTILINE)


def test_the_spec_file_is_the_filter_of_the_tables(example):
    spec = fkgen.load(EXAMPLE / "spec.toml")
    other = example.losses.filters(example.losses.STUDIES[0])[example.losses.LLR]
    assert (spec.model, spec.faults, spec.filter) == (other.model, other.faults, other.filter)
