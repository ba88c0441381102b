"""What ekf, iekf and ukf estimate, judged by what shares nothing with them but the model."""

from __future__ import annotations

import math
import tomllib

import casadi as ca
import numpy as np
import pytest
from nonlinear_specs import WORLD, record_of, spec_of
from plants import built
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import fkgen
from fkgen.study.reports.starters import starter
from fkgen.symbolic.lifting import rotations

FAMILIES = ("ekf", "iekf", "ukf")


def from_scalar_last(rotation):
    """Quaternions (w, x, y, z), w >= 0."""
    q = np.atleast_2d(rotation.as_quat())[:, [3, 0, 1, 2]]
    return q * np.where(q[:, :1] < 0.0, -1.0, 1.0)


@pytest.mark.parametrize("family", ["ekf", "ukf"])
def test_a_tracker_is_as_good_as_it_says(family):
    """Robot and beacons of a starter: 200 records of 500 samples, all at once."""
    table = tomllib.loads(starter("ekf"))
    spec = fkgen.Spec.from_dict(table | {"filter": {"family": family}})
    trials, T, equations = 200, 500, spec.model.equations
    rng, p = np.random.default_rng(1), spec.defaults
    deviations = np.sqrt(np.diag(spec.model.P0.values()))
    x = spec.model.x0.values() + deviations[:, None] * rng.normal(size=(3, trials))
    noise = np.sqrt(np.diag(spec.model.R.values()))
    states, y, u = np.zeros((T, 3, trials)), np.zeros((trials, T, 3)), np.array([1.0, 0.2])
    for k in range(T):
        states[k] = x
        seen = np.array(equations.seen(x, u, p))
        y[:, k] = seen.T + noise * rng.normal(size=(trials, 3))
        w = np.array([0.1, 0.05])[:, None] * rng.normal(size=(2, trials))
        x = np.array(equations.moved(x, u, w, p))
    found = fkgen.build(spec).run_batch(y, np.tile(u, (trials, T, 1)))
    error = states.transpose(2, 0, 1) - found.filtered_state
    error[..., 2] = (error[..., 2] + np.pi) % (2.0 * np.pi) - np.pi
    weighted = np.linalg.solve(found.filtered_covariance, error[..., None])[..., 0]
    assert abs((error * weighted).sum(axis=-1).mean() / 3.0 - 1.0) < 0.05


def test_iekf_ends_at_the_most_probable_state():
    spec = spec_of("circle", "iekf", iterations=20)
    y, _, _ = record_of(spec, 1, seed=4, missing=0.0)
    y[0] = [2.0, 2.6]
    found = built(spec).run(y)
    model, l_P = spec.model, np.linalg.cholesky(spec.model.P0.values())
    l_R, x0 = np.linalg.cholesky(model.R.values()), model.x0.values().ravel()

    def residuals(x):
        apart = y[0] - np.array(model.equations.seen(x, [], spec.defaults))
        apart[0] = (apart[0] + np.pi) % (2.0 * np.pi) - np.pi
        return np.concatenate([np.linalg.solve(l_P, x - x0), np.linalg.solve(l_R, apart)])

    best = least_squares(residuals, x0, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    # Gauss-Newton comes closer by a factor each time; the cost tells 1e-8 deviations apart.
    np.testing.assert_allclose(found.filtered_state[0], best.x, atol=1e-6)


@pytest.mark.parametrize("family", FAMILIES)
def test_a_quaternion_and_its_negative_are_one_attitude(family):
    spec = spec_of("attitude", family)
    y, u, _ = record_of(spec, 6)
    x0 = spec.model.x0.values().ravel()
    one, other = (
        built(spec).run(y, u, start={"x0": np.concatenate([sign * x0[:4], x0[4:]])})
        for sign in (1.0, -1.0)
    )
    for port in one.ports:
        np.testing.assert_array_equal(one[port], other[port], err_msg=port)
    assert (one.filtered_state[:, 0] >= 0.0).all()
    np.testing.assert_allclose(np.linalg.norm(one.filtered_state[:, :4], axis=1), 1.0, rtol=1e-15)


@pytest.mark.parametrize("family", FAMILIES)
def test_turning_the_world_turns_the_attitude_and_nothing_else(family):
    options = {"iterations": 1} if family == "iekf" else {}  # no step that rounding decides on
    spec = spec_of("attitude", family, **options)
    y, u, _ = record_of(spec, 10)
    turn = Rotation.from_rotvec([0.4, -1.1, 0.7])
    x0 = spec.model.x0.values().ravel()
    start = from_scalar_last(turn * Rotation.from_quat(x0[[1, 2, 3, 0]]))[0]
    turned_world = {name: turn.apply(value) for name, value in WORLD.items()}
    given = {f"{name}_{i}": np.full(10, turned_world[name][i]) for name in WORLD for i in range(3)}
    plain = built(spec).run(y, u)
    turned = built(spec).run(y, u, given, start={"x0": np.concatenate([start, x0[4:]])})
    for of in ("filtered", "predicted"):
        states = plain[f"{of}_state"]
        expected = from_scalar_last(turn * Rotation.from_quat(states[:, [1, 2, 3, 0]]))
        np.testing.assert_allclose(turned[f"{of}_state"][:, :4], expected, atol=1e-12)
        np.testing.assert_allclose(turned[f"{of}_state"][:, 4:], states[:, 4:], atol=1e-12)
        covariances = plain[f"{of}_covariance"], turned[f"{of}_covariance"]
        np.testing.assert_allclose(*covariances, atol=1e-12)


@pytest.mark.parametrize("size", [0.0, 1e-170, 1e-12, 1e-8, 1e-4, 1e-3, 0.02, 1.0, 3.1])
def test_rotations_of_any_angle_keep_their_digits(size):
    """Against series of the exponential of d x, summed until nothing changes."""
    d = size * np.array([0.6, -0.48, 0.64])
    symbol = ca.SX.sym("d", 3)
    cross = np.array([[0.0, -d[2], d[1]], [d[2], 0.0, -d[0]], [-d[1], d[0], 0.0]])
    powers = [np.linalg.matrix_power(-cross, k) for k in range(60)]
    jacobian = sum(power / math.factorial(k + 1) for k, power in enumerate(powers))
    rotation = sum(power / math.factorial(k) for k, power in enumerate(powers)).T

    def value(of):
        return np.array(ca.Function("f", [symbol], [of(symbol)])(d))

    for exponential in (rotations.exponential, rotations.smooth_exponential):
        q = value(exponential)
        np.testing.assert_allclose(np.linalg.norm(q), 1.0, rtol=1e-15)
        np.testing.assert_allclose(q[1:, 0], d * np.sinc(size / 2 / np.pi) / 2, rtol=1e-14)
        matrix = value(lambda each, of=exponential: rotations.matrix(of(each)))
        np.testing.assert_allclose(matrix, rotation, atol=2e-15)
    np.testing.assert_allclose(value(rotations.right_jacobian), jacobian, atol=2e-15)
    inverse = value(rotations.inverse_right_jacobian)
    np.testing.assert_allclose(inverse @ jacobian, np.eye(3), atol=1e-14)
