"""The batch estimate against hand-written predictors, enumeration and extended precision."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from fkgen.errors import DataError
from fkgen.oracle.exact.batch import batch_lmmse, joint_distribution
from fkgen.oracle.plants.actuator import LinearSystem, simulate

# Two double-precision solutions of well-conditioned problems differ by rounding, some 1e-13.
ROUNDING = 1e-9


def covariances(rng, count, size):
    root = rng.standard_normal((count, size, size))
    return root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(size)


def random_system(rng, *, T, n, p, q, dependence="independent"):
    rate = rng.uniform(0.1, 0.9, (T, q))
    if dependence == "common":
        rate[:] = rate[:, :1]
    variance = rate * (1.0 - rate)
    faults = np.einsum("ki,ij->kij", variance, np.eye(q))
    if dependence == "common":
        faults = variance[:, :, None] * np.ones(q)
    if dependence == "correlated":
        deviation = np.sqrt(variance)
        faults = faults + 0.3 * (1.0 - np.eye(q)) * deviation[:, :, None] * deviation[:, None, :]
    return LinearSystem(
        A=rng.standard_normal((T, n, n)) / np.sqrt(n),
        B=rng.standard_normal((T, n, q)),
        C=rng.standard_normal((T, p, n)),
        D=rng.standard_normal((T, p, q)),
        Q=covariances(rng, T, n),
        R=covariances(rng, T, p),
        x0=rng.standard_normal(n),
        P0=covariances(rng, 1, n)[0],
        rate=rate,
        fault_covariance=faults,
    )


def predictor(system, y, u, *, dtype=np.float64):
    """Yield eq. (4), (11), (12), (15) and the filtered estimate, sample by sample."""
    x, P = system.x0.astype(dtype), system.P0.astype(dtype)
    for k in range(system.length):
        rows = np.isfinite(y[k])
        A, B, Q = (m[k].astype(dtype) for m in (system.A, system.B, system.Q))
        C, D, R = system.C[k][rows], system.D[k][rows], system.R[k][rows][:, rows]
        N = system.fault_covariance[k] * np.outer(u[k], u[k]).astype(dtype)
        Om = C @ P @ C.T + D @ N @ D.T + R
        # NumPy inverts in double precision only; a scalar needs no routine.
        inverse = 1.0 / Om if Om.shape == (1, 1) else np.linalg.inv(Om)
        driven = system.rate[k] * u[k]
        nu = y[k][rows] - C @ x - D @ driven
        nis = float(nu @ inverse @ nu)
        log = (
            -0.5 * (nis + np.linalg.slogdet(2.0 * np.pi * Om.astype(float))[1]) if nu.size else 0.0
        )
        L, M = A @ P @ C.T + B @ N @ D.T, P @ C.T
        filtered = x + M @ inverse @ nu, P - M @ inverse @ M.T
        x = A @ x + B @ driven + L @ inverse @ nu
        F, G = A - L @ inverse @ C, B - L @ inverse @ D
        P = F @ P @ F.T + G @ N @ G.T + Q + L @ inverse @ R @ inverse @ L.T
        yield filtered, (x, P), (nu, Om), (nis, log)


def worst(actual, expected):
    if not np.size(expected):
        return 0.0
    return float(np.abs(actual - expected).max() / max(np.abs(expected).max(), 1e-300))


def disagreement(result, system, y, u, **options):
    """Return the largest relative difference between a batch result and the predictor."""
    errors = []
    for k, (filtered, predicted, innovation, scalars) in enumerate(
        predictor(system, y, u, **options)
    ):
        rows = np.isfinite(y[k])
        errors += [
            worst(result.filtered_state[k], filtered[0]),
            worst(result.filtered_covariance[k], filtered[1]),
            worst(result.predicted_state[k], predicted[0]),
            worst(result.predicted_covariance[k], predicted[1]),
            worst(result.innovation[k][rows], innovation[0]),
            worst(result.innovation_covariance[k][rows][:, rows], innovation[1]),
            abs(result.nis[k] - scalars[0]) / max(1.0, abs(scalars[0])),
            abs(result.log_likelihood[k] - scalars[1]) / max(1.0, abs(scalars[1])),
        ]
    return max(errors)


@pytest.mark.parametrize("missing", [0.0, 0.3])
@pytest.mark.parametrize(
    ("n", "p", "q", "dependence"),
    [
        (1, 1, 1, "common"),
        (2, 1, 1, "common"),
        (3, 2, 0, "independent"),
        (2, 2, 2, "common"),
        (3, 2, 2, "correlated"),
        (4, 3, 3, "independent"),
        (15, 6, 2, "independent"),
    ],
)
def test_batch_equals_the_hand_written_predictor(n, p, q, dependence, missing):
    rng = np.random.default_rng(7 * n + p + q)
    system = random_system(rng, T=8, n=n, p=p, q=q, dependence=dependence)
    u = 3.0 * rng.standard_normal((8, q))
    y = simulate(system, u, rng, missing=missing)
    assert disagreement(batch_lmmse(system, y, u), system, y, u) < ROUNDING


@pytest.mark.parametrize("name", ["Q", "R", "P0", "fault_covariance", "rate", "D"])
def test_an_error_of_a_thousandth_is_seen(name):
    rng = np.random.default_rng(3)
    system = random_system(rng, T=6, n=2, p=2, q=2)
    u = rng.standard_normal((6, 2))
    y = simulate(system, u, rng)
    wrong = replace(system, **{name: 1.001 * getattr(system, name)})
    # A thousandth of one ingredient moves some port by more than a millionth.
    assert disagreement(batch_lmmse(system, y, u), wrong, y, u) > 1e-6


def test_independent_noise_in_the_two_lines_is_not_the_same_fault():
    rng = np.random.default_rng(4)
    system = random_system(rng, T=4, n=2, p=1, q=1)
    u = np.ones((4, 1))
    y = simulate(system, u, rng)
    B, D, faults = system.B, system.D, system.fault_covariance
    apart = replace(
        system,
        Q=system.Q + B @ faults @ np.swapaxes(B, 1, 2),
        R=system.R + D @ faults @ np.swapaxes(D, 1, 2),
        fault_covariance=0.0 * faults,
    )
    # The cross covariance B N D' matters at the order of the covariances themselves.
    assert disagreement(batch_lmmse(system, y, u), apart, y, u) > 1e-2


def test_missing_rows_act_as_if_they_did_not_exist():
    rng = np.random.default_rng(5)
    system = random_system(rng, T=6, n=3, p=3, q=1)
    u = rng.standard_normal((6, 1))
    y = simulate(system, u, rng)
    y[:, 1] = np.nan
    kept = [0, 2]
    without = replace(
        system,
        C=system.C[:, kept],
        D=system.D[:, kept],
        d=system.d[:, kept],
        R=system.R[:, kept][:, :, kept],
    )
    gappy, short = batch_lmmse(system, y, u), batch_lmmse(without, y[:, kept], u)
    for port in (
        "filtered_state",
        "filtered_covariance",
        "predicted_state",
        "nis",
        "log_likelihood",
    ):
        # The same numbers enter in the same order: only the size of the factorisation differs.
        np.testing.assert_allclose(
            getattr(gappy, port), getattr(short, port), rtol=1e-12, atol=1e-12
        )
    assert np.isnan(gappy.innovation[:, 1]).all()
    np.testing.assert_allclose(gappy.innovation[:, kept], short.innovation, rtol=0, atol=1e-12)
    assert np.isfinite(gappy.innovation_covariance).all()


def test_a_record_without_measurements_leaves_the_prior_moments():
    rng = np.random.default_rng(6)
    system = random_system(rng, T=3, n=2, p=1, q=1)
    u = np.ones((3, 1))
    result = batch_lmmse(system, np.full((3, 1), np.nan), u)
    joint = joint_distribution(system, u)
    np.testing.assert_array_equal(result.predicted_state, joint.state_mean[1:])
    np.testing.assert_array_equal(result.nis, 0.0)
    np.testing.assert_array_equal(result.log_likelihood, 0.0)


def test_joint_moments_equal_an_enumeration_of_all_fault_histories():
    rng = np.random.default_rng(8)
    system = random_system(rng, T=4, n=1, p=1, q=1)
    u = rng.standard_normal((4, 1))
    means, weights = [], []
    for history in product((0.0, 1.0), repeat=4):
        x, stack = system.x0, []
        for k, works in enumerate(history):
            stack.append(system.C[k] @ x + works * system.D[k] @ u[k])
            x = system.A[k] @ x + works * system.B[k] @ u[k]
        means.append(np.concatenate([*stack, x]))
        weights.append(
            np.prod([r[0] if g else 1.0 - r[0] for r, g in zip(system.rate, history, strict=True)])
        )
    mean = np.array(weights) @ np.array(means)
    centred = np.array(means) - mean
    by_faults = np.einsum("h,hi,hj->ij", weights, centred, centred)
    joint = joint_distribution(system, u)
    calm = joint_distribution(replace(system, fault_covariance=0.0 * system.fault_covariance), u)

    def stacked(j):
        root = np.concatenate([j.measurement_root[:, 0], j.state_root[4]])
        return np.concatenate([j.measurement_mean[:, 0], j.state_mean[4]]), root @ root.T

    # Sixteen histories are summed: a few units of round-off.
    np.testing.assert_allclose(stacked(joint)[0], mean, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(
        stacked(joint)[1] - stacked(calm)[1],
        by_faults,
        rtol=1e-11,
        atol=1e-12 * np.abs(by_faults).max(),
    )


@pytest.mark.parametrize(
    ("prior", "noise", "gain"), [(1e8, 1e-4, 1.0), (1.0, 1e-2, 1e6), (1e-6, 1e4, 1e-3)]
)
def test_extreme_scales_keep_their_digits(prior, noise, gain):
    rng = np.random.default_rng(9)
    system = random_system(rng, T=10, n=2, p=1, q=1)
    system = replace(system, P0=prior * np.diag([1.0, 1e-6]), R=noise * system.R)
    u = gain * np.ones((10, 1))
    y = simulate(system, u, rng)
    # The judge computes in 64 bits of mantissa (scalar innovation); the condition number of the
    # root is at most 1e8, of which the double-precision batch may lose all but seven digits.
    assert disagreement(batch_lmmse(system, y, u), system, y, u, dtype=np.longdouble) < 1e-7


def test_a_measurement_given_twice_counts_once():
    rng = np.random.default_rng(10)
    system = random_system(rng, T=5, n=2, p=1, q=1)
    u = rng.standard_normal((5, 1))
    y = simulate(system, u, rng)
    twice = replace(
        system,
        C=np.repeat(system.C, 2, axis=1),
        D=np.repeat(system.D, 2, axis=1),
        d=np.repeat(system.d, 2, axis=1),
        R=np.repeat(np.repeat(system.R, 2, axis=1), 2, axis=2),
    )
    once, again = batch_lmmse(system, y, u), batch_lmmse(twice, np.repeat(y, 2, axis=1), u)
    # The singular direction is cut off exactly; what is left is rounding.
    np.testing.assert_allclose(again.filtered_state, once.filtered_state, rtol=ROUNDING)
    np.testing.assert_allclose(again.predicted_covariance, once.predicted_covariance, rtol=ROUNDING)
    np.testing.assert_allclose(again.nis, once.nis, rtol=ROUNDING)


def test_exact_measurements_and_no_noise_are_allowed():
    T = 6
    system = LinearSystem(
        A=np.broadcast_to([[1.0, 0.1], [0.0, 1.0]], (T, 2, 2)),
        B=np.zeros((T, 2, 0)),
        C=np.broadcast_to([[1.0, 0.0]], (T, 1, 2)),
        D=np.zeros((T, 1, 0)),
        Q=np.zeros((T, 2, 2)),
        R=np.zeros((T, 1, 1)),
        x0=np.zeros(2),
        P0=np.eye(2),
        rate=np.ones((T, 0)),
        fault_covariance=np.zeros((T, 0, 0)),
    )
    y = 3.0 + 0.1 * 2.0 * np.arange(T)[:, None]
    result = batch_lmmse(system, y, None)
    # Two samples determine position 3 and velocity 2; the third and later ones add nothing.
    np.testing.assert_allclose(result.filtered_state[1:, 1], 2.0, rtol=1e-12)
    np.testing.assert_allclose(result.filtered_covariance[1:], 0.0, atol=1e-12)
    np.testing.assert_allclose(result.nis[2:], 0.0, atol=1e-12)


def test_shapes_that_do_not_fit_are_refused():
    system = random_system(np.random.default_rng(12), T=3, n=2, p=1, q=1)
    with pytest.raises(DataError, match="R of a LinearSystem"):
        replace(system, R=np.ones((3, 1)))
    with pytest.raises(DataError, match="u: given shape"):
        batch_lmmse(system, np.zeros((3, 1)), None)
