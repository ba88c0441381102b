"""The compiled linear filter against joint moments, older filters, printed numbers."""

from __future__ import annotations

import numpy as np
import pytest
from plants import assert_agree, distance, random_model, run, spec
from sensor_specs import (
    EXACT,
    PROBLEMS,
    SCALAR,
    chain,
    plane,
    product,
    sensed,
    shaken,
    varying,
)

from fkgen.oracle.exact.moments import FaultMoments
from fkgen.oracle.exact.uncertain import batch_uncertain, joint_moments
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.plants.sensor import SensorLaw
from fkgen.oracle.textbook.linear_optimal import linear_optimal, true_covariance

BATCH = (
    "filtered_state",
    "filtered_covariance",
    "predicted_state",
    "predicted_covariance",
    "innovation",
    "innovation_covariance",
    "nis",
    "log_likelihood",
)
PRINTED = (*BATCH[:6], "state_gain", "measurement_gain", "state_second_moment")
RARE = [[0.8, 0.2], [0.8, 0.2]]
STICKY = [[0.9, 0.1], [0.1, 0.9]]
TURNING = [[0.1, 0.9], [0.9, 0.1]]
T = 9


def linear(model, law, **options):
    return sensed(model, law, family="linear_optimal", **options)


def moments(rate, persistence, nominal=0.8, **others):
    law = {"problem": "moments", "gamma_rate": rate, "gamma_persistence": persistence}
    return law | {"delta_nominal_rate": nominal, **others}


def example_2(p=0.9, q=0.7, **others):
    """(29): gamma = 1 - alpha (1 - beta); alpha = 1 once for all with q, beta = 1 with p."""
    rate = 1.0 - q * (1.0 - p)
    return moments(rate, (1.0 - q + q * p**2) / rate, **others)


#: Laws under which Lemma 2 holds; gamma of the first four depends on its past.
LAWS = {
    "example 2": example_2(),
    "example 2, p = 0.2, q = 0.5": example_2(0.2, 0.5),
    "random constant": product([[1.0, 0.0], [0.0, 1.0]], RARE, initial=(0.6, 0.8)),
    "absorbing": product([[0.7, 0.3], [0.0, 1.0]], RARE, initial=(0.2, 0.8)),
    "noise that comes": product(RARE, [[0.9, 0.1], [0.0, 1.0]], initial=(0.2, 1.0)),
    "sure start": product([[0.4, 0.6]] * 2, STICKY, initial=(1.0, 0.5)),
    # gamma is white, and its rate alternates with delta, which is known to turn.
    "rate that alternates": chain(
        [[0.0, 0.3, 0.0, 0.7], [0.8, 0, 0.2, 0], [0, 0.3, 0, 0.7], [0.8, 0, 0.2, 0]],
        [0.8, 0.0, 0.2, 0.0],
    ),
}
WITH_MEMORY = list(LAWS)[:4]


def system_of(plant, length, params=None):
    return LinearSystem.from_spec(plant, length, params)


def oracle(plant, y, u, params=None, *, function=batch_uncertain):
    given = FaultMoments.from_spec(plant, len(y))
    return function(system_of(plant, len(y), params), given, y, u)


def noisy_record(plant, length=T, *, missing=0.2, seed=1):
    """Linear filters are linear whatever comes in: any numbers will do."""
    rng = np.random.default_rng(seed)
    y = 3.0 * rng.standard_normal((length, plant.model.ny))
    y[rng.random(y.shape) < missing] = np.nan
    y[length // 2] = np.nan
    return y, rng.standard_normal((length, plant.model.nu))


@pytest.mark.parametrize("name", list(LAWS))
def test_under_lemma_2_the_filter_is_the_best_linear_one(name):  # d, e, f, g, h, i
    plant = linear(plane(), LAWS[name])
    y, u = noisy_record(plant)
    result = run(plant, y, u)
    assert_agree(result, oracle(plant, y, u), BATCH, EXACT)
    # C - V of the printed form cancels some digits where E[x x'] is ten times the error.
    assert_agree(result, oracle(plant, y, u, function=linear_optimal), PRINTED, EXACT)


@pytest.mark.parametrize(
    ("rows", "law"), [([0], "1"), ([1], "2"), ([0, 1], "1"), ([0], "sure start")]
)
def test_inputs_a_mean_and_healthy_rows_are_covered_where_gamma_is_white(rows, law):  # j
    given = (PROBLEMS | LAWS)[law] | {"rows": rows}
    plant = linear(random_model(51, 2, 2, 1, direct=True, correlated=True), given)
    y, u = noisy_record(plant)
    result = run(plant, y, u)
    assert_agree(result, oracle(plant, y, u), BATCH, EXACT)
    assert_agree(result, oracle(plant, y, u, function=linear_optimal), PRINTED, EXACT)


@pytest.mark.parametrize("form", ["lemma2", "augmented"])
def test_a_plant_that_changes_in_every_sample_is_followed(form):
    law = "1" if form == "lemma2" else "4"
    plant = varying(PROBLEMS[law] | {"rows": [1]}, family="linear_optimal", form=form)
    params = shaken(T)
    y, u = noisy_record(plant)
    assert_agree(run(plant, y, u, params), oracle(plant, y, u, params), BATCH, EXACT)


@pytest.mark.parametrize("law", ["3", "4", "zeros"])
@pytest.mark.parametrize(
    ("n", "p", "q", "rows"), [(1, 1, 0, [0]), (2, 2, 1, [0]), (2, 2, 0, [0, 1])]
)
def test_the_augmented_form_is_the_best_linear_filter_for_any_law(n, p, q, rows, law):
    model = random_model(52 + n, n, p, q, direct=q > 0, correlated=True)
    plant = linear(model, PROBLEMS[law] | {"rows": rows}, form="augmented")
    y, u = noisy_record(plant)
    assert_agree(run(plant, y, u), oracle(plant, y, u), BATCH, EXACT)


@pytest.mark.parametrize("name", WITH_MEMORY[2:])
def test_both_forms_agree_under_lemma_2(name):
    short, whole = (linear(plane(), LAWS[name], form=f) for f in ("lemma2", "augmented"))
    y, u = noisy_record(short, 40)
    assert_agree(run(whole, y, u), run(short, y, u), BATCH, EXACT)


def test_example_2_by_its_hidden_coin_is_example_2_by_its_moments():  # g
    p, q = 0.9, 0.7
    # With noise of one size delta is free to stand for alpha: mode 0 is alpha = 0.
    beta = [0.0, p, 0.0, 1.0 - p]
    kernel = [[1.0, 0.0, 0.0, 0.0], beta, beta, beta]
    hidden = chain(kernel, [1.0 - q, q * p, 0.0, q * (1.0 - p)], noise_factor=1.0)
    given = example_2(p, q, noise_factor=1.0)
    plants = [linear(plane(), law, form=form) for law, form in (
        (given, "lemma2"), (hidden, "lemma2"), (hidden, "augmented"))]  # fmt: skip
    y, u = noisy_record(plants[0], 40)
    expected = run(plants[0], y, u)
    for other in plants[1:]:
        assert_agree(run(other, y, u), expected, BATCH, EXACT)


def test_the_rate_of_an_absorbing_chain_grows_as_one_minus_a_power():  # e
    result = run(linear(SCALAR, LAWS["absorbing"]), np.zeros((T, 1)))
    rate = 1.0 - 0.8 * 0.7 ** np.arange(T)
    np.testing.assert_allclose(result.mode_law[:, :2].sum(axis=1), rate, rtol=1e-13)


@pytest.mark.parametrize(("nominal", "noise"), [(1.0, 1.0), (0.6, 4.6)])
def test_without_lost_signals_the_filter_is_the_kalman_filter(nominal, noise):  # a, b
    model = random_model(53, 2, 2, 1, direct=True, correlated=True)
    plant = linear(model, moments(1.0, 1.0, nominal))
    kalman = spec(model | {"R": (noise * np.array(model["R"])).tolist()}, family="kf")
    y, u = noisy_record(plant, 30)
    assert_agree(run(plant, y, u), run(kalman, y, u), BATCH, 1e-11)


def nahi(model, rate, y):
    """Nahi 1969: uncertain observation, independent gamma."""
    A, H, Q, R, P, S = (np.array(model[letter]) for letter in ("A", "C", "Q", "R", "P0", "P0"))
    x = np.zeros(len(A))
    for z in y:
        K = (
            rate
            * P
            @ H.T
            @ np.linalg.inv(rate**2 * H @ P @ H.T + rate * (1.0 - rate) * H @ S @ H.T + R)
        )
        x, P = x + K @ (z - rate * H @ x), P - rate * K @ H @ P
        yield x, P
        x, P, S = A @ x, A @ P @ A.T + Q, A @ S @ A.T + Q


def test_for_white_gamma_and_constant_noise_the_filter_is_nahis():  # c
    model = plane()
    plant = linear(model, {"problem": 1, "gamma_rate": 0.4, "noise_factor": 1.0})
    y = np.random.default_rng(4).standard_normal((30, 2))
    result = run(plant, y)
    for k, (x, P) in enumerate(nahi(model, 0.4, y)):
        assert distance(result.filtered_state[k], x) < EXACT
        assert distance(result.filtered_covariance[k], P) < EXACT


def test_a_sensor_that_never_works_is_not_listened_to():  # l
    for persistence in (0.0, 0.7):
        plant = linear(plane(), moments(0.0, persistence))
        result = run(plant, *noisy_record(plant))
        # p11 P C' + (0 - p11) E[x x'] C' is a difference of equal numbers, and V is zero.
        np.testing.assert_allclose(result.measurement_gain, 0.0, atol=1e-14)
        np.testing.assert_allclose(result.filtered_state, 0.0, atol=1e-14)
        assert distance(result.filtered_covariance, result.state_second_moment) < 1e-13


@pytest.mark.parametrize("name", ["random constant", "sure start"])
def test_rows_without_noise_that_say_the_same_are_no_obstacle(name):  # k
    row = [1.0, 0.5]
    plant = linear(plane(C=[row, row], R=np.zeros((2, 2))), LAWS[name])
    y = np.repeat(np.random.default_rng(5).standard_normal((6, 1)), 2, axis=1)
    result, expected = run(plant, y), oracle(plant, y, None)
    assert (result.status == 0).all()
    # Both sides decide on a rank.
    assert_agree(result, expected, ("filtered_state", "filtered_covariance"), 1e-6)


@pytest.mark.parametrize("name", ["example 2", "absorbing", "noise that comes"])
def test_second_moments_of_the_estimate_obey_the_paper(name):  # y
    plant = linear(plane(), LAWS[name])
    result = run(plant, noisy_record(plant, missing=0.0)[0][:4])
    A, Q = plant.model.A.values(), plant.model.Q.values()
    V = result.state_second_moment - result.filtered_covariance
    for k in range(1, 4):
        F2, M = result.measurement_gain[k], result.innovation_covariance[k]
        # One difference of numbers of one size.
        assert distance(V[k], A @ V[k - 1] @ A.T + F2 @ M @ F2.T) < 1e-12
        C = A @ result.state_second_moment[k - 1] @ A.T + Q
        assert distance(result.state_second_moment[k], C) < 1e-13


@pytest.mark.parametrize("name", list(LAWS))
def test_the_error_is_orthogonal_to_all_measurements(name):  # z
    plant = linear(plane(), LAWS[name])
    result = run(plant, np.zeros((6, 2)))
    given = FaultMoments.from_spec(plant, 6)
    _, covariance = joint_moments(system_of(plant, 6), given, None)
    split, weights = 14, np.zeros((2, len(covariance)))
    for k in range(6):
        weights = result.state_gain[k] @ weights
        weights[:, split + 2 * k : split + 2 * k + 2] += result.measurement_gain[k]
        error = weights.copy()
        error[:, 2 * k : 2 * k + 2] -= np.eye(2)
        cross = (error @ covariance)[:, split : split + 2 * k + 2]
        np.testing.assert_allclose(cross, 0.0, atol=1e-12 * np.abs(covariance).max())
        P = error @ covariance @ error.T
        assert distance(result.filtered_covariance[k], P) < 1e-10


def test_an_unstable_plant_costs_no_digits():
    growing = SCALAR | {"A": [[1.1]], "P0": [[1.0]]}
    plant = linear(growing, moments(1.0, 1.0, 1.0))
    y = np.zeros((200, 1))
    P = run(plant, y).filtered_covariance[:, 0, 0]
    assert P[199] == pytest.approx(0.6394799353, abs=1e-10)
    printed = oracle(plant, y, None, function=linear_optimal).filtered_covariance[:, 0, 0]
    assert printed[50] == pytest.approx(P[50], rel=1e-9)
    assert abs(printed[199] - P[199]) > 0.01  # C - V, both some 1e16


#: p11, F1, F2, C, V, C - V at rest, from SymPy and an independent recursion.
SETTLED = {
    "example 1": (product(TURNING, RARE), -0.774835381917, 0.314557726039, 1.628476793487),
    "sticky": (product(STICKY, RARE), -0.614767402986, 0.257267495853, 2.074657440161),
    "example 2": (example_2(), -0.530981724312, 0.360707895602, 1.157810730670),
}
#: True mean squared errors of the filter and of the best linear one.
TRUTH = {"example 1": (1.9630847447, 1.8552094753), "sticky": (2.0561034465, 2.0530840567)}


@pytest.mark.parametrize("name", list(SETTLED))
def test_the_scalar_plant_comes_to_rest_at_the_known_values(name):
    law, F1, F2, P = SETTLED[name]
    plant = linear(SCALAR, law)
    result = run(plant, np.zeros((400, 1)))
    found = (result.state_gain, result.measurement_gain, result.filtered_covariance)
    np.testing.assert_allclose([v[-1, 0, 0] for v in found], [F1, F2, P], rtol=0, atol=2e-12)
    C = result.state_second_moment[-1, 0, 0]
    assert pytest.approx(2.777777777778, abs=2e-12) == C


@pytest.mark.parametrize("name", list(TRUTH))
def test_where_lemma_2_fails_the_true_error_is_another_and_the_augmented_form_knows_it(name):
    law, claimed = SETTLED[name][0], SETTLED[name][3]
    plant, whole = linear(SCALAR, law), linear(SCALAR, law, form="augmented")
    y = np.zeros((400, 1))
    result = run(plant, y)
    gains = result.state_gain, result.measurement_gain
    truth = true_covariance(system_of(plant, 400), SensorLaw.from_spec(plant), gains)[-1, 0, 0]
    best = run(whole, y).filtered_covariance[-1, 0, 0]
    np.testing.assert_allclose([truth, best], TRUTH[name], rtol=0.0, atol=1e-10)
    assert best < truth
    assert abs(truth - claimed) > 0.01
