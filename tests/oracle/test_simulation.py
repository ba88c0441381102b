"""Simulated records have the moments that the joint distribution promises."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from fkgen.oracle.exact.batch import joint_distribution
from fkgen.oracle.plants.actuator import LinearSystem, draw_gamma, simulate

#: Standard errors allowed: exceeded once in a million draws, and the seed is fixed.
SIGMAS = 5.0


def inputs_seen(rate, faults, T):
    """Build a plant whose measurement is the effective input, gamma * u, without noise."""
    q = len(rate)
    return LinearSystem(
        A=np.zeros((T, 1, 1)),
        B=np.zeros((T, 1, q)),
        C=np.zeros((T, q, 1)),
        D=np.broadcast_to(np.eye(q), (T, q, q)),
        Q=np.zeros((T, 1, 1)),
        R=np.zeros((T, q, q)),
        x0=np.zeros(1),
        P0=np.zeros((1, 1)),
        rate=np.broadcast_to(rate, (T, q)),
        fault_covariance=np.broadcast_to(faults, (T, q, q)),
    )


CASES = {
    "common": ([0.7, 0.7], 0.21 * np.ones((2, 2)), True),
    "independent": ([0.7, 0.2, 0.5], np.diag([0.21, 0.16, 0.25]), True),
    "two correlated": ([0.7, 0.4], np.array([[0.21, 0.1], [0.1, 0.24]]), True),
    "as correlated as can be": ([0.5, 0.4], np.array([[0.25, -0.2], [-0.2, 0.24]]), True),
    "three correlated": ([0.5] * 3, 0.15 * np.eye(3) + 0.1, False),
}


@pytest.mark.parametrize(("rate", "faults", "binary"), CASES.values(), ids=CASES)
def test_gamma_has_its_mean_and_covariance(rate, faults, binary):
    T = 40_000
    system = inputs_seen(rate, faults, T)
    seen = simulate(system, np.ones((T, len(rate))), np.random.default_rng(1))
    if binary:
        assert set(np.unique(seen)) == {0.0, 1.0}
    deviation = np.sqrt(np.diag(faults))
    assert np.all(np.abs(seen.mean(axis=0) - rate) < SIGMAS * deviation / np.sqrt(T))
    centred = seen - rate
    products = centred[:, :, None] * centred[:, None, :]
    errors = np.abs(products.mean(axis=0) - faults)
    # A product that is constant (rate 1/2 gives 1/4 always) has no spread; rounding remains.
    assert np.all(errors <= SIGMAS * products.std(axis=0) / np.sqrt(T) + 1e-12)


def test_a_common_fault_strikes_all_inputs_at_once():
    seen = simulate(
        inputs_seen(*CASES["common"][:2], 100), np.ones((100, 2)), np.random.default_rng(2)
    )
    np.testing.assert_array_equal(seen[:, 0], seen[:, 1])


def test_without_faults_every_input_arrives():
    system = inputs_seen([1.0, 1.0], np.zeros((2, 2)), 5)
    u = np.arange(10.0).reshape(5, 2)
    np.testing.assert_array_equal(simulate(system, u, np.random.default_rng(3)), u)


def test_rates_may_change_from_sample_to_sample():
    T = 2000
    rate = np.where(np.arange(T) % 2, 1.0, 0.25)[:, None]
    system = LinearSystem(
        **{
            **vars(inputs_seen([0.5], np.eye(1), T)),
            "rate": rate,
            "fault_covariance": (rate * (1.0 - rate))[:, :, None],
        }
    )
    gamma = draw_gamma(system, np.random.default_rng(4))
    assert np.all(gamma[1::2] == 1.0)
    # Standard error sqrt(.1875 / 1000) = 0.0137, five of them.
    assert gamma[::2].mean() == pytest.approx(0.25, abs=0.07)


@pytest.mark.exhaustive
def test_records_have_the_joint_mean_and_covariance():
    rng = np.random.default_rng(5)
    T, n, p, runs = 3, 2, 2, 6000
    system = LinearSystem(
        A=rng.standard_normal((T, n, n)),
        B=rng.standard_normal((T, n, 1)),
        C=rng.standard_normal((T, p, n)),
        D=rng.standard_normal((T, p, 1)),
        Q=np.broadcast_to([[1.0, 0.5], [0.5, 2.0]], (T, n, n)),
        R=np.broadcast_to([[0.3, -0.1], [-0.1, 0.2]], (T, p, p)),
        x0=np.array([1.0, -2.0]),
        P0=np.array([[1.0, 0.9], [0.9, 1.0]]),
        rate=np.full((T, 1), 0.6),
        fault_covariance=np.full((T, 1, 1), 0.24),
    )
    u = 3.0 * np.ones((T, 1))
    joint = joint_distribution(system, u)
    root = joint.measurement_root.reshape(T * p, -1)
    records = np.array([simulate(system, u, rng).ravel() for _ in range(runs)])
    whitened = np.linalg.solve(
        np.linalg.cholesky(root @ root.T), (records - joint.measurement_mean.ravel()).T
    )
    # Means of unit variance, and products of a variance of about 2 (1 off the diagonal).
    assert np.abs(whitened.mean(axis=1)).max() < SIGMAS / np.sqrt(runs)
    assert np.abs(whitened @ whitened.T / runs - np.eye(T * p)).max() < SIGMAS * np.sqrt(2.0 / runs)


def test_entries_go_missing_at_the_rate_asked_for():
    T = 4000
    system = inputs_seen([0.5, 0.5], 0.25 * np.eye(2), T)
    y = simulate(system, np.ones((T, 2)), np.random.default_rng(6), missing=0.2)
    # Standard error sqrt(.16 / 8000) = 0.0045, five of them.
    assert np.isnan(y).mean() == pytest.approx(0.2, abs=0.023)
    assert not np.isnan(simulate(system, np.ones((T, 2)), np.random.default_rng(6))).any()


def test_importing_the_closed_forms_loads_none_of_the_slow_libraries():
    slow = "{'casadi', 'control', 'sympy', 'scipy'}"
    program = f"import sys, fkgen.oracle; print(sorted({slow} & set(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"
