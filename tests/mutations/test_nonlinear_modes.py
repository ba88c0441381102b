"""Mistakes in filters of several modes over plants by equations: what the proof says of each."""

from __future__ import annotations

from functools import cache

import casadi as ca
import equations
import numpy as np
import pytest
import random_equations
from mutants import proved, recursion, refusals

import fkgen
from fkgen.estimators.gaussian import estimate
from fkgen.estimators.models import bank, interacting, merge, one_step, switching
from fkgen.symbolic.lifting import equations as lifting


@cache
def plant(name):
    """A plant of random equations, or a robot whose modes turn apart, by more than half a turn."""
    if name != "robot":
        return random_equations.spec(name)
    modes = [
        {"f": {"heading": "heading + 3 + w_turn*dt"}, "h": {"bearing": "atan2(y, x) - heading"}},
        {"f": {"heading": "heading - 3 + w_turn*dt"}, "h": {"bearing": "atan2(y, x) + 3"}},
    ]
    law = {"transition": [[0.6, 0.4], [0.3, 0.7]], "initial": [0.5, 0.5]}
    model = equations.ROBOT | {"Q": np.diag([0.01, 0.02, 0.01]).tolist()}
    return fkgen.Spec.from_dict(
        equations.table(model, family="imm", faults={"jump": law | {"modes": modes}})
    )


def at_the_first(linearise):
    """Linearise all plants where the first one is."""

    def wrong(builder, plants, states, u, *tag):
        return linearise(builder, plants, [states[0]] * len(states), u, *tag)

    return wrong


def not_turned(attitudes, errors, **_):
    return ca.SX.eye(errors.numel())


def at_the_prior(linearise):
    """Linearise f where the sample began."""

    def wrong(builder, plants, _, u, *tag):
        states = [builder.symbol("predicted_state")] * len(plants)
        return linearise(builder, plants, states, u, *tag)

    return wrong


def unreduced(value):
    return value


#: What is put in the place of what, and a plant that shows it.
MISTAKES = {
    "h of all modes at the first one": ("imm_jump", switching, "seen_from", at_the_first),
    "f of a mode at the mixture's prediction": (
        "imm_jump",
        interacting,
        "moved_from",
        at_the_prior,
    ),
    "f of one_step at the prediction": ("one_step", one_step, "moved_from", at_the_prior),
    "covariances mixed in their own axes": (
        "imm_attitude", merge, "turned_by", lambda _: not_turned,
    ),
    "hypotheses combined in their own axes": (
        "mme_attitude", merge, "turned_by", lambda _: not_turned,
    ),
    "no reset of a mode": ("imm_attitude", estimate, "turned_by", lambda _: not_turned),
    "no reset of one_step": ("one_step_attitude", estimate, "turned_by", lambda _: not_turned),
    "no reset of genie": ("genie_attitude", estimate, "turned_by", lambda _: not_turned),
    "no turn by what gamma moves": ("mkf_attitude", estimate, "turned_by", lambda _: not_turned),
    "no wrap of predictions of y": ("robot", merge, "reduced", lambda _: unreduced),
    "no wrap of differences of states": ("robot", lifting, "reduced", lambda _: unreduced),
    "f of a bank at another input": (
        "mme_sensed", bank, "moved_from",
        lambda right: lambda b, p, x, u, tag: right(b, p, x, 0.9 * u, tag),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", sorted({name for name, *_ in MISTAKES.values()}))
def test_without_a_mistake_all_claims_hold(name):
    assert all(claim.holds for claim in proved(recursion(plant(name))).claims)


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistake(mistake, monkeypatch):
    name, module, function, wrong = MISTAKES[mistake]
    spec = plant(name)
    monkeypatch.setattr(module, function, wrong(getattr(module, function)))
    assert refusals(recursion(spec))
