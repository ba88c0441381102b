"""The error of an estimate: the state less its estimate, of angles and attitudes the shortest."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fkgen.problem import Signal
from fkgen.problem.equations import ARRAYS, normalised, turned

Array = NDArray[np.float64]

_TURN = 2.0 * np.pi
#: Below this length of the vector part, half an angle is its sine.
_NEAR = 1e-9


def errors_of(states: Sequence[Signal], truth: ArrayLike, estimate: ArrayLike) -> Array:
    """What has to be added to an estimate, (..., ne), of states (..., nx).

    Of an attitude the rotation vector d in body axes with truth = estimate * exp(d).
    """
    a, b = np.asarray(truth, np.float64), np.asarray(estimate, np.float64)
    if not any(each.wrap or each.manifold for each in states):
        return np.asarray(a - b)
    found: list[Array] = []
    for each, at, _ in _places(states):
        x, y = a[..., at], b[..., at]
        if each.manifold:
            found.append(_between(y, x))
        else:
            found.append(reduced(x - y) if each.wrap else x - y)
    return np.concatenate(found, axis=-1)


def moved_by(states: Sequence[Signal], x: ArrayLike, errors: ArrayLike) -> Array:
    """The states that lie off by errors (..., ne) from states (..., nx)."""
    origin, d = np.asarray(x, np.float64), np.asarray(errors, np.float64)
    found: list[Array] = []
    for each, at, of in _places(states):
        value, off = origin[..., at], d[..., of]
        if each.manifold:
            q = turned(numbers_of(value), numbers_of(off), ARRAYS)
            found.append(np.stack(normalised(q, ARRAYS), axis=-1))
        else:
            found.append(value + off)
    return np.concatenate(found, axis=-1)


def _places(states: Sequence[Signal]) -> Iterator[tuple[Signal, slice, slice]]:
    """Every state with its places among the numbers of x and among those of errors."""
    at = of = 0
    for each in states:
        size, part = (4, 3) if each.manifold else (1, 1)
        yield each, slice(at, at + size), slice(of, of + part)
        at, of = at + size, of + part


def numbers_of(vectors: Array) -> tuple[Array, ...]:
    """The numbers of vectors (..., m), m of (...)."""
    return tuple(np.moveaxis(vectors, -1, 0))


def error_sizes(states: Sequence[Signal], sizes: Array) -> Array:
    """How large errors are, (..., ne), where the numbers of states (..., nx) are off by so much.

    A quaternion that is off by e in its largest number turns by 2 e.
    """
    found: list[Array] = []
    for each, at, _ in _places(states):
        if each.manifold:
            turn = 2.0 * sizes[..., at].max(axis=-1, keepdims=True)
            found += [turn] * 3
        else:
            found.append(sizes[..., at])
    return np.concatenate(found, axis=-1)


def error_signals(states: Sequence[Signal]) -> tuple[Signal, ...]:
    """What the numbers of an error are: a state itself, of an attitude its three body axes."""
    parts: list[Signal] = []
    for each in states:
        axes = [f"{each.name}[{axis}]" for axis in "xyz"] if each.manifold else [each.name]
        parts += [Signal(name, "rad" if each.manifold else each.unit) for name in axes]
    return tuple(parts)


def reduced(angle: Any) -> Any:
    """The same angle in (-pi, pi]."""
    return angle + _TURN * np.floor(0.5 - angle / _TURN)


def _between(origin: Array, q: Array) -> Array:
    """The rotation vector that turns one attitude into another, (..., 3)."""
    w, v = origin[..., :1], origin[..., 1:]
    s, t = q[..., :1], q[..., 1:]
    real = w * s + (v * t).sum(axis=-1, keepdims=True)
    vector = w * t - s * v - np.cross(v, t)
    sign = np.where(real < 0.0, -1.0, 1.0)
    length = np.linalg.norm(vector, axis=-1, keepdims=True)
    near = length < _NEAR
    angle = 2.0 * np.arctan2(length, np.abs(real))
    return np.asarray(sign * vector * np.where(near, 2.0, angle / np.where(near, 1.0, length)))
