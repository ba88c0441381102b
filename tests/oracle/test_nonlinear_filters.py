"""The nonlinear textbook filters where something else says what is right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from nonlinear_plants import FIELD, GRAVITY, attitude, rates, robot, swing, system, turn
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from fkgen.oracle.plants.manifold import wrapped
from fkgen.oracle.plants.nonlinear import simulate_nonlinear
from fkgen.oracle.textbook.nonlinear import Extended, Iterated, Unscented, lower_root
from fkgen.oracle.textbook.nonlinear_modes import (
    Modes,
    textbook_gpb1,
    textbook_interacting,
)
from fkgen.oracle.textbook.switching import Lumping

FILTERS = {
    "ekf": Extended,
    "iekf": Iterated,
    "ukf": Unscented,
    "ukf with a centre": lambda system: Unscented(system=system, kappa=1.0),
}
ESTIMATES = ("filtered_state", "predicted_state")
COVARIANCES = ("filtered_covariance", "predicted_covariance", "innovation_covariance")
SCALARS = ("nis", "log_likelihood")


def record(plant, seed=1, missing=0.2):
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(plant.length, plant.nu))
    y, x = simulate_nonlinear(plant, u, rng)
    y[rng.random(y.shape) < missing] = np.nan
    return y, u, x


def posterior_cost(plant, y, u):
    """Residuals of the maximum a posteriori at sample 0, in deviations, as a function of d."""
    used = np.isfinite(y)
    root = np.linalg.inv(np.linalg.cholesky(plant.R[0][np.ix_(used, used)]))
    prior = np.linalg.inv(np.linalg.cholesky(plant.P0))

    def residuals(d):
        seen = plant.measured(0, plant.space.moved(plant.x0, d), u)
        return np.concatenate([prior @ d, root @ plant.residual(y, seen)[used]])

    return residuals


@pytest.mark.parametrize("plant", [robot(1), attitude(1)], ids=["robot", "attitude"])
@pytest.mark.parametrize("missing", [0, 1])
def test_iterated_to_the_end_it_is_the_maximum_a_posteriori(plant, missing):
    rng, ne = np.random.default_rng(2), plant.space.ne
    for _ in range(5):
        x = plant.space.moved(plant.x0, np.linalg.cholesky(plant.P0) @ rng.normal(size=ne))
        u = rng.normal(size=plant.nu)
        y = plant.measured(0, x, u) + 0.1 * rng.normal(size=plant.ny)
        y[:missing] = np.nan
        found = Iterated(system=plant, iterations=60).run(y[None], u[None])
        residuals = posterior_cost(plant, y, u)
        best = least_squares(residuals, np.zeros(ne), xtol=1e-15, ftol=1e-15, gtol=1e-15)
        # Gauss & Newton's steps stop where the cost cannot be told apart: half of the digits.
        d = plant.space.minus(found["filtered_state"][0], plant.x0)
        np.testing.assert_allclose(d, best.x, atol=2e-7)
        information = plant.space.turned(best.x) @ np.linalg.inv(best.jac.T @ best.jac)
        P = information @ plant.space.turned(best.x).T
        np.testing.assert_allclose(found["filtered_covariance"][0], P, atol=1e-5 * np.abs(P).max())


def test_a_step_that_raises_the_cost_is_not_taken():
    """Atan far away: Newton's step overshoots, and the estimate stays with the gain computed."""
    plant = system(
        lambda x, *_: x, lambda x, *_: [np.arctan(x[0])], ("line",), 1,
        R=np.array([[1e-4]]), x0=np.array([3.0]), P0=np.array([[25.0]]),
    )  # fmt: skip
    y, u = np.array([[0.0]]), np.zeros((1, 0))
    found = Iterated(system=plant).run(y, u)
    assert found["stayed"][0] == 1.0
    assert found["filtered_state"][0, 0] == 3.0
    H = 1.0 / (1.0 + 9.0)
    expected = 1.0 / (1.0 / 25.0 + H * H / 1e-4)
    np.testing.assert_allclose(found["filtered_covariance"][0], [[expected]], rtol=1e-10)
    near = replace(plant, x0=np.array([0.5]))
    assert Iterated(system=near, iterations=1).run(y, u)["stayed"][0] == 0.0
    one, plain = Iterated(system=near, iterations=1).run(y, u), Extended(system=near).run(y, u)
    for name, value in plain.items():
        np.testing.assert_allclose(one[name], value, rtol=1e-12, err_msg=name)


def grid_of(centre, P, points):
    """Points within six deviations, (., n)."""
    axes = np.meshgrid(*[np.linspace(-6.0, 6.0, points)] * len(centre), indexing="ij")
    return centre + np.stack([axis.ravel() for axis in axes], 1) @ np.linalg.cholesky(P).T


def bayes(plant, y, points):
    """Mean and covariance of x[0] given y[0], and mean and covariance of x[1], on a grid."""
    x = grid_of(plant.x0, plant.P0, points)
    d = x - plant.x0
    residual = plant.residual(y, np.stack(plant.h(x.T, [], plant.parameters[0]), 1))
    logs = -0.5 * np.einsum("ij,ij->i", d, np.linalg.solve(plant.P0, d.T).T)
    logs -= 0.5 * np.einsum("ij,ij->i", residual, np.linalg.solve(plant.R[0], residual.T).T)
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    moved = np.stack(plant.f(x.T, [], [], plant.parameters[0]), 1)
    moments = []
    for values, noise in ((x, 0.0), (moved, plant.Q[0])):
        mean = weights @ values
        apart = values - mean
        moments += [mean, (weights[:, None] * apart).T @ apart + noise]
    return moments


def curved(n, noise):
    """A plant of one or two states, whose functions bend."""
    pairs = {
        1: (lambda x, *_: [x[0] + 0.3 * np.sin(x[0])], lambda x, *_: [np.exp(0.4 * x[0])]),
        2: (
            lambda x, *_: [x[0] * np.cos(x[1]), x[1] + 0.2 * x[0] * x[0]],
            lambda x, *_: [np.hypot(x[0], x[1]), np.arctan2(x[1], x[0])],
        ),
    }
    f, h = pairs[n]
    scale = noise**2
    return system(
        f, h, ("line",) * n, 1, R=scale * np.diag([0.3, 0.2][:n]), Q=scale * 0.1 * np.eye(n),
        x0=np.array([1.0, 0.7])[:n], P0=scale * (0.2 * np.eye(n) + 0.1),
    )  # fmt: skip


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("n", [1, 2])
def test_as_noises_shrink_each_comes_to_bayes_rule_on_a_grid(n, name):
    errors = []
    for noise in (0.2, 0.1, 0.05):
        plant = curved(n, noise)
        deviation = np.sqrt(np.diag(plant.R[0]))
        y = plant.measured(0, plant.x0, np.zeros(0)) + deviation * np.array([1.0, -0.8])[:n]
        found = FILTERS[name](system=plant).run(y[None], np.zeros((1, 0)))
        ports = ("filtered_state", "filtered_covariance", "predicted_state", "predicted_covariance")
        exact = bayes(plant, y, 400 if n == 1 else 160)
        scale = noise, noise**2, noise, noise**2
        each = [
            np.abs(found[port][0] - value).max() / size
            for port, value, size in zip(ports, exact, scale, strict=True)
        ]
        errors.append(each)
    errors = np.array(errors)
    # Second-order terms of f and h are of the size of the noise, in deviations.
    assert (errors[-1] < 0.05).all()
    assert (errors[-1] < 0.62 * errors[-2] + 1e-6).all()


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("f", [turn, rates])
def test_a_quaternion_and_its_opposite_are_the_same(name, f):
    plant = attitude(6, f)
    y, u, _ = record(plant)
    opposite = replace(plant, x0=plant.x0 * np.repeat([-1.0, 1.0], [4, 3]))
    found, other = (FILTERS[name](system=each).run(y, u) for each in (plant, opposite))
    for port, value in found.items():
        np.testing.assert_array_equal(other[port], value, err_msg=port)
    for port in ESTIMATES:
        q = found[port][:, :4]
        np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, rtol=1e-15)
        assert (q[:, 0] >= 0.0).all()


def turned_world(plant, by):
    """The same plant in a world that is turned."""
    q = by.as_quat()[[3, 0, 1, 2]]
    x = plant.space.normal(plant.x0)
    whole = by * Rotation.from_quat(x[[1, 2, 3, 0]])
    there = np.concatenate([whole.as_quat()[[3, 0, 1, 2]], x[4:]])
    vectors = {"g": by.apply(GRAVITY), "m": by.apply(FIELD)}
    parameters = tuple({**each, **vectors} for each in plant.parameters)
    return replace(plant, x0=there, parameters=parameters), q


def assert_turned(found, other, by):
    for port, values in found.items():
        value = values.reshape(len(values), -1)
        other[port] = other[port].reshape(value.shape)
        if port in ESTIMATES:
            q = Rotation.from_quat(value[:, [1, 2, 3, 0]])
            back = by.inv() * Rotation.from_quat(other[port][:, [1, 2, 3, 0]])
            np.testing.assert_allclose((q.inv() * back).as_rotvec(), 0.0, atol=1e-12)
        at = slice(4, None) if port in ESTIMATES else slice(None)
        near = {"rtol": 1e-10, "atol": 1e-12, "err_msg": port}
        np.testing.assert_allclose(other[port][:, at], value[:, at], **near)


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("f", [turn, rates])
def test_turning_the_world_turns_the_estimate_and_nothing_else(name, f):
    plant, by = attitude(6, f), Rotation.from_rotvec([1.0, -2.0, 0.7])
    y, u, _ = record(plant, seed=3)
    other, _ = turned_world(plant, by)
    found, there = (FILTERS[name](system=each).run(y, u) for each in (plant, other))
    for each in (found, there):
        for port in ("doubt", "decided", "stayed"):
            each.pop(port, None)
    assert_turned(found, there, by)


@pytest.mark.parametrize("name", FILTERS)
def test_full_turns_of_an_angle_change_nothing(name):
    plant = robot(12)
    y, u, _ = record(plant, seed=4)
    y[:, 1] += 2.0 * np.pi * np.arange(-6, 6)
    plain = FILTERS[name](system=plant).run(plant.residual(y, np.zeros(2)), u)
    start = replace(plant, x0=plant.x0 + 4.0 * np.pi * np.array([0.0, 0.0, 1.0]))
    found = FILTERS[name](system=start).run(y, u)
    for port, value in plain.items():
        if port in ESTIMATES:
            found[port][:, 2] -= 4.0 * np.pi
        if port not in {"doubt", "decided", "stayed"}:
            np.testing.assert_allclose(found[port], value, rtol=1e-9, atol=1e-11, err_msg=port)


def test_points_are_averaged_across_the_end_of_a_turn():
    """A bearing behind the robot: points lie on both sides of pi, and noise over the end."""
    plant = system(
        lambda x, *_: x, lambda x, *_: [np.arctan2(x[1], x[0])], ("line", "line"), 1,
        R=np.array([[0.01]]), x0=np.array([-2.0, 0.0]), P0=0.01 * np.eye(2),
        wraps=np.array([True]),
    )  # fmt: skip
    y, u = np.array([[-np.pi + 0.05]]), np.zeros((1, 0))
    found = Unscented(system=plant).run(y, u)
    spread = np.sqrt(2.0 * 0.01)
    expected = 0.5 * np.arctan2(spread, 2.0) ** 2 + 0.01
    np.testing.assert_allclose(found["innovation"], [[0.05]], atol=1e-12)
    np.testing.assert_allclose(found["innovation_covariance"], [[[expected]]], rtol=1e-12)


def test_a_singular_covariance_has_a_root_with_zero_columns():
    rng = np.random.default_rng(5)
    root = np.tril(rng.normal(size=(5, 5)))
    root[:, [1, 3]] = 0.0
    L = lower_root(root @ root.T)
    np.testing.assert_allclose(L @ L.T, root @ root.T, atol=1e-12)
    assert not L[:, [1, 3]].any()
    np.testing.assert_allclose(L, np.tril(L))
    plant = robot(8, P0=np.zeros((3, 3)), Q=np.zeros((3, 3)))
    y, u, _ = record(plant)
    assert all(
        np.isfinite(v).all()
        for n, v in Unscented(system=plant).run(y, u).items()
        if n != "innovation"
    )


def test_points_that_are_moments_of_a_cubic():
    """Mean and variance of x^2 and x^3 by hand: N = 1, x = 1 +- 2."""
    plant = system(
        lambda x, *_: [x[0] * x[0]], lambda x, *_: [x[0] ** 3], ("line",), 1,
        R=np.array([[1.0]]), Q=np.array([[0.5]]), x0=np.array([1.0]), P0=np.array([[4.0]]),
    )  # fmt: skip
    y, u = np.array([[20.0]]), np.zeros((1, 0))
    found = Unscented(system=plant).run(y, u)
    # x = 3, -1: y = 27, -1; mean 13, variance 196 + 1, covariance 28
    np.testing.assert_allclose(found["innovation"], [[7.0]])
    np.testing.assert_allclose(found["innovation_covariance"], [[[197.0]]])
    x, P = 1.0 + 28.0 / 197.0 * 7.0, 4.0 - 28.0**2 / 197.0
    np.testing.assert_allclose(found["filtered_state"], [[x]])
    np.testing.assert_allclose(found["filtered_covariance"], [[[P]]])
    np.testing.assert_allclose(found["predicted_state"], [[x * x + P]])
    np.testing.assert_allclose(found["predicted_covariance"], [[[4.0 * x * x * P + 0.5]]])


def alike(plant, N):
    return Modes.of([plant] * N, np.full((plant.length, N, N), 1.0 / N), np.full(N, 1.0 / N))


@pytest.mark.parametrize("plant", [robot(8), attitude(8), swing(8)], ids=["robot", "att", "swing"])
@pytest.mark.parametrize("run", [textbook_interacting, textbook_gpb1])
def test_modes_that_are_alike_are_one(plant, run):
    y, u, _ = record(plant)
    found, expected = run(alike(plant, 4), y, u), Extended(system=plant).run(y, u)
    for port, value in expected.items():
        np.testing.assert_allclose(found[port], value, rtol=1e-9, atol=1e-11, err_msg=port)


@pytest.mark.parametrize("run", [textbook_interacting, textbook_gpb1])
def test_a_certain_mode_is_the_filter_that_is_told(run):
    plant, T = attitude(8), 8
    y, u, _ = record(plant)
    gamma = np.array([1.0, 1.0, 0.0, 1.0, 0.0, 0.0, 1.0, 1.0])
    systems = [plant.told((0, 4), np.full(T, g), np.full(T, d)) for g in (1, 0) for d in (1, 9)]
    kernels = np.zeros((T, 4, 4))
    kernels[np.arange(T), :, (2 * (1 - np.append(gamma[1:], 1.0))).astype(int)] = 1.0
    found = run(Modes.of(systems, kernels, np.eye(4)[0]), y, u)
    expected = Extended(system=plant.told((0, 4), gamma, np.ones(T))).run(y, u)
    for port, value in expected.items():
        np.testing.assert_allclose(found[port], value, rtol=1e-9, atol=1e-11, err_msg=port)


@pytest.mark.parametrize("run", [textbook_interacting, textbook_gpb1])
def test_turning_the_world_turns_a_mixture(run):
    plant, by, T = attitude(8), Rotation.from_rotvec([-0.4, 1.5, 2.0]), 8
    y, u, _ = record(plant, seed=6)
    rng = np.random.default_rng(7)
    law = rng.dirichlet(np.ones(4), size=(T, 4)), rng.dirichlet(np.ones(4))

    def modes(plant):
        each = [plant.told((3, 4, 5), np.full(T, g), np.full(T, d)) for g in (1, 0) for d in (1, 9)]
        return Modes.of(each, *law)

    other, _ = turned_world(plant, by)
    found, there = run(modes(plant), y, u), run(modes(other), y, u)
    for each in (found, there):
        for port in ("mode_state", "mode_filtered_state"):
            each.pop(port, None)
    assert_turned(found, there, by)


def test_a_row_without_signal_is_noise_that_wraps():
    """Expected is 0, and y is compared with it over the end of a turn."""
    plant = robot(2)
    failing = plant.told((0, 1), np.zeros(2), np.ones(2))
    y, u = np.array([[0.2, 2.0 * np.pi - 0.1], [np.nan, -7.0]]), np.ones((2, 2))
    found = Extended(system=failing).run(y, u)
    np.testing.assert_allclose(found["innovation"][0], [0.2, -0.1], atol=1e-12)
    np.testing.assert_allclose(found["innovation"][1, 1], wrapped(-7.0))
    np.testing.assert_allclose(found["innovation_covariance"], plant.R)
    np.testing.assert_allclose(found["filtered_state"][0], plant.x0)


def test_the_conditions_of_a_mode_are_one_estimate():
    """Two modes, one of them a mixture of two conditions, are three modes that are put together."""
    plant, T = robot(1), 1
    y, u, _ = record(plant, missing=0.0)
    one = np.ones(T)
    systems = tuple(plant.told((0,), g * one, d * one) for g, d in ((1, 1), (0, 1), (0, 30)))
    shares, initial = np.array([[1.0, 0.0, 0.0], [0.0, 0.3, 0.7]]), np.array([0.6, 0.4])
    lumped = Modes(
        systems=systems,
        lumping=Lumping(shares=shares, kernels=np.full((T, 2, 2), 0.5), initial=initial),
    )
    whole = Modes.of(systems, np.tile(np.eye(3), (T, 1, 1)), initial @ shares)
    found, expected = textbook_interacting(lumped, y, u), textbook_interacting(whole, y, u)
    for port in ("filtered_state", "filtered_covariance", "log_likelihood", "nis", "innovation"):
        np.testing.assert_allclose(found[port], expected[port], rtol=1e-11, err_msg=port)
    merged = expected["mode_probability"] @ (shares > 0.0).T
    np.testing.assert_allclose(found["mode_probability"], merged, rtol=1e-11)


@pytest.mark.parametrize("run", [textbook_interacting, textbook_gpb1])
def test_modes_that_expect_both_sides_of_the_end_of_a_turn_expect_its_end(run):
    bearing = dict.fromkeys(("R", "P0"), np.array([[0.01]])) | {"x0": np.zeros(1)}
    wraps = np.array([True])
    sides = [
        system(lambda x, *_: x, h, ("line",), 1, wraps=wraps, **bearing)
        for h in (lambda x, *_: [x[0] + np.pi - 0.1], lambda x, *_: [x[0] - np.pi + 0.1])
    ]
    modes = Modes.of(sides, np.full((1, 2, 2), 0.5), np.full(2, 0.5))
    found = run(modes, np.zeros((1, 1)), np.zeros((1, 0)))
    np.testing.assert_allclose(np.abs(found["innovation"]), [[np.pi]])
    np.testing.assert_allclose(found["innovation_covariance"], [[[0.02 + 0.1**2]]])
