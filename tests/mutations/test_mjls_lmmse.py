"""Mistakes in the filter of jumping plants, by name: refused, and by which comparison."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from jump_plants import EXAMPLE_B, EXAMPLE_S, GILBERT, random_table, spec_of
from mutants import proved, recursion, refusals, rewritten, started

from fkgen.estimators.lmmse import jump, loss_tests, stationary
from fkgen.estimators.lmmse.jump import AugmentedState
from fkgen.symbolic.interface import triangle

PATHS = "projections over all paths"
MATRICES = "whole matrices"
START = "the prediction for sample 0"

PLAIN = spec_of(random_table(51, 3, 2, 2, correlated=True))
OFFSETS = spec_of(random_table(52, 2, 2, 1, offsets=True))
DRIVEN = spec_of(random_table(53, 2, 2, 2, q=1))
RATE = spec_of(random_table(54, 2, 2, 1), arrival_rate=0.7)
CHAIN = spec_of(random_table(55, 2, 2, 1), arrival_chain=GILBERT)
STEADY = spec_of(EXAMPLE_S, arrival_rate=0.8, gain="stationary")
ALL = {
    "plain": PLAIN,
    "offsets": OFFSETS,
    "driven": DRIVEN,
    "rate": RATE,
    "chain": CHAIN,
    "steady": STEADY,
}


def judged(detector, **options):
    """Losses in the trial's record, so that some samples are rejected and some are not."""
    return spec_of(EXAMPLE_B, arrival_rate=0.5, detector=detector, **options)


LLR, ENERGY = judged("llr"), judged("energy")
NIS = spec_of(random_table(56, 2, 2, 2), arrival_rate=0.5, detector="nis", alpha=0.4)


def assert_seen(mutant):
    """Both oracles contradict."""
    failed = refusals(mutant)
    assert PATHS in failed
    assert MATRICES in failed


@pytest.mark.parametrize("spec", [*ALL.values(), LLR, NIS, ENERGY])
def test_what_is_not_mutated_passes(spec):
    assert proved(recursion(spec))


@pytest.mark.parametrize("spec", [PLAIN, OFFSETS, RATE, CHAIN])
def test_mistake_transposed_transition(spec, monkeypatch):
    right = AugmentedState.transition.fget
    monkeypatch.setattr(AugmentedState, "transition", property(lambda split: right(split).T))
    assert_seen(recursion(spec))


def test_mistake_chain_of_arrivals_in_the_order_of_the_spec(monkeypatch):
    def turned(spec):
        split = AugmentedState(spec)
        split.arrival, split.shares = split.arrival[::-1, ::-1], split.shares[::-1]
        return split

    monkeypatch.setattr(jump, "AugmentedState", turned)
    assert_seen(recursion(CHAIN))


def test_mistake_second_moments_for_covariances_at_the_start():
    whole = recursion(PLAIN)
    q = np.array(whole.initial["augmented_state"])
    lower = [q[i] * q[j] for i, j in triangle(len(q))]
    raw = tuple(np.add(whole.initial["augmented_covariance"], lower).tolist())
    assert_seen(started(whole, augmented_covariance=raw))


def test_mistake_time_update_before_the_first_sample():
    whole = recursion(PLAIN)
    assert START in refusals(started(whole, predicted_state=(0.0, 0.0)))


def test_mistake_mode_after_the_jump(monkeypatch):
    """y[k] and the step to k + 1 belong to mode[k], not to mode[k + 1]."""
    right = jump.mean_noise

    def late(builder, split, plants, law):
        return right(builder, split, plants, jump.next_law(split, law))

    monkeypatch.setattr(jump, "mean_noise", late)
    assert_seen(recursion(PLAIN))


def test_mistake_law_that_stands_still(monkeypatch):
    monkeypatch.setattr(jump, "next_law", lambda _, law: law)
    assert_seen(recursion(PLAIN))


@pytest.mark.parametrize("mistake", ["none", "sign", "diagonal"])
def test_mistake_in_the_noise_of_the_indicators(mistake, monkeypatch):
    right = jump.augmented_noise

    def wrong(split, moved, *others):
        still = right(split, [0 * each for each in moved], *others)
        jumps = right(split, moved, *others) - still
        w = split.width
        if mistake == "diagonal":
            jumps[w : 2 * w, :w] = 0
        return still + {"none": 0, "sign": -1, "diagonal": 1}[mistake] * jumps

    monkeypatch.setattr(jump, "augmented_noise", wrong)
    assert_seen(recursion(PLAIN))


def test_mistake_noise_of_the_plant_missing_between_x_and_its_parts(monkeypatch):
    right = jump.augmented_noise

    def wrong(*given):
        split, W = given[0], ca.SX(right(*given))
        W[split.own, : split.size - split.base.nx] = 0
        return W

    monkeypatch.setattr(jump, "augmented_noise", wrong)
    assert_seen(recursion(PLAIN))


@pytest.mark.parametrize("spec", [OFFSETS, DRIVEN])
def test_mistake_offsets_in_the_mean_only(spec, monkeypatch):
    """What an offset adds depends on the mode, which y informs about: not just q but z moves."""
    right = jump.steps

    def wrong(split, plants, u):
        G, constant = right(split, plants, u)
        G = ca.SX(G)
        for i in range(split.parts - 1):
            one = i * split.width + split.base.nx
            G[split.own, one] = 0
        return G, constant

    monkeypatch.setattr(jump, "steps", wrong)
    assert_seen(recursion(spec))


def test_mistake_offset_left_out_of_the_second_moments(monkeypatch):
    monkeypatch.setattr(jump, "offset_of", lambda plant, _: ca.SX(plant.nx, 1))
    assert_seen(recursion(OFFSETS))


def test_mistake_feedthrough_of_the_first_mode_for_all(monkeypatch):
    right = jump.measured

    def wrong(split, plants, u):
        return right(split, tuple(replace(plant, D=plants[0].D) for plant in plants), u)

    monkeypatch.setattr(jump, "measured", wrong)
    assert_seen(recursion(DRIVEN))


def test_mistake_no_doubt_about_the_signal(monkeypatch):
    monkeypatch.setattr(jump, "_with_doubt", lambda _script, _split, noise, _moment: noise)
    assert_seen(recursion(RATE))


def test_mistake_doubt_without_the_part_of_the_estimate(monkeypatch):
    right = jump.measured
    monkeypatch.setattr(
        jump,
        "measured",
        lambda split, plants, u: (right(split, plants, u)[0] / split.rate, ca.SX(1, 1)),
    )
    assert_seen(recursion(RATE))


def test_mistake_mode_plants_in_another_order(monkeypatch):
    right = AugmentedState.plant
    monkeypatch.setattr(
        AugmentedState, "plant", lambda split, plants, i: right(split, plants, i + 1)
    )
    assert_seen(recursion(PLAIN))


def test_mistake_sign_of_the_log_odds(monkeypatch):
    right = loss_tests.LossTest._log_odds
    monkeypatch.setattr(loss_tests.LossTest, "_log_odds", lambda *given: -right(*given))
    assert_seen(recursion(LLR))


def test_mistake_log_odds_without_the_prior():
    whole = recursion(spec_of(EXAMPLE_B, arrival_rate=0.8, detector="llr"))
    shift = np.log(0.2) - np.log(0.8)
    assert_seen(rewritten(whole, "statistic", lambda _, value, __: value - shift))


def test_mistake_noise_of_a_lost_sample_with_the_state_in_it(monkeypatch):
    right = loss_tests.LossTest.verdict

    def wrong(test, found, measurement, noise):
        return right(test, found, measurement, 2.0 * noise)

    monkeypatch.setattr(loss_tests.LossTest, "verdict", wrong)
    assert_seen(recursion(LLR))


def test_mistake_quantile_of_one_row_for_all(monkeypatch):
    right = loss_tests.LossTest._quantile
    monkeypatch.setattr(
        loss_tests.LossTest, "_quantile", lambda test, count: right(test, count / 10)
    )
    assert_seen(recursion(NIS))


def test_mistake_energy_against_the_noise_alone():
    whole = recursion(ENERGY)
    assert_seen(rewritten(whole, "threshold", lambda _, value, __: 0.5 * value))


@pytest.mark.parametrize("spec", [LLR, NIS, ENERGY])
def test_mistake_a_rejected_sample_corrects_all_the_same(spec):
    assert_seen(rewritten(recursion(spec), "kept_", lambda name, _, s: s[_corrected(name)]))


def _corrected(name):
    return {"kept_state": "mean", "kept_covariance": "covariance"}[name]


def test_mistake_missing_samples_end_a_run_of_rejections():
    spec = judged("nis", alpha=0.999)
    whole = rewritten(recursion(spec), "rejections", lambda _, v, __: 0 * v if v.is_leaf() else v)
    assert_seen(whole)


def test_mistake_gain_of_the_predictor(monkeypatch):
    right = stationary.stationary_of

    def wrong(split):
        found = right(split)
        F = jump.mixing(split)[0] @ jump.steps(split, split.plants, ca.SX(0, 1))[0]
        return replace(found, gain=np.array(ca.evalf(F)) @ found.gain)

    monkeypatch.setattr(stationary, "stationary_of", wrong)
    assert MATRICES in refusals(recursion(STEADY))


def test_mistake_stationary_gain_that_trusts_every_sample(monkeypatch):
    right = jump.signal_moment
    monkeypatch.setattr(jump, "signal_moment", lambda *given: 0 * right(*given))
    assert MATRICES in refusals(recursion(STEADY))


def test_mistake_newton_that_stops_at_the_lyapunov_equation(monkeypatch):
    monkeypatch.setattr(stationary, "riccati", lambda F, _L, W, _R: stationary._lyapunov(F, W))
    assert MATRICES in refusals(recursion(STEADY))
