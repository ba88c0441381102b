"""Nonlinear plants as functions of numbers: a robot, a turning wheel, an attitude with its bias."""

from __future__ import annotations

import numpy as np

from fkgen.oracle.plants.manifold import Space, exponential, times
from fkgen.oracle.plants.nonlinear import Flow, NonlinearSystem

#: What an attitude is seen by: gravity and a magnetic field, in the world frame.
GRAVITY = np.array([0.3, -0.2, 9.8])
FIELD = np.array([0.5, 0.1, -0.8])


def system(f, h, kinds, T, *, R, Q=None, W=(), **given):
    """A plant whose noises and parameters are the same at all samples."""
    space = Space(kinds)
    Q = np.zeros((space.ne, space.ne)) if Q is None else np.asarray(Q)
    given = {"wraps": np.zeros(len(R), bool), "parameters": {}} | given
    return NonlinearSystem(
        f=f, h=h, space=space,
        Q=np.tile(Q, (T, 1, 1)), R=np.tile(R, (T, 1, 1)), W=np.tile(np.asarray(W, float), (T, 1)),
        **given | {"parameters": (given["parameters"],) * T},
    )  # fmt: skip


def robot_f(x, u, w, p):
    """A position that moves along a heading whose turn is random."""
    way = u[0] * p["dt"]
    turned = x[2] + (u[1] + w[0]) * p["dt"]
    return [x[0] + way * np.cos(x[2]), x[1] + way * np.sin(x[2]), turned]


def robot_h(x, _, __):
    """Range and bearing of the origin."""
    return [np.hypot(x[0], x[1]), np.arctan2(x[1], x[0]) - x[2]]


def robot(T, *, noise=1.0, **given):
    """The robot; ``noise`` scales all deviations."""
    plant = {
        "Q": noise**2 * np.diag([1e-4, 2e-4, 0.0]), "W": [noise**2 * 0.04],
        "R": noise**2 * np.array([[0.04, 0.002], [0.002, 0.01]]),
        "x0": np.array([3.0, -1.0, 2.0]), "P0": noise**2 * np.diag([0.2, 0.3, 0.1]),
        "wraps": np.array([False, True]), "parameters": {"dt": 0.2}, "nu": 2,
    }  # fmt: skip
    return system(robot_f, robot_h, ("line", "line", "circle"), T, **plant | given)


def rotated(q, v):
    """A vector of the body in the world, as the quaternion product says it."""
    return times(times(q, [0.0, *v]), [q[0], -q[1], -q[2], -q[3]])[1:]


def seen_from(q, v):
    """A vector of the world in the body."""
    return rotated([q[0], -q[1], -q[2], -q[3]], v)


def rates(x, u, w, _):
    """Body rate less its bias, which wanders."""
    return [*(u[i] - x[4 + i] for i in range(3)), *(0.1 * w[i] for i in range(3))]


def turn(x, u, w, p):
    """The same over a step, as a rotation vector."""
    by = [p["dt"] * (u[i] - x[4 + i]) for i in range(3)]
    return [*by, *(x[4 + i] + 0.1 * w[i] for i in range(3))]


def turn_in_four_numbers(x, u, w, p):
    """The same, as four numbers that are no unit quaternion."""
    by = [p["dt"] * (u[i] - x[4 + i]) for i in range(3)]
    q = times(x[:4], exponential(by))
    return [*(1.5 * each for each in q), *(x[4 + i] + 0.1 * w[i] for i in range(3))]


def vectors(x, _, p):
    """Gravity and field as the body sees them."""
    return [*seen_from(x[:4], p["g"]), *seen_from(x[:4], p["m"])]


ATTITUDE = ("SO3", "line", "line", "line")


def attitude(T, f=turn, *, noise=1.0, **given):
    """An attitude and the bias of its gyroscope."""
    if f is rates:
        given = {"flow": Flow(np.full(T, 0.1), "rk4", 2)} | given
    plant = {
        "Q": noise**2 * np.diag([1e-3, 2e-3, 3e-3, 1e-5, 1e-5, 1e-5]),
        "W": noise**2 * np.array([1e-3, 2e-3, 1e-3]),
        "R": noise**2 * np.diag([0.2, 0.3, 0.2, 0.02, 0.03, 0.02]),
        "x0": np.array([0.8, 0.0, 0.6, 0.0, 0.01, -0.02, 0.03]),
        "P0": noise**2 * np.diag([0.3, 0.2, 0.25, 1e-2, 1e-2, 1e-2]),
        "parameters": {"dt": 0.1, "g": GRAVITY, "m": FIELD}, "nu": 3,
        "increments": frozenset() if f is turn_in_four_numbers else frozenset({0}),
    }  # fmt: skip
    return system(f, vectors, ATTITUDE, T, **plant | given)


def pendulum(x, u, w, p):
    """An angle and its rate."""
    return [x[1], -p["stiffness"] * np.sin(x[0]) - 0.2 * x[1] + u[0] + w[0]]


def swing(T, *, integrator="rk4", substeps=1, period=0.1):
    """A pendulum in continuous time."""
    return system(
        pendulum, lambda x, _, __: [np.sin(x[0])], ("circle", "line"), T,
        Q=np.diag([1e-3, 2e-3]), W=[0.05], R=np.array([[0.01]]), x0=np.array([2.0, 0.5]),
        P0=np.diag([0.1, 0.2]), parameters={"stiffness": 4.0}, nu=1,
        flow=Flow(np.full(T, period), integrator, substeps),
    )  # fmt: skip
