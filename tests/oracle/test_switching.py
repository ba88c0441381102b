"""The textbook one-step and interacting filters: where they are exact, and where they agree."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from imm_plants import KALMAN, PORTS
from sensor_plants import (
    ALTERNATING,
    STICKY,
    any_law,
    close,
    example,
    inputs,
    law,
    plant,
    product_law,
    with_modes,
)

from fkgen.oracle.exact.batch import batch_lmmse
from fkgen.oracle.exact.enumeration import enumerate_modes
from fkgen.oracle.plants.sensor import simulate_sensor
from fkgen.oracle.textbook.switching import textbook_imm, textbook_one_step

EXACT = tuple(port for port in PORTS if port != "nis")
IID_NOISE = np.tile([0.8, 0.2], (2, 1))
READINGS = ("moment_matched", "weighted", "paper", "paper_nominal")
TURN = np.eye(4)[[2, 0, 3, 1]]


def three_modes(system, a_law, y, u):
    return textbook_imm(system, a_law, y, u, modes=3)


def case(seed, a_law, *, T=8, missing=0.0, **options):
    rng = np.random.default_rng(seed)
    system = plant(rng, T=T, **options)
    u = inputs(rng, system)
    y, modes = simulate_sensor(system, a_law, u, rng)
    y[rng.random(y.shape) < missing] = np.nan
    return system, y, u, modes


@pytest.mark.parametrize("mode", range(4))
@pytest.mark.parametrize("rows", [(0,), (0, 1)])
@pytest.mark.parametrize("run", [textbook_one_step, textbook_imm])
def test_a_known_first_mode_makes_two_samples_exact(run, rows, mode):
    rng = np.random.default_rng(mode)
    a_law = replace(any_law(rng, rows=rows), initial=np.eye(4)[mode])
    system, y, u, _ = case(mode, a_law, T=2)
    close(run(system, a_law, y, u), enumerate_modes(system, a_law, y, u), EXACT)


@pytest.mark.parametrize("run", [textbook_one_step, textbook_imm])
@pytest.mark.parametrize("missing", [0.0, 0.5])
def test_the_first_sample_is_bayes_rule_itself(run, missing):
    a_law = any_law(np.random.default_rng(5))
    system, y, u, _ = case(5, a_law, T=2, missing=missing)
    exact = enumerate_modes(system, a_law, y, u)
    close(run(system, a_law, y, u), exact, EXACT, rows=slice(1))


def test_every_mode_of_the_interacting_filter_is_exact_at_first():
    a_law = any_law(np.random.default_rng(6))
    system, y, u, _ = case(6, a_law, T=1)
    exact = enumerate_modes(system, a_law, y, u)
    ports = ("mode_filtered_state", "mode_filtered_covariance")
    close(textbook_imm(system, a_law, y, u), exact, ports)


@pytest.mark.parametrize("missing", [0.0, 0.3])
@pytest.mark.parametrize("rows", [(0,), (0, 1)])
def test_equal_rows_of_the_kernel_leave_nothing_to_mix(rows, missing):
    rng = np.random.default_rng(7)
    row = rng.dirichlet(np.ones(4))
    a_law = law(np.tile(row, (4, 1)), rng.dirichlet(np.ones(4)), rows=rows)
    system, y, u, _ = case(7, a_law, missing=missing)
    one_step, imm = textbook_one_step(system, a_law, y, u), textbook_imm(system, a_law, y, u)
    close(imm, one_step, PORTS)
    np.testing.assert_allclose(
        imm.mode_state, np.repeat(imm.predicted_state[:, None], 4, axis=1), rtol=1e-10, atol=1e-12
    )


def test_a_kernel_with_memory_is_worth_mixing():
    a_law = product_law(ALTERNATING, IID_NOISE)
    system, y, u, _ = case(8, a_law)
    one_step, imm = textbook_one_step(system, a_law, y, u), textbook_imm(system, a_law, y, u)
    assert np.abs(imm.filtered_state - one_step.filtered_state).max() > 1e-3


@pytest.mark.parametrize("missing", [0.0, 0.3])
@pytest.mark.parametrize("start", range(4))
@pytest.mark.parametrize("kernel", [np.eye(4), TURN], ids=["constant", "alternating"])
@pytest.mark.parametrize("run", [textbook_one_step, textbook_imm])
def test_known_modes_make_the_kalman_filter_that_is_told_them(run, kernel, start, missing):
    a_law = law(kernel, np.eye(4)[start])
    system, y, u, modes = case(9, a_law, missing=missing)
    result = run(system, a_law, y, u)
    close(result, batch_lmmse(with_modes(system, a_law, modes), y, u), KALMAN, rtol=1e-9)
    np.testing.assert_array_equal(result.mode_probability, np.eye(4)[modes])
    np.testing.assert_array_equal(result.predicted_mode_probability, np.eye(4)[modes] @ kernel)
    held = getattr(result, "mode_covariance", result.predicted_covariance)
    assert np.isfinite(held).all()


@pytest.mark.parametrize("start", range(4))
def test_a_mode_that_stays_is_known_to_three_modes_as_well(start):
    a_law = law(np.eye(4), np.eye(4)[start])
    system, y, u, modes = case(10, a_law)
    result = three_modes(system, a_law, y, u)
    close(result, batch_lmmse(with_modes(system, a_law, modes), y, u), KALMAN, rtol=1e-9)


@pytest.mark.parametrize("covariance", READINGS)
def test_every_reading_of_the_covariance_is_the_kalman_filter_without_faults(covariance):
    a_law = law(np.eye(4), np.eye(4)[0])
    system, y, u, _ = case(11, a_law, missing=0.2)
    result = textbook_one_step(system, a_law, y, u, covariance=covariance)
    close(result, batch_lmmse(system, y, u), KALMAN, rtol=1e-9)


def test_only_the_nominal_reading_forgets_constant_noise():
    a_law = law(np.eye(4), np.eye(4)[1])
    system, y, u, modes = case(12, a_law)
    expected = batch_lmmse(with_modes(system, a_law, modes), y, u)
    for covariance in READINGS[:3]:
        result = textbook_one_step(system, a_law, y, u, covariance=covariance)
        close(result, expected, KALMAN, rtol=1e-9)
    nominal = textbook_one_step(system, a_law, y, u, covariance="paper_nominal")
    quiet = batch_lmmse(system, y, u)
    noise = with_modes(system, a_law, modes).R - system.R
    close(nominal, expected, KALMAN, rows=slice(1))
    # It is as confident before each sample as without noise, and then adds R C instead of R.
    np.testing.assert_allclose(
        nominal.innovation_covariance[1:],
        (quiet.innovation_covariance + noise)[1:],
        rtol=1e-9,
        atol=1e-9,
    )


def test_the_readings_differ_where_faults_are_uncertain():
    a_law = product_law(ALTERNATING, IID_NOISE)
    system, y, u, _ = case(13, a_law)
    states = [
        textbook_one_step(system, a_law, y, u, covariance=reading).filtered_state[-1]
        for reading in READINGS
    ]
    for i in range(4):
        for j in range(i):
            assert np.abs(states[i] - states[j]).max() > 1e-4


@pytest.mark.parametrize("rows", [(0,), (0, 1)])
@pytest.mark.parametrize("missing", [0.0, 0.3])
def test_three_modes_are_four_where_noise_has_no_memory(rows, missing):
    a_law = product_law(ALTERNATING, IID_NOISE, rows=rows)
    system, y, u, _ = case(14, a_law, missing=missing)
    four, three = textbook_imm(system, a_law, y, u), three_modes(system, a_law, y, u)
    close(three, four, KALMAN, rtol=1e-9)
    lost = four.mode_probability[:, 2:].sum(axis=1)
    np.testing.assert_allclose(three.mode_probability[:, 2], lost, rtol=1e-9)
    np.testing.assert_allclose(three.mode_state[:, 2], four.mode_state[:, 2], rtol=1e-9, atol=1e-9)
    mean, covariance = _merged(four, slice(2, 4))
    np.testing.assert_allclose(three.mode_filtered_state[:, 2], mean, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(three.mode_filtered_covariance[:, 2], covariance, rtol=1e-8)


def _merged(result, modes):
    """Mean and covariance given that the mode is one of several."""
    weights = result.mode_probability[:, modes]
    weights = weights / weights.sum(axis=1, keepdims=True)
    means, covariances = (
        getattr(result, f"mode_filtered_{name}")[:, modes] for name in ("state", "covariance")
    )
    mean = np.einsum("ki,kij->kj", weights, means)
    second = covariances + np.einsum("kij,kil->kijl", means, means)
    covariance = np.einsum("ki,kijl->kjl", weights, second) - np.einsum("kj,kl->kjl", mean, mean)
    return mean, covariance


@pytest.mark.parametrize(
    "a_law",
    [
        product_law(ALTERNATING, STICKY, initial=([0.5, 0.5], [2 / 3, 1 / 3])),
        product_law(ALTERNATING, IID_NOISE, initial=([0.5, 0.5], [0.3, 0.7])),
    ],
    ids=["noise with memory", "another start"],
)
def test_three_modes_are_not_four_elsewhere(a_law):
    system, y, u, _ = case(15, a_law)
    four, three = textbook_imm(system, a_law, y, u), three_modes(system, a_law, y, u)
    assert np.abs(three.filtered_state - four.filtered_state).max() > 1e-4


@pytest.mark.parametrize("run", [textbook_one_step, textbook_imm])
def test_naming_the_noisy_mode_nominal_changes_the_names_only(run):
    order = [1, 0, 3, 2]
    a_law = any_law(np.random.default_rng(16), factor=10.0)
    system, y, u, _ = case(16, a_law)
    noisy = with_modes(system, a_law, [1] * system.length)
    renamed = law(a_law.kernel[order][:, order], a_law.initial[order], factor=0.1)
    here, there = run(system, a_law, y, u), run(noisy, renamed, y, u)
    close(there, here, KALMAN)
    np.testing.assert_allclose(there.mode_probability, here.mode_probability[:, order], rtol=1e-10)


@pytest.mark.parametrize("run", [textbook_one_step, textbook_imm, three_modes])
def test_units_and_coordinates_are_of_no_account(run):
    a_law = any_law(np.random.default_rng(17))
    system, y, u, _ = case(17, a_law)
    T = np.array([[2.0, 1.0], [0.5, -3.0]])
    unit, back = np.diag([1e3, -1e-2]), np.linalg.inv(T)
    changed = replace(
        system, A=T @ system.A @ back, B=T @ system.B, C=unit @ system.C @ back, D=unit @ system.D,
        Q=T @ system.Q @ T.T, R=unit @ system.R @ unit, x0=T @ system.x0, P0=T @ system.P0 @ T.T,
    )  # fmt: skip
    here, there = run(system, a_law, y, u), run(changed, a_law, y @ unit, u)
    expected = here.filtered_state @ T.T
    np.testing.assert_allclose(there.filtered_state, expected, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(there.mode_probability, here.mode_probability, rtol=1e-8)
    np.testing.assert_allclose(there.nis, here.nis, rtol=1e-8)
    jacobian = np.linalg.slogdet(unit)[1]
    np.testing.assert_allclose(there.log_likelihood + jacobian, here.log_likelihood, rtol=1e-8)


@pytest.mark.parametrize("run", [textbook_one_step, textbook_imm, three_modes])
def test_a_measurement_far_away_keeps_everything_finite(run):
    a_law = any_law(np.random.default_rng(18))
    system, y, u, _ = case(18, a_law)
    y[3] = 1e8
    result = run(system, a_law, y, u)
    for port in PORTS:
        assert np.isfinite(getattr(result, port)).all(), port
    np.testing.assert_allclose(result.mode_probability.sum(axis=1), 1.0, rtol=1e-12)


@pytest.mark.parametrize("run", [textbook_one_step, textbook_imm, three_modes])
def test_a_missing_sample_leaves_prediction_and_law(run):
    a_law = any_law(np.random.default_rng(19))
    system, y, u, _ = case(19, a_law)
    y[4] = np.nan
    result = run(system, a_law, y, u)
    before = result.predicted_mode_probability[3]
    np.testing.assert_allclose(result.mode_probability[4], before, rtol=1e-12)
    np.testing.assert_allclose(result.filtered_state[4], result.predicted_state[3], rtol=1e-11)
    assert result.log_likelihood[4] == result.nis[4] == 0.0
    assert np.isnan(result.innovation[4]).all()


@pytest.mark.parametrize("run", [textbook_one_step, textbook_imm])
def test_with_equal_noise_a_product_law_of_the_noise_is_of_no_account(run):
    noises = (STICKY, ALTERNATING)
    laws = [product_law(STICKY, noise, factor=1.0) for noise in noises]
    system, y, u, _ = case(20, laws[0])
    close(*(run(system, a_law, y, u) for a_law in laws), KALMAN)


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("signal", "bounds"), [(ALTERNATING, (0.02, 0.05)), (ALTERNATING[::-1], (0.025, 0.05))]
)
def test_distances_from_the_exact_estimate_are_those_of_the_approximation(signal, bounds):
    rng = np.random.default_rng(21)
    a_law, system = product_law(signal, IID_NOISE), example(5)
    distance = {textbook_imm: 0.0, textbook_one_step: 0.0}
    for _ in range(25):
        y, _ = simulate_sensor(system, a_law, None, rng)
        exact = enumerate_modes(system, a_law, y, None).filtered_state[-1, 0]
        for run in distance:
            distance[run] += abs(run(system, a_law, y, None).filtered_state[-1, 0] - exact) / 25
    # Over 200 records: 0.005 to 0.012 with mixing, 0.09 to 0.10 without.
    assert distance[textbook_imm] < bounds[0]
    assert bounds[1] < distance[textbook_one_step] < 0.2
