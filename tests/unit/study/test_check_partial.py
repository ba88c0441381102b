"""What check says of the partial compression filter."""

from __future__ import annotations

import pytest
from partial_plants import PAPER, cpcf
from plants import spec

import fkgen


def loss(filtering):
    report = fkgen.check(filtering)
    found = [each for each in report.findings if each.code == "compression_loss"]
    return report.values["compression_loss"], found


def test_a_loss_is_told_with_its_remedy():
    value, findings = loss(cpcf(PAPER, window=150, maintenance="paper"))
    assert value > 0.1
    assert findings[0].severity == "warning"
    assert findings[0].value == value
    assert "the variance of x0 after the first window" in findings[0].message
    assert findings[0].remedy == 'maintenance = "optimal", family = "dfcf", or a shorter window'


def test_a_small_loss_is_a_value_only():
    value, findings = loss(cpcf(PAPER, window=150))
    assert 0.0 < value < 0.1
    assert findings == []


def test_a_constant_that_is_measured_often_loses_nothing():
    """Z is then the mean of the measurements, and V is uncorrelated with e."""
    one = [[1.0]]
    constant = {"A": one, "C": one, "Q": [[0.0]], "R": one, "x0": [0.0], "P0": [[4.0]]}
    assert loss(cpcf(constant, host=(), window=20))[0] == pytest.approx(0.0, abs=1e-12)


def test_others_have_no_such_figure():
    for filtering in (spec(PAPER), cpcf(PAPER, family="dfcf"), cpcf(PAPER, window=100_000)):
        assert "compression_loss" not in fkgen.check(filtering).values
