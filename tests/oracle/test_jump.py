"""Oracles of jumping plants against each other, printed numbers, and what theory says of limits."""

from __future__ import annotations

import itertools
from dataclasses import fields

import numpy as np
import pytest
from jump_plants import (
    EXAMPLE_A,
    EXAMPLE_B,
    EXAMPLE_S,
    EXAMPLE_U,
    GILBERT,
    believed,
    filtered,
    random_table,
    record_of,
    spec_of,
    textbook_of,
)
from plants import distance, run

from fkgen.faults.chain import mean_square_radius
from fkgen.oracle.exact.paths import enumerate_paths
from fkgen.oracle.plants.jump import JumpSystem, simulate_jumps
from fkgen.oracle.textbook.jump import composite, stationary_jumps, textbook_jumps

ESTIMATES = (
    *("filtered_state", "filtered_covariance", "predicted_state", "predicted_covariance"),
    *("innovation", "innovation_covariance"),
)
OFFSETS = random_table(31, 2, 2, 1, offsets=True)


def position(matrix):
    """Variance of the position, from a covariance over (x, 1) 1{mode} with three modes."""
    E = np.tile(np.eye(3, 4), 3)
    return (E @ matrix @ E.T)[0, 0]


def at_rest(plant, rate=1.0):
    found = stationary_jumps(JumpSystem.from_spec(spec_of(plant), 1), rate)
    assert found is not None
    return found


@pytest.mark.parametrize("plant", [OFFSETS, random_table(32, 3, 2, 2, q=1, correlated=True)])
@pytest.mark.parametrize("channel", [{}, {"arrival_rate": 0.6}])
def test_whole_matrices_are_projections_over_all_paths(plant, channel):
    spec = spec_of(plant, **channel)
    y, u = record_of(spec, 5, missing=0.2)
    system = believed(spec, 5)
    paths, matrices = enumerate_paths(system, y, u), textbook_jumps(system, y, u)
    for field in fields(paths):
        assert distance(getattr(matrices, field.name), getattr(paths, field.name)) < 1e-11


def test_a_markov_gamma_is_a_mode_like_any_other():
    spec = spec_of(OFFSETS, arrival_chain=GILBERT)
    y, u = record_of(spec, 5, missing=0.2)
    paths = enumerate_paths(believed(spec, 5), y, u)
    again = enumerate_paths(composite(believed(spec, 5)), y, u)
    for name in (*ESTIMATES, "nis", "log_likelihood"):
        assert distance(getattr(again, name), getattr(paths, name)) < 1e-11


def test_paths_are_those_of_ordinary_gaussian_conditioning():
    """By hand: means and covariances given each path of (mode, gamma), mixed, then projected."""
    spec = spec_of(random_table(33, 2, 1, 1, offsets=True), arrival_rate=0.7)
    system, T = believed(spec, 3), 3
    y, u = record_of(spec, T)
    mean, second = np.zeros(2 * T + 1), np.zeros((2 * T + 1, 2 * T + 1))
    for modes in itertools.product(range(2), repeat=T):
        for gamma in itertools.product((0, 1), repeat=T):
            chance = np.prod([0.7 if g else 0.3 for g in gamma]) * system.initial[modes[0]]
            chance *= np.prod([system.transition[i, j] for i, j in itertools.pairwise(modes)])
            m, S = given_path(system, modes, gamma)
            mean += chance * m
            second += chance * (S + np.outer(m, m))
    joint = second - np.outer(mean, mean)
    found = enumerate_paths(system, y, u)
    for k in range(T):
        seen = np.arange(T + 1, T + 2 + k)
        gain = joint[k, seen] @ np.linalg.inv(joint[np.ix_(seen, seen)])
        x = mean[k] + gain @ (y[: k + 1, 0] - mean[seen])
        P = joint[k, k] - gain @ joint[seen, k]
        assert found.filtered_state[k, 0] == pytest.approx(x, rel=1e-12)
        assert found.filtered_covariance[k, 0, 0] == pytest.approx(P, rel=1e-12)


def given_path(system, modes, gamma):
    """Mean and covariance of (x[0..T], y[0..T-1]) of a scalar plant on one path."""
    T = len(modes)
    M, b = np.zeros((2 * T + 1, 2 * T + 1)), np.zeros(2 * T + 1)  # of (x0 - mean, w, v)
    M[0, 0], b[0] = 1.0, system.x0[0]
    noise = [system.P0[0, 0]]
    for k, i in enumerate(modes):
        a = system.A[k, i, 0, 0]
        M[k + 1], b[k + 1] = a * M[k], a * b[k] + system.c[k, i, 0]
        M[k + 1, k + 1] = 1.0
        M[T + 1 + k] = gamma[k] * system.C[k, i, 0, 0] * M[k]
        b[T + 1 + k] = gamma[k] * system.C[k, i, 0, 0] * b[k]
        M[T + 1 + k, T + 1 + k] += 1.0
        noise.append(system.Q[k, i, 0, 0])
    noise += [system.R[k, i, 0, 0] for k, i in enumerate(modes)]
    return b, M @ np.diag(noise) @ M.T


def test_the_printed_stationary_numbers_of_example_A():
    found = at_rest(EXAMPLE_A)
    jump = EXAMPLE_A["faults"]["jump"]
    radius = mean_square_radius(jump["transition"], [np.array(m["A"]) for m in jump["modes"]])
    assert radius == pytest.approx(0.97**2, rel=1e-12)
    assert found.closed_loop_radius == pytest.approx(0.885367, abs=5e-7)
    law = found.split.now[3::4, 3::4].diagonal()
    np.testing.assert_allclose(law, [0.478873, 0.338028, 0.183099], atol=5e-7)
    z = np.arange(12) % 4 < 3
    assert np.trace(found.covariance[np.ix_(z, z)]) == pytest.approx(1519.995342, abs=5e-7)
    J1, J0 = found.expected_squares
    assert found.innovation_covariance[0, 0] == pytest.approx(3.868801, abs=5e-7)
    assert pytest.approx(3.868801, abs=5e-7) == J1
    assert pytest.approx(2350.534333, abs=5e-7) == J0
    assert found.split.R[0, 0] == pytest.approx(1.228873, abs=5e-7)
    assert found.split.signal[0, 0] == pytest.approx(2351.945388, abs=5e-7)
    assert position(found.covariance) == pytest.approx(2.639928, abs=5e-7)
    assert position(found.filtered) == pytest.approx(0.838538, abs=5e-7)


def test_the_printed_numbers_where_only_the_rate_is_known():
    found = at_rest(EXAMPLE_A, 0.85)
    assert found.innovation_covariance[0, 0] == pytest.approx(387.165695, abs=5e-7)
    assert position(found.covariance) == pytest.approx(119.119425, abs=5e-7)
    assert position(found.filtered) == pytest.approx(92.640146, abs=5e-7)


@pytest.mark.parametrize("rate", [1.0, 0.85])
@pytest.mark.parametrize("plant", [EXAMPLE_A, EXAMPLE_B, EXAMPLE_S], ids=["A", "B", "S"])
def test_the_recursion_comes_to_the_riccati_solution(plant, rate):
    channel = {} if rate == 1.0 else {"arrival_rate": rate}
    y = np.zeros((800, 1))
    found = run(spec_of(plant, **channel), y)
    stationary = run(spec_of(plant, gain="stationary", **channel), y)
    assert distance(found.predicted_covariance[-1], stationary.predicted_covariance[-1]) < 1e-8
    assert distance(found.filtered_covariance[-1], stationary.filtered_covariance[-1]) < 1e-8
    assert distance(found.innovation_covariance[-1], stationary.innovation_covariance[-1]) < 1e-8


def test_the_gap_to_the_riccati_solution_closes_as_printed():
    """The two starts of the criterion: the prior of the example, and one of a thousand."""
    n = 4 * np.arange(3)[:, None] + np.arange(3)
    z = np.ix_(n.ravel(), n.ravel())
    limit = at_rest(EXAMPLE_A).covariance[z]
    for k, gap in ((10, 500.0), (100, 5.359), (200, 1.26e-2)):
        assert np.abs(covariance_after(k) - limit).max() == pytest.approx(gap, rel=5e-3)
    large = {"model": {"P0": (1000 * np.eye(3)).tolist()}}
    assert np.abs(covariance_after(700, **large) - limit).max() < 1e-8 * np.abs(limit).max()


def covariance_after(samples, **change):
    """Covariance of z[k] given y[0..k-1] of example A, from that of the filter's coordinates."""
    found = filtered(EXAMPLE_A, np.zeros((samples, 1)), **change)
    X = found["augmented_covariance"][-1]
    T = np.eye(9)
    T[6:, :6] = -np.tile(np.eye(3), 2)  # the last part is x less the others
    return T @ X @ T.T


def test_random_losses_lie_between_riccati_and_prior():
    """DARE <= E X <= MARE <= prior for the position; E X from 300 records of known losses."""
    from plants import built

    spec = spec_of(EXAMPLE_A, arrival="known", arrival_rate=0.6)
    rng = np.random.default_rng(1)
    y = np.where(rng.random((300, 400, 1)) < 0.6, 0.0, np.nan)
    keep = ["predicted_covariance"]
    random = built(spec).run_batch(y, keep=keep).predicted_covariance[:, -1, 0, 0]
    blind = run(spec, np.full((400, 1), np.nan)).predicted_covariance[-1, 0, 0]
    lossless = run(spec, np.zeros((400, 1))).predicted_covariance[-1, 0, 0]
    error = random.std() / np.sqrt(len(random))
    mare = modified_riccati(0.6)
    assert lossless == pytest.approx(2.6399, abs=1e-4)
    assert random.mean() == pytest.approx(8.2290, abs=4 * error)
    assert mare == pytest.approx(8.9942, abs=1e-4)
    assert lossless < random.mean() + 4 * error
    assert random.mean() - 4 * error < mare < blind


def modified_riccati(rate):
    """The recursion with the rate in front of the correction, at rest: variance of the position."""
    found = at_rest(EXAMPLE_A)
    F, L, R, W = found.split.F, found.split.L, found.split.R, found.split.noise
    X = found.covariance
    for _ in range(600):
        K = X @ L.T @ np.linalg.inv(L @ X @ L.T + R)
        X = F @ (X - rate * K @ L @ X) @ F.T + W
    return position(X)


def test_a_plant_that_is_not_mean_square_stable_has_no_limit_but_a_filter():
    y, _ = record_of(spec_of(EXAMPLE_U), 60)
    spec = spec_of(EXAMPLE_U)
    found, expected = run(spec, y), textbook_of(spec, y, np.zeros((60, 0)))
    for name in ESTIMATES:
        assert distance(found[name], getattr(expected, name)) < 1e-9


def test_the_unmeasured_error_of_an_unstable_plant_grows_as_printed():
    plant = {
        "name": "unstable",
        "model": {
            "A": [[1.02, 0.1], [0, 1.01]],
            "C": [[1.0, 0.0]],
            "Q": [[0.01, 0], [0, 0.01]],
            "R": [[1.0]],
            "x0": [0.0, 0.0],
            "P0": [[1.0, 0.0], [0.0, 1.0]],
        },
        "faults": {
            "jump": {
                "transition": [[0.9, 0.1], [0.2, 0.8]],
                "initial": [0.5, 0.5],
                "modes": [{}, {"A": [[0.95, -0.2], [0.1, 0.9]]}],
            }
        },
        "filter": {"family": "mjls_lmmse"},
    }
    jump = spec_of(plant).faults.jump
    radius = mean_square_radius(jump.transition, [mode.A.values() for mode in jump.modes])
    assert radius == pytest.approx(1.0355, abs=5e-5)
    y = np.zeros((401, 1))
    variance = filtered(plant, y)["filtered_covariance"][:, 1, 1]
    for k, printed in ((10, 0.64), (200, 39.4), (400, 4.2e4)):
        assert variance[k] == pytest.approx(printed, rel=0.01)


def test_a_simulated_record_has_the_moments_of_its_plant():
    """Mean and variance of y at sample 3 over 4000 records, four standard errors."""
    spec = spec_of(EXAMPLE_S, arrival_rate=0.7)
    system = JumpSystem.from_spec(spec, 4)
    rng = np.random.default_rng(2)
    y = np.array([simulate_jumps(system, np.zeros((4, 0)), rng).y[3, 0] for _ in range(4000)])
    blind = enumerate_paths(system, np.full((4, 1), np.nan), np.zeros((4, 0)))
    variance, expected = blind.innovation_covariance[3, 0, 0], 0.7 * blind.filtered_state[3, 0]
    assert y.mean() == pytest.approx(expected, abs=4 * np.sqrt(variance / len(y)))
    spread = (y - expected) ** 2
    assert spread.mean() == pytest.approx(variance, abs=4 * spread.std() / np.sqrt(len(y)))
