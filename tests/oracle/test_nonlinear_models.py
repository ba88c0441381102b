"""Derivatives, rotations and integrators of the nonlinear oracle against others' formulas."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import sympy
from nonlinear_plants import (
    attitude,
    rates,
    robot,
    seen_from,
    swing,
    system,
    turn,
    turn_in_four_numbers,
)
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from fkgen.oracle.plants.dual import Dual, jacobian_of, seeded, values_of
from fkgen.oracle.plants.manifold import Space, exponential, logarithm, wrapped
from fkgen.oracle.plants.nonlinear import Flow, simulate_nonlinear

SO3 = Space(("SO3",))
POINTS = 100


def quaternion(rotation):
    q = rotation.as_quat()[[3, 0, 1, 2]]
    return q if q[0] >= 0.0 else -q


def rotation(q):
    return Rotation.from_quat(np.asarray(q)[[1, 2, 3, 0]])


def central(function, at, step=1e-6):
    """Jacobian by differences; its error is some 1e-9 of the third derivative."""
    columns = [
        (function(at + step * e) - function(at - step * e)) / (2 * step) for e in np.eye(len(at))
    ]
    return np.array(columns).T


def everything(x, library):
    """Every function of the expression language, of two numbers in (0.1, 0.9)."""
    a, b = x
    low, high = (a * b, a + b)
    return [
        library.exp(a * b) - 3.0 / (1.0 + a) + (-b),
        library.log(a + 2.0 * b) * library.sqrt(a),
        library.sin(a) * library.cos(b) + library.tan(a * b),
        library.asin(low) + library.acos(a * a),
        library.sinh(a) + library.cosh(b) * library.tanh(high),
        library.atan2(a, b) + library.hypot(a, 2.0 * b),
        a ** (b + 1.0) + a**3 + 2.0**b,
        library.abs(a - b) + library.max(a, 2.0 * b) + library.min(a, b * b),
        library.where(a > b, a * b, a / b),
    ]


class Numeric:
    """The functions by NumPy, of dual numbers."""

    asin, acos, atan2 = np.arcsin, np.arccos, np.arctan2
    max, min, where = np.maximum, np.minimum, staticmethod(np.where)

    def __getattr__(self, name):
        return getattr(np, name)


class Symbolic:
    """The functions by SymPy."""

    abs, max, min = sympy.Abs, sympy.Max, sympy.Min

    def __getattr__(self, name):
        return getattr(sympy, name)

    def hypot(self, a, b):
        return sympy.sqrt(a * a + b * b)

    def where(self, condition, a, b):
        return sympy.Piecewise((a, condition), (b, True))


def test_derivatives_of_every_function_are_those_of_sympy():
    symbols = sympy.symbols("a b", positive=True)
    functions = sympy.Matrix(everything(symbols, Symbolic()))
    jacobian = sympy.lambdify(symbols, functions.jacobian(symbols), ["scipy", "numpy"])
    for at in np.random.default_rng(1).uniform(0.1, 0.9, (POINTS, 2)):
        found = everything(seeded(at, 2), Numeric())
        expected = np.array(jacobian(*at), float)
        np.testing.assert_allclose(jacobian_of(found, 2), expected, rtol=1e-12, atol=1e-13)
        np.testing.assert_allclose(values_of(found), everything(at, Numeric()), rtol=1e-15)


def test_what_is_not_differentiated_is_refused():
    with pytest.raises(TypeError):
        np.floor(Dual(1.5, [1.0]))
    with pytest.raises(TypeError):
        float(Dual(1.5, [1.0]))


def test_derivatives_by_complex_steps_and_by_differences():
    plant, rng = robot(1), np.random.default_rng(2)
    p, h = plant.parameters[0], 1e-30
    for _ in range(POINTS):
        x, u = rng.normal(size=3) * 3.0, rng.normal(size=2)
        moved, seen = plant.moved(0, x, u), plant.seen(0, x, u)
        for i, e in enumerate(np.eye(3)):
            complex_f = np.imag(plant.f(x + 1j * h * e, u, [0.0], p)) / h
            np.testing.assert_allclose(moved.F[:, i], complex_f, rtol=1e-12, atol=1e-14)
        for i, e in enumerate(np.eye(2)):
            complex_f = np.imag(plant.f(x, u + 1j * h * e, [0.0], p)) / h
            np.testing.assert_allclose(moved.B[:, i], complex_f, rtol=1e-12, atol=1e-14)
        through = np.imag(plant.f(x, u, [1j * h], p)) / h
        np.testing.assert_allclose(moved.G[:, 0], through, rtol=1e-12, atol=1e-14)
        H = central(lambda x, u=u, y=seen.y: plant.residual(plant.measured(0, x, u), y), x)
        np.testing.assert_allclose(seen.H, H, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("f", [turn, turn_in_four_numbers, rates])
def test_derivatives_on_rotations_by_differences_of_box_plus_and_box_minus(f):
    plant, rng = attitude(1, f), np.random.default_rng(3)
    space = plant.space
    for _ in range(POINTS if f is turn else 20):
        x = space.normal(rng.normal(size=7))
        u, d = rng.normal(size=3), rng.normal(size=6)
        moved, seen = plant.moved(0, x, u), plant.seen(0, x, u, d)

        def after(e, w, x=x, u=u, moved=moved):
            there = plant.step(0, list(space.moved(x, e)), u, w)
            return space.minus(space.normal(values_of(there)), moved.x)

        F = central(lambda e, after=after: after(e, np.zeros(3)), np.zeros(6))
        G = central(lambda w, after=after: after(np.zeros(6), w), np.zeros(3))
        H = central(lambda d, x=x, u=u: plant.measured(0, space.moved(x, d), u), d)
        for found, expected in ((moved.F, F), (moved.G, G), (seen.H, H)):
            np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-7)


def test_rotations_are_those_of_scipy():
    rng = np.random.default_rng(4)
    for size in (0.0, 1e-12, 1e-4, 0.3, 0.99, 1.01, 2.0, 3.1):
        d = rng.normal(size=3)
        d *= size / np.linalg.norm(d)
        q = np.array(exponential(d), float)
        expected = quaternion(Rotation.from_rotvec(d))
        np.testing.assert_allclose(q, expected, rtol=1e-14, atol=1e-16)
        np.testing.assert_allclose(logarithm(-q), d, rtol=1e-13, atol=1e-300)
        a = Rotation.random(random_state=7)
        there = SO3.moved(quaternion(a), d)
        np.testing.assert_allclose(there, quaternion(a * Rotation.from_rotvec(d)), atol=1e-15)
        np.testing.assert_allclose(SO3.minus(there, quaternion(a)), d, atol=1e-14)
    v = rng.normal(size=3)
    np.testing.assert_allclose(seen_from(there, v), rotation(there).inv().apply(v), rtol=1e-13)


def test_a_covariance_turns_with_the_right_jacobian():
    """I - (1 - cos t)/t^2 [d] + (t - sin t)/t^3 [d]^2, as it is printed."""
    rng = np.random.default_rng(5)
    for size in (1e-9, 0.5, 2.0, 3.0):
        d = rng.normal(size=3)
        d *= size / np.linalg.norm(d)
        X = np.array([[0, -d[2], d[1]], [d[2], 0, -d[0]], [-d[1], d[0], 0]])
        second = (1.0 - np.cos(size)) / size**2 if size > 1e-6 else 0.5
        third = (size - np.sin(size)) / size**3 if size > 1e-6 else 1.0 / 6.0
        expected = np.eye(3) - second * X + third * X @ X
        np.testing.assert_allclose(SO3.turned(d), expected, rtol=1e-12, atol=1e-14)


def test_angles_are_reduced_to_one_turn_whose_end_is_included():
    pi = np.pi
    given = np.array([0.0, pi, -pi, 3.0 * pi, pi + 0.1, -pi - 0.1, 7.0])
    expected = [0.0, pi, pi, pi, 0.1 - pi, pi - 0.1, 7.0 - 2.0 * pi]
    np.testing.assert_allclose(wrapped(given), expected, atol=1e-14)


def test_a_mixture_is_taken_about_its_first_component():
    """The spread of the means, and each covariance carried there by differences."""
    rng = np.random.default_rng(6)
    space = Space(("SO3", "circle", "line"))
    first = space.normal(rng.normal(size=6))
    x = np.array([first, *(space.moved(first, rng.normal(size=5)) for _ in range(2))])
    x[1][4] += 2.0 * np.pi
    weights, roots = np.array([0.5, 0.2, 0.3]), rng.normal(size=(3, 5, 5))
    errors = np.array([space.minus(each, first) for each in x])
    mean, P = space.mixture(weights, x, roots @ roots.transpose(0, 2, 1))
    np.testing.assert_allclose(mean, space.moved(first, weights @ errors), atol=1e-14)
    expected = sum(
        weight * np.outer(e, e)
        for weight, e in zip(weights, errors - weights @ errors, strict=True)
    )
    for weight, centre, root in zip(weights, x, roots, strict=True):
        across = central(lambda d, x=centre: space.minus(space.moved(x, d), first), np.zeros(5))
        expected = expected + weight * across @ root @ root.T @ across.T
    ahead = central(
        lambda e: space.minus(space.moved(first, weights @ errors + e), mean), np.zeros(5)
    )
    np.testing.assert_allclose(P, ahead @ expected @ ahead.T, atol=1e-7 * np.abs(P).max())


@pytest.mark.parametrize(("integrator", "order"), [("rk4", 4.0), ("euler", 1.0)])
def test_integrators_converge_with_their_order(integrator, order):
    u = np.array([0.3])
    exact = solve_ivp(
        lambda _, x: [x[1], -4.0 * np.sin(x[0]) - 0.2 * x[1] + 0.3],
        (0.0, 1.0), [2.0, 0.5], rtol=1e-12, atol=1e-13,
    ).y[:, -1]  # fmt: skip
    steps = np.array([16, 32, 64])
    plants = [swing(1, integrator=integrator, substeps=s, period=1.0) for s in steps]
    errors = [np.abs(plant.moved(0, plant.x0, u).x - exact).max() for plant in plants]
    np.testing.assert_allclose(np.log2(errors[:-1]) - np.log2(errors[1:]), order, atol=0.15)


def test_a_body_rate_is_integrated_as_rotation_vectors():
    """A constant rate is exact; where the axis moves the rule is of order two."""
    plant = attitude(1, rates)
    x, u = plant.x0, np.array([1.0, -2.0, 0.5])
    there = rotation(x[:4]) * Rotation.from_rotvec(0.1 * (u - x[4:]))
    np.testing.assert_allclose(plant.moved(0, x, u).x[:4], quaternion(there), atol=1e-15)

    def f(x, *_):
        return [x[1] * x[0] + 0.5, x[0] * x[2], 1.0 - x[3] * x[3]]

    def slope(_, q):
        w = f(q)
        a, (b, c, d) = q[0], q[1:]
        return 0.5 * np.array([
            -b * w[0] - c * w[1] - d * w[2], a * w[0] + c * w[2] - d * w[1],
            a * w[1] - b * w[2] + d * w[0], a * w[2] + b * w[1] - c * w[0],
        ])  # fmt: skip

    q0 = SO3.normal(np.array([0.9, 0.1, -0.3, 0.2]))
    exact = solve_ivp(slope, (0.0, 1.0), q0, rtol=1e-12, atol=1e-13).y[:, -1]
    exact = SO3.normal(exact)
    errors = []
    for substeps in (16, 32):
        flow = Flow(np.ones(1), "rk4", substeps)
        turning = system(
            f, f, ("SO3",), 1, R=np.eye(3), x0=q0, P0=np.eye(3),
            increments=frozenset({0}), flow=flow,
        )  # fmt: skip
        errors.append(np.abs(SO3.minus(turning.moved(0, q0, np.zeros(0)).x, exact)).max())
    assert errors[0] < 1e-4
    assert np.log2(errors[0] / errors[1]) > 1.8


def test_a_simulated_record_has_the_noises_that_are_stated():
    """Continuous: a noise is held with its density over the period, Q times the period is added."""
    T = 4000
    plant = swing(T)
    y, x = simulate_nonlinear(plant, np.zeros((T, 1)), np.random.default_rng(8))
    errors = np.array([
        plant.space.minus(after, plant.moved(k, before, np.zeros(1)).x)
        for k, (before, after) in enumerate(pairwise(x))
    ])  # fmt: skip
    G = plant.moved(0, x[0], np.zeros(1)).G
    W, Q = plant.noises(0)
    expected = G @ np.diag(W) @ G.T + Q
    np.testing.assert_allclose(np.cov(errors.T), expected, atol=0.1 * np.abs(expected).max())
    np.testing.assert_allclose(W, [0.5])
    noise = y[:, 0] - np.sin(x[:, 0])
    np.testing.assert_allclose(np.var(noise), 0.01, rtol=0.1)
