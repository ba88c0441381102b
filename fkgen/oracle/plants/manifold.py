"""What states are: numbers, angles and unit quaternions, and how errors of them add up.

A quaternion is (w, x, y, z), body to world; its error is a rotation vector in body axes,
``q_true = q exp(delta)`` (Sola, A micro Lie theory, 2018, right increments).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from fkgen.oracle.exact.gaussian import Array
from fkgen.oracle.plants.dual import Number, Numbers, jacobian_of, seeded, value_of, values_of

Kind: TypeAlias = Literal["line", "circle", "SO3"]
Gaussian: TypeAlias = tuple[Array, Array]

#: Terms of the power series of an angle below one.
TERMS = 12


def wrapped(difference: Array) -> Array:
    """The same angle in (-pi, pi]."""
    turn = 2.0 * np.pi
    return np.asarray(difference - turn * np.ceil((difference - np.pi) / turn))


def exponential(d: Numbers) -> list[Number]:
    """The quaternion that turns by a rotation vector, (3,)."""
    square = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    if value_of(square) > 1.0:
        angle = np.sqrt(square)
        return [np.cos(0.5 * angle), *(np.sin(0.5 * angle) / angle * each for each in d)]
    cosine: Number = 1.0
    sine: Number = 1.0
    for j in reversed(range(1, TERMS)):  # both are entire functions of the square
        cosine = 1.0 - 0.25 * square / ((2 * j - 1) * (2 * j)) * cosine
        sine = 1.0 - 0.25 * square / ((2 * j) * (2 * j + 1)) * sine
    return [cosine, *(0.5 * sine * each for each in d)]


def times(a: Numbers, b: Numbers) -> list[Number]:
    """Hamilton's product."""
    return [
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    ]


def conjugate(q: Numbers) -> list[Number]:
    """The turn back."""
    return [q[0], -q[1], -q[2], -q[3]]


def logarithm(q: Array) -> Array:
    """The rotation vector of a quaternion, at most half a turn, (3,)."""
    q = -q if q[0] < 0.0 else q
    size = float(np.linalg.norm(q[1:]))
    return np.asarray(q[1:] * (2.0 * np.arctan2(size, q[0]) / size if size else 2.0))


def unit(q: Array) -> Array:
    """The unit quaternion with w >= 0."""
    q = q / np.linalg.norm(q)
    return np.asarray(-q if q[0] < 0.0 else q)


def slopes_about(q: Numbers, seeds: int) -> Array:
    """Derivative of the rotation vector from the value of q to q, (3, seeds)."""
    value = values_of(q)
    turned = times(conjugate(list(value / (value @ value))), q)
    return 2.0 * jacobian_of(turned, seeds)[1:]


@dataclass(frozen=True, slots=True)
class Space:
    """The states of a model in order, one kind for each signal."""

    kinds: tuple[Kind, ...]

    @property
    def nx(self) -> int:
        """Numbers in a state."""
        return sum(4 if kind == "SO3" else 1 for kind in self.kinds)

    @property
    def ne(self) -> int:
        """Numbers in its error."""
        return sum(3 if kind == "SO3" else 1 for kind in self.kinds)

    def pieces(self) -> Iterator[tuple[Kind, slice, slice]]:
        """Every signal with its place in x and in errors."""
        at, of = 0, 0
        for kind in self.kinds:
            n, e = (4, 3) if kind == "SO3" else (1, 1)
            yield kind, slice(at, at + n), slice(of, of + e)
            at, of = at + n, of + e

    def plus(self, x: Numbers, d: Numbers) -> list[Number]:
        """The state that is an error away, of plain numbers or duals."""
        found: list[Number] = []
        for kind, at, of in self.pieces():
            if kind == "SO3":
                found += times(x[at], exponential(d[of]))
            else:
                found.append(x[at][0] + d[of][0])
        return found

    def advanced(self, x: Numbers, stated: Numbers, increments: frozenset[int]) -> list[Number]:
        """The state that f states: of some signals the rotation vector by which they turn."""
        found: list[Number] = []
        left = list(stated)
        for signal, (_, at, _) in enumerate(self.pieces()):
            turns = signal in increments
            size = 3 if turns else at.stop - at.start
            values, left = left[:size], left[size:]
            found += times(x[at], exponential(values)) if turns else values
        return found

    def moved(self, x: Array, d: Array) -> Array:
        """The state that is an error away, its quaternions of unit length, w >= 0."""
        return self.normal(np.array(self.plus(list(x), list(d)), float))

    def normal(self, x: Array) -> Array:
        """The state with unit quaternions, w >= 0."""
        x = x.astype(float)
        for kind, at, _ in self.pieces():
            if kind == "SO3":
                x[at] = unit(x[at])
        return x

    def minus(self, a: Array, b: Array) -> Array:
        """The error of a about b, (ne,)."""
        found = np.zeros(self.ne)
        for kind, at, of in self.pieces():
            if kind == "SO3":
                found[of] = logarithm(values_of(times(conjugate(b[at]), a[at])))
            else:
                found[of] = wrapped(a[at] - b[at]) if kind == "circle" else a[at] - b[at]
        return found

    def slopes(self, x: Numbers, seeds: int) -> Array:
        """Derivatives of the error about the value of x, (ne, seeds)."""
        rows = [
            slopes_about(x[at], seeds) if kind == "SO3" else jacobian_of(x[at], seeds)
            for kind, at, _ in self.pieces()
        ]
        return np.concatenate(rows)

    def turned(self, d: Array) -> Array:
        """T: what becomes of an error about x where the state moves on by d, (ne, ne).

        The derivative of ``(x + d + e) - (x + d)`` at e = 0: the right Jacobian of rotations.
        """
        T = np.eye(self.ne)
        for kind, _, of in self.pieces():
            if kind == "SO3":
                T[of, of] = slopes_about(exponential(seeded(d[of], 3)), 3)
        return T

    def mixture(self, weights: Array, x: Array, P: Array) -> Gaussian:
        """Mean and covariance of a mixture, computed about its first component; x (N, nx)."""
        errors = np.array([self.minus(each, x[0]) for each in x])
        back = np.array([np.linalg.inv(self.turned(e)) for e in errors])
        mean = weights @ errors
        spread = errors - mean
        within = np.einsum("i,iab,ibc,idc->ad", weights, back, P, back)
        T = self.turned(mean)
        covariance = T @ (within + np.einsum("i,ij,ik->jk", weights, spread, spread)) @ T.T
        return self.moved(x[0], mean), covariance
