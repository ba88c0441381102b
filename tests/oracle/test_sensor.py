"""The law of sensor faults: plants per mode, simulation, and when three modes are enough."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise, product
from types import SimpleNamespace

import numpy as np
import pytest
from sensor_plants import ALTERNATING, STICKY, any_law, inputs, law, plant, product_law

from fkgen.errors import DataError
from fkgen.faults import SensorFaults
from fkgen.oracle.plants.sensor import (
    SensorLaw,
    aggregate,
    draw_modes,
    gamma_delta,
    is_lumpable,
    mode_plant,
    nominal_share,
    simulate_sensor,
)

HALF = np.array([0.5, 0.5])
RARE = np.array([0.8, 0.2])
IID_NOISE = np.tile(RARE, (2, 1))
TURN = np.eye(4)[[2, 0, 3, 1]]


def test_a_fault_strikes_its_rows_and_no_other():
    system = plant(np.random.default_rng(1), T=3)
    a_law = law(np.eye(4), np.eye(4)[0], factor=4.0, rows=(1,))
    C, D, R, d = mode_plant(replace(system, d=system.d + 3.0), a_law, 2, 3)
    np.testing.assert_array_equal(C, [system.C[2, 0], [0.0, 0.0]])
    np.testing.assert_array_equal(D, [system.D[2, 0], [0.0]])
    np.testing.assert_array_equal(d, [3.0, 0.0])
    # The deviation of row 1 doubles: its variance fourfold, its covariance with row 0 twofold.
    np.testing.assert_allclose(R, system.R[2] * [[1.0, 2.0], [2.0, 4.0]], rtol=1e-15)
    for mode, noise in enumerate([1.0, 4.0, 1.0, 4.0]):
        C, _, R, _ = mode_plant(system, a_law, 0, mode)
        assert (C[1] == 0.0).all() == (mode >= 2)
        assert R[1, 1] == pytest.approx(noise * system.R[0, 1, 1], rel=1e-15)


def test_modes_are_ordered_signal_first():
    gamma, delta = gamma_delta(law(np.eye(4), np.eye(4)[0], factor=7.0), np.arange(4))
    np.testing.assert_array_equal(gamma, [1.0, 1.0, 0.0, 0.0])
    np.testing.assert_array_equal(delta, [1.0, 7.0, 1.0, 7.0])


@pytest.mark.parametrize(
    "change",
    [
        {"initial": np.full(3, 1.0 / 3.0)},
        {"kernel": np.full((4, 4), 0.3)},
        {"kernel": np.eye(4)[:, :3]},
        {"initial": np.array([1.5, -0.5, 0.0, 0.0])},
    ],
)
def test_what_is_no_law_is_refused(change):
    with pytest.raises(DataError, match="SensorLaw"):
        replace(law(np.eye(4), np.eye(4)[0]), **change)


def test_a_law_comes_from_a_spec():
    kernel = tuple(map(tuple, TURN.tolist()))
    faults = SensorFaults(3.0, (1,), kernel, (0.0, 1.0, 0.0, 0.0))
    a_law = SensorLaw.from_spec(SimpleNamespace(faults=SimpleNamespace(sensor=faults)))
    np.testing.assert_array_equal(a_law.kernel, TURN)
    np.testing.assert_array_equal(a_law.initial, [0.0, 1.0, 0.0, 0.0])
    assert (a_law.noise_factor, a_law.rows) == (3.0, (1,))


@pytest.mark.parametrize("faults", [None, SensorFaults(3.0, (0,))])
def test_a_spec_without_a_chain_has_no_law(faults):
    with pytest.raises(DataError, match="no law"):
        SensorLaw.from_spec(SimpleNamespace(faults=SimpleNamespace(sensor=faults)))


def test_drawn_modes_follow_initial_law_and_kernel():
    rng = np.random.default_rng(2)
    a_law = any_law(rng)
    records = np.array([draw_modes(a_law, 3, rng) for _ in range(8000)])
    for k, expected in enumerate([a_law.initial, a_law.initial @ a_law.kernel]):
        share = np.bincount(records[:, k], minlength=4) / len(records)
        # Four standard deviations of at most 0.5 / sqrt(8000).
        np.testing.assert_allclose(share, expected, atol=0.023)
    for mode in range(4):
        following = records[records[:, 1] == mode, 2]
        share = np.bincount(following, minlength=4) / len(following)
        np.testing.assert_allclose(share, a_law.kernel[mode], atol=2.0 / np.sqrt(len(following)))


def test_simulated_measurements_have_the_moments_of_their_modes():
    rng = np.random.default_rng(3)
    system, a_law = plant(rng, T=2), law(TURN, np.eye(4)[1])
    u = inputs(rng, system)
    y = np.array([simulate_sensor(system, a_law, u, rng)[0] for _ in range(8000)])
    x, P = system.x0, system.P0
    for k, mode in enumerate([1, 0]):
        C, D, R, _ = mode_plant(system, a_law, k, mode)
        S = C @ P @ C.T + R
        error = y[:, k] - (C @ x + D @ u[k])
        deviation = np.sqrt(np.diag(S))
        np.testing.assert_allclose(error.mean(axis=0) / deviation, 0.0, atol=0.05)
        scale = np.outer(deviation, deviation)
        # Sample covariances of 8000 draws: four standard deviations are 0.063.
        np.testing.assert_allclose(np.cov(error.T) / scale, S / scale, atol=0.065)
        x, P = (
            system.A[k] @ x + system.B[k] @ u[k],
            system.A[k] @ P @ system.A[k].T + system.Q[k],
        )


JOINT = np.array([0.4, 0.1, 0.2, 0.3])
LUMPABLE = {
    "problem 1": law(np.tile(np.kron([0.7, 0.3], RARE), (4, 1)), np.kron([0.7, 0.3], RARE)),
    "problem 2": law(np.tile(JOINT, (4, 1)), JOINT),
    "problem 3": product_law(ALTERNATING, IID_NOISE),
    "known start": product_law(ALTERNATING, IID_NOISE, initial=([1.0, 0.0], [1.0, 0.0])),
    "one mode": law(np.eye(4), np.eye(4)[2]),
    "no signal lost": law(np.kron(np.eye(2), STICKY), [0.3, 0.7, 0.0, 0.0]),
    "no noise": product_law(STICKY, [[1.0, 0.0], [1.0, 0.0]], initial=([0.5, 0.5], [1.0, 0.0])),
}
OTHERS = {
    "noise with memory": (product_law(ALTERNATING, STICKY, initial=(HALF, [2 / 3, 1 / 3])), 0.63),
    "another start": (product_law(ALTERNATING, IID_NOISE, initial=(HALF, HALF)), 0.15),
    "alternating": (law(TURN, np.eye(4)[1]), 1.0),
    "constant": (law(np.eye(4), [0.25] * 4), 1.0),
}


@pytest.mark.parametrize("name", LUMPABLE)
def test_lumpable_laws_keep_the_probabilities_of_all_paths(name):
    a_law = LUMPABLE[name]
    assert is_lumpable(a_law) == (True, pytest.approx(0.0, abs=1e-15))
    kernel, initial = aggregate(a_law)
    share = nominal_share(a_law)
    three = np.array([0, 1, 2, 2])
    emitted = np.array([1.0, 1.0, share, 1.0 - share])
    for path in product(range(4), repeat=4):
        exact, lumped = a_law.initial[path[0]], initial[three[path[0]]] * emitted[path[0]]
        for before, after in pairwise(path):
            exact *= a_law.kernel[before, after]
            lumped *= kernel[three[before], three[after]] * emitted[after]
        assert lumped == pytest.approx(exact, rel=1e-12, abs=1e-16)


@pytest.mark.parametrize("name", OTHERS)
def test_other_laws_are_told_by_how_much_they_are_not(name):
    a_law, size = OTHERS[name]
    lumpable, actual = is_lumpable(a_law)
    assert not lumpable
    assert actual == pytest.approx(size, rel=1e-12)


def test_the_size_is_a_difference_of_probabilities():
    # Only after (0, 1) is delta = 1 more probable, by 0.05 within gamma = 0, which has 0.8 there.
    noise = np.array([0.8, 0.2])
    kernel = np.array([np.kron(row, noise) for row in np.repeat(STICKY, 2, axis=0)])
    kernel[2] = np.kron(STICKY[1], [0.85, 0.15])
    _, size = is_lumpable(law(kernel, np.kron([0.5, 0.5], noise)))
    share = nominal_share(law(kernel, np.full(4, 0.25)))
    assert 0.8 < share < 0.85
    assert size == pytest.approx(0.05 * 0.8, rel=1e-12)


def test_the_share_is_that_of_the_long_run():
    a_law = any_law(np.random.default_rng(4))
    late = np.linalg.matrix_power(a_law.kernel, 200)[0]
    assert nominal_share(a_law) == pytest.approx(late[2] / (late[2] + late[3]), rel=1e-12)
    # A chain of period four has a stationary law, which its powers do not approach.
    assert nominal_share(law(TURN, np.eye(4)[1])) == pytest.approx(0.5, rel=1e-12)
    assert nominal_share(law(np.eye(4), [0.1, 0.1, 0.6, 0.2])) == pytest.approx(0.75, rel=1e-12)
    assert nominal_share(law(np.eye(4), np.eye(4)[0])) == 1.0
