"""A plant by functions over a record: where it goes, what is seen of it, and their derivatives.

    x[k+1] = f(x, u, w) (+) q,  y[k] = h(x, u) + v

(+) adds errors, on SO3 by a rotation in body axes (`Space`). f and h are plain functions of numbers
that may be `Dual`: derivatives come from there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import repeat
from typing import Any, Literal, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from fkgen.oracle.exact.gaussian import Array, square_root
from fkgen.oracle.plants.actuator import Plant
from fkgen.oracle.plants.dual import Number, Numbers, jacobian_of, seeded, values_of
from fkgen.oracle.plants.manifold import Space, wrapped

Parameters: TypeAlias = Mapping[str, Any]
#: f(x, u, w, p): the next state, or dx/dt; of a quaternion four numbers, or the rotation vector by
#: which it turns (its body rate), as `NonlinearSystem.increments` says
Motion: TypeAlias = Callable[[Numbers, Numbers, Numbers, Parameters], Numbers]
#: h(x, u, p)
Sensing: TypeAlias = Callable[[Numbers, Numbers, Parameters], Numbers]


@dataclass(frozen=True, slots=True)
class Flow:
    """How dx/dt becomes a step: Runge and Kutta's four stages, or Euler's one."""

    periods: Array  # (T,): From each sample to the next
    integrator: Literal["rk4", "euler"] = "rk4"
    substeps: int = 1


@dataclass(frozen=True, eq=False, kw_only=True)
class Moved:
    """Where a state goes, and what becomes of small errors and noises on the way."""

    x: Array  # (nx,)
    F: Array  # F, B, G: (ne, ne), (ne, q), (ne, r): By errors of x, by u and by w
    B: Array
    G: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class Seen:
    """What is expected of y at a state x (+) d."""

    y: Array  # (p,)
    H: Array  # H, D: (p, ne), (p, q): By d and by u
    D: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class NonlinearSystem:
    """Functions, noises and a prior, with the parameters of T samples."""

    f: Motion
    h: Sensing
    space: Space
    wraps: NDArray[np.bool_]  # (p,): Whether the difference of a row is an angle
    parameters: tuple[Parameters, ...]  # T of them
    Q: Array  # Q, R: (T, ne, ne), (T, p, p): Covariances of the noises beside f and h
    R: Array
    W: Array  # (T, r): Variances of w; Q and W are spectral densities where time is continuous
    x0: Array  # x0, P0: (nx,), (ne, ne)
    P0: Array
    nu: int = 0
    increments: frozenset[int] = frozenset()  # Signals whose quaternion f turns by a vector
    flow: Flow | None = None  # None where f is a step by itself
    #: (T, p): 0 where a row has no signal, and y is its noise
    signal: Array = field(default_factory=lambda: np.zeros(0))
    #: (T, ne, p): Covariance of what is added to x[k+1] with the noise of y[k]
    S: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        """Every row has a signal, and no noise tells of another, where nothing is said."""
        if not self.S.size:
            object.__setattr__(self, "S", np.zeros((self.length, self.space.ne, self.ny)))
        if not self.signal.size:
            object.__setattr__(self, "signal", np.ones(self.R.shape[:2]))

    @property
    def length(self) -> int:
        """Number of samples, T."""
        return len(self.parameters)

    @property
    def ny(self) -> int:
        """Number of measurements, p."""
        return int(self.R.shape[-1])

    @property
    def nw(self) -> int:
        """Number of noises that enter through f, r."""
        return int(self.W.shape[-1])

    def over(self, piece: slice) -> Self:
        """The same plant over a piece of its samples, its prior unchanged."""
        flow = self.flow
        if flow is not None:
            flow = replace(flow, periods=flow.periods[piece])
        varying = ("parameters", "Q", "R", "W", "signal", "S")
        return replace(self, flow=flow, **{name: getattr(self, name)[piece] for name in varying})

    def told(self, rows: Sequence[int], gamma: Array, delta: Array) -> Self:
        """The plant of one who knows gamma and delta of every sample, (T,), of some rows."""
        signal, noise = self.signal.copy(), np.ones(self.signal.shape)
        signal[:, rows], noise[:, rows] = gamma[:, None], np.sqrt(delta)[:, None]
        return replace(self, signal=signal, R=noise[:, :, None] * self.R * noise[:, None, :])

    def noises(self, k: int) -> tuple[Array, Array]:
        """Variances of w over a sample, (r,), and the covariance of what is added to x."""
        if self.flow is None:
            return self.W[k], self.Q[k]
        period = self.flow.periods[k]
        return self.W[k] / period, self.Q[k] * period

    def step(self, k: int, x: Numbers, u: Numbers, w: Numbers) -> list[Number]:
        """The next state, without what is added to it."""
        p, space, flow = self.parameters[k], self.space, self.flow
        if flow is None:
            return space.advanced(x, self.f(x, u, w, p), self.increments)
        h, state = flow.periods[k] / flow.substeps, list(x)
        for _ in range(flow.substeps):
            slope = list(self.f(state, u, w, p))
            if flow.integrator == "rk4":
                stages = [slope]
                for part in (0.5, 0.5, 1.0):
                    at = space.plus(state, [h * part * each for each in stages[-1]])
                    stages.append(list(self.f(at, u, w, p)))
                slope = [
                    (a + 2.0 * b + 2.0 * c + d) / 6.0 for a, b, c, d in zip(*stages, strict=True)
                ]
            state = space.plus(state, [h * each for each in slope])
        return state

    def moved(self, k: int, x: Array, u: Array) -> Moved:
        """Linearise f at a state and an input, w = 0."""
        ne, q, r = self.space.ne, self.nu, self.nw
        seeds = ne + q + r
        at = self.space.plus(list(x), seeded(np.zeros(ne), seeds))
        found = self.step(k, at, seeded(u, seeds, ne), seeded(np.zeros(r), seeds, ne + q))
        slopes = self.space.slopes(found, seeds)
        F, B, G = np.split(slopes, [ne, ne + q], axis=1)
        return Moved(x=self.space.normal(values_of(found)), F=F, B=B, G=G)

    def seen(self, k: int, x: Array, u: Array, d: Array | None = None) -> Seen:
        """Linearise d -> h(x (+) d, u), at 0 or elsewhere."""
        ne, seeds = self.space.ne, self.space.ne + self.nu
        at = self.space.plus(list(x), seeded(np.zeros(ne) if d is None else d, seeds))
        found = list(self.h(at, seeded(u, seeds, ne), self.parameters[k]))
        signal = self.signal[k]
        slopes = np.where(signal[:, None] > 0.0, jacobian_of(found, seeds), 0.0)
        H, D = np.split(slopes, [ne], axis=1)
        return Seen(y=np.where(signal > 0.0, values_of(found), 0.0), H=H, D=D)

    def measured(self, k: int, x: Array, u: Array) -> Array:
        """h(x, u), (p,)."""
        found = values_of(self.h(list(x), list(u), self.parameters[k]))
        return np.where(self.signal[k] > 0.0, found, 0.0)

    def residual(self, y: Array, expected: Array) -> Array:
        """The difference of two measurements, of angles in (-pi, pi]."""
        return np.where(self.wraps, wrapped(y - expected), y - expected)


def simulate_nonlinear(
    system: NonlinearSystem | Sequence[NonlinearSystem],
    u: Array,
    rng: np.random.Generator,
    *,
    scale: float = 1.0,
) -> tuple[Array, Array]:
    """Draw measurements (T, p) and the states behind them (T, nx); u (T, q).

    Of several systems each holds at one sample. ``scale``: of what is drawn, in deviations.
    """
    systems = [system] * len(u) if isinstance(system, NonlinearSystem) else system
    system, T = systems[0], len(u)
    space = system.space
    states, y = np.zeros((T, space.nx)), np.zeros((T, system.ny))
    x = space.moved(system.x0, scale * (square_root(system.P0) @ rng.standard_normal(space.ne)))
    for k, system in enumerate(systems):
        states[k] = x
        W, Q = system.noises(k)
        root = square_root(np.block([[Q, system.S[k]], [system.S[k].T, system.R[k]]]))
        noise = scale * (root @ rng.standard_normal(len(root)))
        measured = system.measured(k, x, u[k]) + noise[space.ne :]
        y[k] = system.residual(measured, np.zeros(system.ny))
        w = scale * (np.sqrt(W) * rng.standard_normal(system.nw))
        x = space.moved(values_of(system.step(k, x, u[k], w)), noise[: space.ne])
    return y, states


def by_functions(plant: Plant) -> NonlinearSystem:
    """A plant of matrices as functions; its faults are left to the filters."""

    def product(M: Array, x: Numbers) -> list[Number]:
        return [sum((a * b for a, b in zip(row, x, strict=True)), 0.0) for row in M]

    def added(*vectors: Numbers) -> list[Number]:
        return [sum(each, 0.0) for each in zip(*vectors, strict=True)]

    def f(x: Numbers, u: Numbers, _: Numbers, p: Parameters) -> Numbers:
        k = p["k"]
        return added(product(plant.A[k], x), product(plant.B[k], u), plant.c[k])

    def h(x: Numbers, u: Numbers, p: Parameters) -> Numbers:
        k = p["k"]
        return added(product(plant.C[k], x), product(plant.D[k], u), plant.d[k])

    return NonlinearSystem(
        S=getattr(plant, "S", np.zeros(0)),
        f=f,
        h=h,
        space=Space(tuple(repeat("line", plant.nx))),
        wraps=np.zeros(plant.ny, bool),
        parameters=tuple({"k": k} for k in range(plant.length)),
        Q=plant.Q,
        R=plant.R,
        W=np.zeros((plant.length, 0)),
        x0=plant.x0,
        P0=plant.P0,
        nu=plant.nu,
    )
