"""Unit quaternions (w, x, y, z), body to world, and rotation vectors in body axes, as CasADi.

An attitude q is turned by a rotation vector d as q * exp(d). Sola 2017, "Quaternion kinematics for
the error-state Kalman filter"; right Jacobian: Chirikjian 2012, eq. (10.86).
"""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca

#: Below this square of an angle closed forms lose digits, and three terms of their series do.
SMALL = 1e-6

#: No square of an angle is zero, and none that has an effect changes.
NOTHING = 1e-30

#: Below this square of the vector part the logarithm takes three terms of its series.
NEAR = 1e-5


def _below(value: ca.SX, limit: float, a: ca.SX, b: ca.SX) -> ca.SX:
    """The finite value ``a`` where ``value`` is below a limit, else the finite value ``b``."""
    first = ca.SX.binary(ca.OP_IF_ELSE_ZERO, value < limit, a)
    return first + ca.SX.binary(ca.OP_IF_ELSE_ZERO, limit <= value, b)


def _of_square(square: ca.SX, series: tuple[float, ...], closed: Callable[..., ca.SX]) -> ca.SX:
    """A function of an angle by its square: near zero by its series."""
    far = _below(square, SMALL, ca.SX(1), square)
    polynomial = ca.SX(series[-1])
    for coefficient in reversed(series[:-1]):
        polynomial = coefficient + square * polynomial
    return _below(square, SMALL, polynomial, closed(far, ca.sqrt(far)))


def squared(d: ca.SX) -> ca.SX:
    """D' d."""
    return d[0] * d[0] + d[1] * d[1] + d[2] * d[2]


def _of_half(d: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """The square of an angle, and of its half the sine, over the angle, and the cosine."""
    square = squared(d) + NOTHING
    angle = ca.sqrt(square)
    half = 0.5 * angle
    return square, ca.sin(half) / angle, ca.cos(half)


def exponential(d: ca.SX) -> ca.SX:
    """The quaternion of a rotation vector, (4, 1); its derivative loses digits near zero."""
    _, sine, cosine = _of_half(d)
    return ca.vertcat(cosine, sine * d)


def smooth_exponential(d: ca.SX) -> ca.SX:
    """The same, to be differentiated."""
    square = squared(d)
    sine = _of_square(square, (1 / 2, -1 / 48, 1 / 3840), lambda _, a: ca.sin(a / 2) / a)
    cosine = _of_square(square, (1.0, -1 / 8, 1 / 384), lambda _, a: ca.cos(a / 2))
    return ca.vertcat(cosine, sine * d)


def logarithm(q: ca.SX) -> ca.SX:
    """The shortest rotation vector of a quaternion, (3, 1)."""
    scale = _below(q[0], 0.0, ca.SX(-1), ca.SX(1))
    w, v = scale * q[0], scale * q[1:]
    square = squared(v)
    length = ca.sqrt(_below(square, NEAR, ca.SX(1), square))
    cosine = _below(square, NEAR, w, ca.SX(1))
    ratio = square / (cosine * cosine)
    series = (2 - ratio * (2 / 3) + ratio * ratio * (2 / 5)) / cosine
    return _below(square, NEAR, series, 2 * ca.atan2(length, w) / length) * v


def product(p: ca.SX, q: ca.SX) -> ca.SX:
    """The quaternion of one rotation in the axes of another, (4, 1)."""
    return ca.vertcat(
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] + p[2] * q[0] + p[3] * q[1] - p[1] * q[3],
        p[0] * q[3] + p[3] * q[0] + p[1] * q[2] - p[2] * q[1],
    )


def conjugate(q: ca.SX) -> ca.SX:
    """The opposite rotation."""
    return ca.vertcat(q[0], -q[1:])


def normalised(q: ca.SX) -> ca.SX:
    """The unit quaternion of the same rotation whose w is not negative."""
    length = ca.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return q / _below(q[0], 0.0, -length, length)


def renewed(q: ca.SX) -> ca.SX:
    """The same of a product of unit quaternions, whose length is off by rounding alone."""
    length = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
    return (1.5 - 0.5 * length) * (1 - 2 * (q[0] < 0)) * q


def within(q: ca.SX, tolerance: float) -> list[ca.SX]:
    """What is not negative where four numbers are so near to unit length."""
    apart = ca.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]) - 1
    return [tolerance - apart, apart + tolerance]


def scaled_to_unit(q: ca.SX, rounded: float) -> ca.SX:
    """`normalised`, but for what is unit but for rounding: as it is, or the opposite."""
    near = ca.fmax(*(-each for each in within(q, rounded)))
    sign = _below(q[0], 0.0, ca.SX(-1), ca.SX(1))
    return _below(near, 0.0, sign * q, normalised(q))


def matrix(q: ca.SX) -> ca.SX:
    """The rotation matrix, (3, 3), from body to world."""
    w, x, y, z = ca.vertsplit(q)
    doubled = 2 * q
    _, x2, y2, z2 = ca.vertsplit(doubled)
    return ca.blockcat(
        [
            [1 - (y * y2 + z * z2), x * y2 - w * z2, x * z2 + w * y2],
            [x * y2 + w * z2, 1 - (x * x2 + z * z2), y * z2 - w * x2],
            [x * z2 - w * y2, y * z2 + w * x2, 1 - (x * x2 + y * y2)],
        ]
    )


def right_jacobian(d: ca.SX) -> ca.SX:
    """D log(exp(d)^-1 exp(d + e)) / de at e = 0, (3, 3)."""
    square, sine, cosine = _of_half(d)
    first, second = 2 * sine * sine, (1 - 2 * sine * cosine) / square  # lost digits are times d d'
    return _polynomial(d, -first, second)


def inverse_right_jacobian(d: ca.SX) -> ca.SX:
    """The inverse of `right_jacobian`, for angles below a full turn."""
    square, sine, cosine = _of_half(d)
    return _polynomial(d, ca.SX(0.5), (1 - 0.5 * cosine / sine) / square)


def _polynomial(d: ca.SX, first: ca.SX, second: ca.SX) -> ca.SX:
    """1 + first (d x) + second (d x)^2."""
    scaled, turned = ca.vertsplit(second * d), ca.vertsplit(first * d)
    squares = [a * b for a, b in zip(scaled, ca.vertsplit(d), strict=True)]
    result = ca.SX(3, 3)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        result[i, i] = 1 - (squares[j] + squares[k])
        both = scaled[i] * d[j]
        result[i, j], result[j, i] = both - turned[k], both + turned[k]
    return result


def pushed(q: ca.SX) -> ca.SX:
    """D (q * exp(d)) / dd at d = 0, (4, 3)."""
    w, x, y, z = ca.vertsplit(q / 2)
    return ca.blockcat([[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]])


def pulled(q: ca.SX) -> ca.SX:
    """D log(q^-1 p) / dp at p = q, a unit quaternion, (3, 4)."""
    return 4 * pushed(q).T
