"""Mistakes in the linear filter and in the genie, by name: refused, and by which comparison."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from mutants import proved, read_instead, recursion, refusals, rewritten, started
from plants import random_model
from sensor_specs import centred, product, sensed

from fkgen.estimators.lmmse import lemma2
from fkgen.estimators.lmmse.lemma2 import UncertainFilter
from fkgen.faults import SensorFaults
from fkgen.problem import Number
from fkgen.symbolic.interface import triangle
from fkgen.symbolic.interpreter import Interpreter
from fkgen.symbolic.linalg import congruence, unpack

SHARE = [[0.8, 0.2], [0.8, 0.2]]
WHITE = {"problem": 1, "gamma_rate": 0.6, "delta_nominal_rate": 0.8}
EXAMPLE_2 = {
    "problem": "moments",
    "gamma_rate": 0.55,
    "gamma_persistence": 0.8,
    "delta_nominal_rate": 0.8,
}
ABSORBING = product([[0.7, 0.3], [0.0, 1.0]], SHARE, initial=(0.2, 0.8))
WITH_MEMORY = [EXAMPLE_2, ABSORBING]
NAMES = ["example 2", "absorbing"]

PRINTED = "those of (23)"
BEST = "best linear ones"
START = "the prediction for sample 0"


def linear(law):
    model = centred(random_model(84, 2, 2, correlated=True))
    return sensed(model, law, family="linear_optimal")


def assert_seen(mutant):
    """Both the printed form and the batch contradict."""
    failed = refusals(mutant)
    assert PRINTED in failed
    assert BEST in failed


@pytest.mark.parametrize("law", [WHITE, *WITH_MEMORY], ids=["white", *NAMES])
def test_what_is_not_mutated_passes(law):
    assert len(proved(recursion(linear(law))).claims) == 3


@pytest.mark.parametrize("law", WITH_MEMORY, ids=NAMES)
def test_mistake_p11_once_instead_of_squared(law, monkeypatch):
    right = lemma2._noise

    def once(script, design, plant, *rest):
        p11 = design.persistence()
        P = unpack(design.symbols["predicted_covariance"], plant.nx)
        signal = unpack(congruence(plant.C, P), plant.ny)  # p11 C P C' + W for p11^2 C P C' + W
        return right(script, design, plant, *rest) + (p11 - p11 * p11) * signal

    plant = linear(law)
    monkeypatch.setattr(lemma2, "_noise", once)
    assert_seen(recursion(plant))


@pytest.mark.parametrize("law", [WHITE, *WITH_MEMORY], ids=["white", *NAMES])
def test_mistake_second_moment_of_the_sample_before(law):
    whole = recursion(linear(law))
    late = started(whole, state_second_moment=whole.initial["predicted_state_second_moment"])
    new, old = "predicted_state_second_moment", "state_second_moment"
    symbols = {name for block in late.update.blocks for name in block.assign} - {old}
    for name in sorted(symbols):
        late = read_instead(late, name, new, old)
    assert_seen(late)


def test_mistake_mean_noise_of_one(monkeypatch):
    monkeypatch.setattr(UncertainFilter, "nominal", lambda *_: ca.SX(1))
    assert_seen(recursion(linear(WHITE)))


def test_mistake_time_update_before_the_first_sample():
    plant = linear(EXAMPLE_2)
    A, Q, P0 = (getattr(plant.model, name).values() for name in ("A", "Q", "P0"))
    moved = A @ P0 @ A.T + Q
    packed = tuple(float(moved[i, j]) for i, j in triangle(2))
    right = recursion(plant)
    assert START in refusals(started(right, predicted_covariance=packed))
    assert_seen(started(right, predicted_state_second_moment=packed))


@pytest.mark.parametrize("law", WITH_MEMORY, ids=NAMES)
def test_mistake_sign_of_a_cross_term(law):
    # (E[gamma] - p11) E[x x'] C', the covariance of state and measurement noise.
    whole = recursion(linear(law))
    assert_seen(rewritten(whole, "noise_cross", lambda _, value, __: -value))


def rate_for_persistence(design):
    return design.gamma()


@pytest.mark.parametrize("law", WITH_MEMORY, ids=NAMES)
def test_mistake_rate_in_place_of_p11(law, monkeypatch):
    monkeypatch.setattr(UncertainFilter, "persistence", rate_for_persistence)
    assert_seen(recursion(linear(law)))


def test_mistake_rate_in_place_of_p11_is_none_where_gamma_is_white(monkeypatch):
    monkeypatch.setattr(UncertainFilter, "persistence", rate_for_persistence)
    assert proved(recursion(linear(WHITE)))


def test_mistake_constant_rate_on_the_absorbing_chain(monkeypatch):
    def constant(design):
        return ca.SX(sum(design.faults.initial[:2]))

    monkeypatch.setattr(UncertainFilter, "gamma", constant)
    assert_seen(recursion(linear(ABSORBING)))


def test_mistake_genie_updating_without_a_signal(monkeypatch):
    right = SensorFaults.sensed
    plant = sensed(centred(random_model(85, 2, 2)), {}, family="genie")
    y, u = np.ones((1, 2)), np.zeros((1, 0))
    silent = {"gamma": np.zeros(1), "delta": np.ones(1)}
    whole = recursion(plant)
    assert proved(whole)
    monkeypatch.setattr(SensorFaults, "sensed", lambda f, m, _, d: right(f, m, Number(1.0), d))
    mutant = recursion(plant)
    assert "joint distribution" in refusals(mutant)
    moved = [Interpreter(r).run(y, u, silent)["filtered_state"].any() for r in (whole, mutant)]
    assert moved == [False, True]


@pytest.mark.parametrize("form", ["lemma2", "augmented"])
@pytest.mark.parametrize("letter", ["A", "C", "Q", "R", "P0"])
def test_an_error_of_a_thousandth_in_the_plant_is_refused(letter, form):
    right = linear(ABSORBING)
    given = right.to_dict()
    given["filter"]["form"] = form
    spec = type(right).from_dict(given)
    given["model"][letter] = (1.001 * getattr(right.model, letter).values()).tolist()
    mutant = replace(recursion(type(right).from_dict(given)), spec=spec)
    assert refusals(mutant)
