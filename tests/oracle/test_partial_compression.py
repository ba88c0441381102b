"""Theorem 4 from primitive noises against its printed matrices, batch estimates and numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from plants import covariance
from theorem_4 import Theorem4

from fkgen.faults.partial_state import measured_states, similarity
from fkgen.oracle.exact.batch import batch_lmmse
from fkgen.oracle.exact.partial_compression import PartialCompression, partial_compression
from fkgen.oracle.plants.actuator import LinearSystem, simulate
from fkgen.oracle.theorems.compression import PARTIAL_IDENTITIES

#: Random well-conditioned problems of a dozen samples.
ROUNDING = 1e-10

PORTS = ("state", "covariance")


@pytest.mark.parametrize("identity", PARTIAL_IDENTITIES, ids=lambda each: each.claim)
def test_identity(identity):
    assert identity.holds()


def problem(seed, n, m, hosts=1, T=12, *, window=5, maintenance="optimal", false_alarm=None):
    """Time-varying, F11 != I, phi changing, G with n rows; the compression rows come last."""
    rng = np.random.default_rng(seed)
    C = rng.standard_normal((T, hosts + m, n))
    phi = np.eye(m) + 0.4 * rng.standard_normal((T, m, m))
    C[:, hosts:] = phi @ C[0, hosts:]
    R = np.zeros((T, hosts + m, hosts + m))
    for k in range(T):
        R[k, :hosts, :hosts] = covariance(rng, hosts)
        R[k, hosts:, hosts:] = covariance(rng, m)
    system = LinearSystem(
        A=rng.standard_normal((T, n, n)) / np.sqrt(n),
        B=rng.standard_normal((T, n, 1)),
        C=C,
        D=rng.standard_normal((T, hosts + m, 1)),
        Q=np.array([covariance(rng, n) for _ in range(T)]),
        R=R,
        x0=rng.standard_normal(n),
        P0=covariance(rng, n),
        rate=np.ones((T, 1)),
        fault_covariance=np.zeros((T, 1, 1)),
    )
    design = PartialCompression(
        host=tuple(range(hosts)),
        T=similarity(C[0, hosts:], np.ones(n)),
        window=window,
        first=window,
        false_alarm=false_alarm,
        maintenance=maintenance,
    )
    u = rng.standard_normal((T, 1))
    y = simulate(system, u, rng)
    y[rng.random(T) < 0.3, :hosts] = np.nan
    y[rng.random(T) < 0.3, hosts:] = np.nan
    return system, design, y, u


def printed(system, design, y, u, accepted):
    """The printed equations in the coordinates of (39), sample by sample."""
    T, back = design.T, np.linalg.inv(design.T)
    hosts = list(design.host)
    others = [i for i in range(system.ny) if i not in hosts]
    m = len(others)
    filters = Theorem4(T @ system.x0, T @ system.P0 @ T.T, m, maintenance=design.maintenance)
    rows = []
    for k in range(len(y)):
        C, free = system.C[k] @ back, y[k] - system.D[k] @ u[k]
        if not np.isnan(y[k, hosts]).any():
            filters.host(C[hosts], system.R[k][np.ix_(hosts, hosts)], free[hosts])
        if not np.isnan(y[k, others]).any():
            filters.compress(C[others, :m], system.R[k][np.ix_(others, others)], free[others])
        row = {"Z": filters.Z, "R": filters.R, "S": filters.S @ back.T, "zeta": 0.0}
        if k and k % design.window == 0 and filters.alive:
            row["zeta"] = filters.statistic()
            if accepted[k]:
                filters.update()
            filters.discard()
        row |= {"x": back @ filters.x, "P": back @ filters.P @ back.T}
        rows.append(row)
        filters.propagate(T @ system.A[k] @ back, T @ system.Q[k] @ T.T)
        filters.x = filters.x + T @ system.B[k] @ u[k]
    return filters, rows


@pytest.mark.parametrize("maintenance", ["optimal", "paper"])
@pytest.mark.parametrize(
    ("n", "m", "hosts"), [(2, 1, 1), (3, 1, 2), (3, 2, 1), (4, 2, 2), (2, 2, 1)]
)
def test_errors_made_of_primitive_noises_have_the_moments_of_theorem_4(n, m, hosts, maintenance):
    for seed in range(6):
        given = problem(seed, n, m, hosts, maintenance=maintenance, false_alarm=0.4)
        found = partial_compression(*given)
        filters, rows = printed(*given, accepted=found.fault_declared == 0.0)
        # The printed equations invert matrices: an inverse loses as many digits as its condition
        # number has. A hundred roundings of that size; what is well conditioned, 1e-11.
        allowed = max(1e-11, 100.0 * np.finfo(float).eps * filters.condition)
        for name, port in {
            "x": "filtered_state",
            "P": "filtered_covariance",
            "Z": "compressed_measurement",
            "R": "compressed_noise",
            "S": "compressed_cross_covariance",
            "zeta": "test_statistic",
        }.items():
            expected = np.array([row[name] for row in rows])
            error = np.abs(np.nan_to_num(getattr(found, port)) - expected).max()
            assert error < allowed * max(1.0, np.abs(expected).max()), name


def test_some_windows_of_the_random_problems_are_rejected_and_some_accepted():
    declared = [
        partial_compression(*problem(s, 3, 1, 2, false_alarm=0.4)).fault_declared[5::5]
        for s in range(6)
    ]
    assert 2 <= np.sum(declared) <= 10


def test_one_compression_measurement_with_optimal_maintenance_loses_nothing():
    system, design, y, u = problem(3, 3, 1, window=4)
    y[:] = np.where(np.isnan(y), 0.3, y)
    y[:, 1] = np.nan
    y[1, 1] = 0.7
    found = partial_compression(system, design, y, u)
    best = batch_lmmse(system, y, u)
    for port in PORTS:
        error = getattr(found, f"filtered_{port}") - getattr(best, f"filtered_{port}")
        assert np.abs(error[4:]).max() < ROUNDING
    printed_form = partial_compression(system, replace(design, maintenance="paper"), y, u)
    excess = printed_form.filtered_covariance[4:] - best.filtered_covariance[4:]
    assert np.trace(excess[0]) > 1e-4


def test_without_a_window_between_the_update_is_that_of_a_kalman_filter():
    system, design, y, u = problem(4, 3, 2, window=1)
    y[0, 1:] = np.nan
    found, best = partial_compression(system, design, y, u), batch_lmmse(system, y, u)
    for port in PORTS:
        error = getattr(found, f"filtered_{port}") - getattr(best, f"filtered_{port}")
        assert np.abs(error).max() < ROUNDING


@pytest.mark.parametrize("maintenance", ["optimal", "paper"])
def test_the_compressed_measurement_is_no_worse_than_the_last_raw_one(maintenance):
    for seed in range(20):
        system, design, y, u = problem(seed, 3, 2, window=6, maintenance=maintenance)
        y[6] = 0.1
        found, best = partial_compression(system, design, y, u), batch_lmmse(system, y, u)
        phi = np.linalg.lstsq(design.T[:2].T, system.C[6, 1:].T, rcond=None)[0].T
        raw = np.linalg.inv(phi) @ system.R[6, 1:, 1:] @ np.linalg.inv(phi).T
        R, P = found.compressed_noise[6], found.filtered_covariance[6]
        first = design.T[:2] @ P @ design.T[:2].T
        assert np.linalg.eigvalsh(R - first)[0] > -ROUNDING
        assert np.linalg.eigvalsh(raw - R)[0] > -ROUNDING
        assert np.linalg.eigvalsh(P - best.filtered_covariance[6])[0] > -ROUNDING


def walk(T, q, r):
    """A random walk with prior variance 1."""
    one = np.ones((T, 1, 1))
    return LinearSystem(
        A=one, B=np.zeros((T, 1, 0)), C=one, D=np.zeros((T, 1, 0)), Q=q * one, R=r * one,
        x0=np.zeros(1), P0=np.eye(1), rate=np.zeros((T, 0)), fault_covariance=np.zeros((T, 0, 0)),
    )  # fmt: skip


def test_the_claim_of_theorem_4_fails_beside_a_prior():
    # Worse than the host with the last raw measurement.
    system = walk(2, 100.0, 1000.0)
    design = PartialCompression(
        host=(), T=np.eye(1), window=1, first=1, false_alarm=None, maintenance="optimal"
    )
    y = np.zeros((2, 1))
    found = partial_compression(system, design, y, None)
    assert found.compressed_noise[1, 0, 0] == pytest.approx(523.809524, abs=1e-6)
    assert found.compressed_cross_covariance[1, 0, 0] == pytest.approx(-47.619048, abs=1e-6)
    assert found.filtered_covariance[1, 0, 0] == pytest.approx(95.619184640, abs=1e-6)
    last = batch_lmmse(system, np.array([[np.nan], [0.0]]), None).filtered_covariance[1, 0, 0]
    assert last == pytest.approx(91.734786558, abs=1e-6)
    both = batch_lmmse(system, y, None).filtered_covariance[1, 0, 0]
    assert both == pytest.approx(91.733962435, abs=1e-6)


def test_rows_of_the_group_may_begin_one_by_one():
    """Both have begun when the window ends, and what is reported is what the estimate is worth."""
    system, design, y, u = problem(5, 4, 2, window=4)
    y[:, 1:] = np.nan
    y[1, 1], y[3, 2] = 0.4, -0.2
    found, best = partial_compression(system, design, y, u), batch_lmmse(system, y, u)
    assert found.test_dof[4] == 2.0
    worse = found.filtered_covariance[4] - best.filtered_covariance[4]
    assert np.linalg.eigvalsh(worse)[0] > -ROUNDING
    y[3, 2] = np.nan
    assert partial_compression(system, design, y, u).test_dof[4] == 1.0


def test_a_similarity_transformation_is_found_for_any_independent_rows():
    rng = np.random.default_rng(6)
    for m, n in [(1, 1), (1, 3), (2, 3), (3, 5), (4, 4)]:
        for scale in (1.0, 10.0 ** rng.uniform(-6, 6, n)):
            C1 = rng.standard_normal((m, n)) * scale
            T = similarity(C1, 1.0 / (np.ones(n) * scale))
            assert np.linalg.matrix_rank(T / np.abs(T).max(axis=0)) == n
            form = C1 @ np.linalg.inv(T)
            phi = np.linalg.norm(form[:, :m], axis=0)
            np.testing.assert_allclose(form[:, m:], 0.0, atol=1e-9 * phi.max())
            assert np.linalg.matrix_rank(form[:, :m] / phi) == m


def test_rows_that_measure_some_states_alone_make_a_permutation():
    T = similarity(np.array([[0.0, 0.0, 3.0, 0.0], [5.0, 0.0, 1.0, 0.0]]), np.ones(4))
    np.testing.assert_array_equal(T, np.eye(4)[[0, 2, 1, 3]])
    rows = np.array([[2.0, 0.5, 0.0]])
    T = similarity(rows, np.ones(3))
    np.testing.assert_array_equal(T, [[2.0, 0.5, 0.0], [0, 1, 0], [0, 0, 1]])
    T = similarity(rows, np.array([1.0, 9.0, 1.0]))
    np.testing.assert_array_equal(T, [[2.0, 0.5, 0.0], [1, 0, 0], [0, 0, 1]])


def test_the_measured_states_are_those_that_contribute_most():
    def found(rows, deviation=None):
        rows = np.array(rows)
        return measured_states(rows, np.ones(rows.shape[1]) if deviation is None else deviation)

    assert found([[0.0, 2.0, 0.0]]) == (1,)
    assert found([[1.0, 2.0, 0.0], [2.0, 4.0, 1.0]]) == (1, 2)
    assert found([[0.0, 0.0, 3.0], [0.0, 1.0, 0.0]]) == (1, 2)
    assert found([[1.0, 2.0], [2.0, 4.0]]) == (1,)
    assert found([[1.0, 2.0]], np.array([3.0, 1.0])) == (0,)
    assert found([[0.0, 0.0]]) == ()
