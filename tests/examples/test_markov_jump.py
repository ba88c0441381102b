"""The page of examples/markov_jump: its numbers, its filters, and why the literal rule fails."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scripts import scripts_of

import fkgen

pytestmark = pytest.mark.compiled

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "markov_jump"
RUNS, SEED = 400, 11


@pytest.fixture(scope="module")
def example():
    """The scripts of the example."""
    names = ("losses", "figure", "reproduce")
    with scripts_of("markov_jump", *names) as found:
        yield SimpleNamespace(**dict(zip(names, found, strict=True)))


#: RMS of the nonlinear filters over 1000 runs with other random numbers, and its standard error, by
#: another program: study, filter.
ELSEWHERE = {
    (0, "imm, no losses at all"): (0.8873, 0.0020),
    (0, "imm, loss as a mode"): (1.1510, 0.0058),
    (2, "imm, no losses at all"): (0.4046, 0.0007),
    (2, "imm, loss as a mode"): (0.4442, 0.0006),
}


@pytest.mark.parametrize(("at", "name"), list(ELSEWHERE))
def test_errors_of_imm_are_those_of_another_program(at, name, example):
    study = example.losses.STUDIES[at]
    records = example.losses.simulate(study, RUNS, SEED)
    each = example.reproduce.run(name, example.losses.filters(study)[name], records)
    rms, error = ELSEWHERE[at, name]
    assert abs(each.rms - rms) < 4.0 * np.hypot(each.error, error)


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
