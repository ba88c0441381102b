"""a b + c rounded once, in Python: what fma() of C has to give, whatever the machine has of it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

#: A NumPy scalar of the program's type.
Number = Any


def fma(a: Number, b: Number, c: Number) -> Number:
    """The number of their type that is nearest to a b + c, of two the even one."""
    single = isinstance(a, np.float32)
    rounded = (_single if single else _double)(float(a), float(b), float(c))
    return np.float32(rounded) if single else np.float64(rounded)


def _double(a: float, b: float, c: float) -> float:
    """By integers, for the quotient of two of them is rounded once, down to the last subnormal."""
    if math.isfinite(a) and math.isfinite(b) and not math.isfinite(c):
        return c
    if not (math.isfinite(a) and math.isfinite(b) and a and b):  # the product is exact
        return a * b + c
    (p, p_below), (q, q_below), (r, r_below) = (each.as_integer_ratio() for each in (a, b, c))
    below = p_below * q_below
    total = p * q * r_below + r * below
    try:
        return total / (below * r_below)
    except OverflowError:
        return math.inf if total > 0 else -math.inf


def _single(a: float, b: float, c: float) -> float:
    """A double that float rounds as it would the exact sum of floats: the odd one beside it.

    References
    ----------
    Boldo and Melquiond 2008, *Emulation of a FMA and correctly rounded sums: proved algorithms
    using rounding to odd*, IEEE Trans. Computers 57.
    """
    product = a * b  # exact: 48 bits, and no float is too far from 1
    total = product + c
    if not math.isfinite(total):
        return total
    part = total - product
    rest = (product - (total - part)) + (c - part)  # what the sum lost (Knuth)
    if rest and int(math.frexp(total)[0] * 2.0**53) % 2 == 0:
        total = math.nextafter(total, math.copysign(math.inf, rest))
    return total
