"""exp, log, sqrt and friends in plain arithmetic: the same bits on every IEEE target.

Each function is a range reduction and a polynomial; the C templates and the Python reference below
perform the same operations in the same order. Coefficients are Taylor coefficients, or Chebyshev
fits where that halves the degree (`log`); accuracies are tested against libm.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partialmethod
from typing import Any

import numpy as np

from fkgen.backend.ir import Operator, Scalar

#: A NumPy scalar of the program's type.
Number = Any


@dataclass(frozen=True, slots=True, kw_only=True)
class Format:
    """Constants of one scalar type: IEEE 754 binary64 or binary32, and polynomial coefficients."""

    mantissa: int  # mantissa, bias: Bits of the fraction, and of the exponent's offset
    bias: int
    log: tuple[float, ...]  # p(z) with log((1 + s)/(1 - s)) = 2 s + s z p(z), z = s s
    exp: tuple[float, ...]  # q(r) with exp(r) = 1 + r + r r q(r)
    #: sin, cos, atan, sinh, cosh: Taylor coefficients, lowest first, of z = r r
    sin: tuple[float, ...]
    cos: tuple[float, ...]
    atan: tuple[float, ...]
    sinh: tuple[float, ...]
    cosh: tuple[float, ...]
    #: ln2, half_pi: The constant as a sum, leading parts with trailing zeros, so that multiples
    #: are exact
    ln2: tuple[float, float]
    half_pi: tuple[float, float, float]
    #: overflow, underflow: exp of them and beyond is infinite, and 0
    overflow: float
    underflow: float

    @property
    def one(self) -> int:
        """The bits of 1."""
        return self.bias << self.mantissa

    @property
    def root(self) -> int:
        """The bits of sqrt(1/2), the least m of a logarithm."""
        half = np.sqrt(np.float64(0.5) if self.mantissa > 30 else np.float32(0.5))
        return int(half.view(np.uint64 if self.mantissa > 30 else np.uint32))

    @property
    def whole(self) -> int:
        """The bits of 2^mantissa: a whole number below that is what is added to them."""
        return (self.bias + self.mantissa) << self.mantissa

    @property
    def rounder(self) -> float:
        """Added to x, it leaves the nearest k; its last bits are k + 2 bias."""
        return 1.5 * 2.0**self.mantissa + 2 * self.bias

    @property
    def even(self) -> int:
        """An even power of two that lifts every number to a normal one."""
        return (self.mantissa + 2) // 2 * 2


def _alternating(degree: int, divisor: Callable[[int], int]) -> tuple[float, ...]:
    return tuple((-1.0) ** k / divisor(k) for k in range(degree + 1))


def _format(degrees: tuple[int, ...], **constants: Any) -> Format:
    sin, cos, atan, sinh, cosh = degrees
    return Format(
        sin=_alternating(sin, lambda k: math.factorial(2 * k + 1)),
        cos=_alternating(cos, lambda k: math.factorial(2 * k)),
        atan=_alternating(atan, lambda k: 2 * k + 1),
        sinh=tuple(1.0 / math.factorial(2 * k + 1) for k in range(sinh + 1)),
        cosh=tuple(1.0 / math.factorial(2 * k) for k in range(cosh + 1)),
        **constants,
    )


_hex = float.fromhex

#: log, exp: Remez fits of least relative error, on (sqrt(1/2), sqrt(2)) and (-log(2)/2, log(2)/2),
#: coefficients rounded one after the other and those left fitted anew. They err by 2e-18 and 9e-20
#: in double, 9e-10 and 5e-9 in float.
FORMATS: dict[Scalar, Format] = {
    "double": _format(
        (8, 9, 12, 9, 7),
        mantissa=52,
        bias=1023,
        log=(
            *(0.6666666666666734, 0.39999999999416647, 0.2857142874212811, 0.22222198582835967),
            *(0.18183565069341553, 0.15313988675044787, 0.14797088738106787),
        ),
        exp=(
            *(0.5, 0.16666666666666688, 0.041666666666666824, 0.008333333333313899),
            *(0.0013888888888778448, 0.00019841269903338274, 2.4801587556699307e-05),
            *(2.7557228727660715e-06, 2.755707139322148e-07, 2.5113913158773574e-08),
            2.0976135952357417e-09,
        ),
        ln2=(_hex("0x1.62E42FEFp-1"), _hex("0x1.473DE6AF278EDp-34")),
        half_pi=tuple(map(_hex, ("0x1.921FB544p0", "0x1.0B4611A6p-34", "0x1.3198A2E037073p-69"))),
        overflow=710.0,
        underflow=-746.0,
    ),
    "float": _format(
        (4, 5, 5, 5, 4),
        mantissa=23,
        bias=127,
        log=(0.6666677594184875, 0.39977583289146423, 0.2987079620361328),
        exp=(
            *(0.5, 0.16666488349437714, 0.04166555032134056, 0.008372289128601551),
            0.0014035810017958283,
        ),
        ln2=(_hex("0x1.62E4p-1"), _hex("0x1.7F7D1CF8p-20")),
        half_pi=(_hex("0x1.92p0"), _hex("0x1.FB4p-12"), _hex("0x1.4442D18p-24")),
        overflow=89.0,
        underflow=-104.0,
    ),
}


def _size(x: Number) -> Number:
    """The magnitude as C asks for it: minus zero stays."""
    return -x if x < 0 else x


class Elementary:
    """The functions in NumPy scalars of one type, operation by operation as in C."""

    def __init__(self, scalar: Scalar) -> None:
        self.format = FORMATS[scalar]
        self.real = np.float64 if scalar == "double" else np.float32
        self._bits = np.uint64 if scalar == "double" else np.uint32
        self.tiny = self.real(2.0) ** self.real(1 - self.format.bias)

    def __call__(self, operator: Operator, arguments: list[Number]) -> Number:
        """Evaluate one function."""
        return getattr(self, operator.value)(*arguments)

    def _horner(self, coefficients: tuple[float, ...], x: Number) -> Number:
        result = self.real(coefficients[-1])
        for coefficient in reversed(coefficients[:-1]):
            result = result * x + self.real(coefficient)
        return result

    def _halves(self, coefficients: tuple[float, ...], x: Number, z: Number) -> Number:
        """The polynomial in x by its even and its odd powers, z = x x."""
        return self._horner(coefficients[0::2], z) + x * self._horner(coefficients[1::2], z)

    def _of_bits(self, bits: int) -> Number:
        return self._bits(bits).view(self.real)

    def log(self, x: Number) -> Number:
        """Natural logarithm; NaN below zero, -infinity at zero."""
        real, f = self.real, self.format
        if not x > 0:
            return real(-1.0) / real(0.0) if x == 0 else (x - x) / real(0.0)
        if x - x != 0:
            return x
        lift = f.mantissa + 2 if x < self.tiny else 0
        bits = int((x * real(2.0**lift)).view(self._bits))
        e = (bits + f.one - f.root) >> f.mantissa  # x = m 2^k, m from sqrt(1/2) to sqrt(2)
        m = self._of_bits(bits - (e << f.mantissa) + f.one) - real(1.0)
        k = real(e - f.bias - lift)
        s = m / (m + real(2.0))
        z = s * s
        p = z * self._halves(f.log, z, z * z)
        half = real(0.5) * m * m
        return k * real(f.ln2[0]) - ((half - (s * (half + p) + k * real(f.ln2[1]))) - m)

    def exp(self, x: Number) -> Number:
        """Exponential; 0 and infinity beyond the range."""
        real, f = self.real, self.format
        if np.isnan(x):
            return x
        x = min(max(x, real(f.underflow)), real(f.overflow))
        k = (x * real(1.0 / math.log(2.0)) + real(f.rounder)) - real(f.rounder)
        high, low = x - k * real(f.ln2[0]), k * real(f.ln2[1])
        r = high - low
        z = r * r
        y = real(1.0) + (high - (low - z * self._halves(f.exp, r, z)))
        e = int(k) + 2 * f.bias
        first = e >> 1
        return y * self._of_bits(first << f.mantissa) * self._of_bits((e - first) << f.mantissa)

    def floor(self, x: Number) -> Number:
        """Largest whole number that is not above x."""
        whole = self.real(2.0**self.format.mantissa)
        if not -whole < x < whole:
            return x
        result = self.real(int(x))
        return result - self.real(1.0) if result > x else result

    def sqrt(self, x: Number) -> Number:
        """Square root, rounded correctly."""
        return np.sqrt(x)

    def _wave(self, quarter: int, x: Number) -> Number:
        """Sine of x and some quarters of a turn; NaN beyond 1e5, where digits would get lost."""
        real, f = self.real, self.format
        if not abs(x) <= real(1e5):
            return (x - x) / real(0.0)
        half = real(0.5) if x >= 0 else real(-0.5)
        k = int(x * real(2.0 / math.pi) + half)
        n = real(k)
        r = ((x - n * real(f.half_pi[0])) - n * real(f.half_pi[1])) - n * real(f.half_pi[2])
        k += quarter
        z = r * r
        y = self._horner(f.cos, z) if k & 1 else r * self._horner(f.sin, z)
        return -y if k & 2 else y

    sin = partialmethod(_wave, 0)
    cos = partialmethod(_wave, 1)

    def tan(self, x: Number) -> Number:
        """Tangent, likewise."""
        return self.sin(x) / self.cos(x)

    def atan2(self, y: Number, x: Number) -> Number:
        """Angle of the point (x, y)."""
        real = self.real
        a, b = _size(y), _size(x)
        low, high = (a, b) if a <= b else (b, a)
        t = low / high if high > 0 else high + real(0.0)  # a NaN stays one
        for _ in range(2):
            t = t / (real(1.0) + self.sqrt(real(1.0) + t * t))
        angle = real(4.0) * (t * self._horner(self.format.atan, t * t))
        if not a <= b:
            angle = real(math.pi / 2.0) - angle
        if x < 0:
            angle = real(math.pi) - angle
        return -angle if y < 0 else angle

    def asin(self, x: Number) -> Number:
        """Arc sine; NaN outside [-1, 1]."""
        return self.atan2(x, self._opposite(x))

    def acos(self, x: Number) -> Number:
        """Arc cosine; NaN outside [-1, 1]."""
        return self.atan2(self._opposite(x), x)

    def _opposite(self, x: Number) -> Number:
        """The other leg of a triangle with hypotenuse 1."""
        one = self.real(1.0)
        return self.sqrt((one - x) * (one + x))

    def hypot(self, x: Number, y: Number) -> Number:
        """Length of (x, y), which overflows only if the result does."""
        a, b = _size(x), _size(y)
        low, high = (a, b) if a <= b else (b, a)
        if not low > 0:
            return low + high
        t = low / high
        return high * self.sqrt(self.real(1.0) + t * t)

    def _grown(self, a: Number) -> tuple[Number, Number]:
        """exp(a)/2 and exp(-a)/2 for a >= 0, where exp(a) alone may overflow."""
        real = self.real
        if a > real(self.format.overflow) - real(2.0):
            return self.exp(a - real(1.0)) * real(0.5 * math.e), real(0.0)
        e = self.exp(a)
        return real(0.5) * e, real(0.5) / e

    def sinh(self, x: Number) -> Number:
        """Hyperbolic sine, by its series near zero."""
        a = _size(x)
        if a <= self.real(1.0):
            return x * self._horner(self.format.sinh, x * x)
        rising, falling = self._grown(a)
        y = rising - falling
        return -y if x < 0 else y

    def cosh(self, x: Number) -> Number:
        """Hyperbolic cosine."""
        rising, falling = self._grown(_size(x))
        return rising + falling

    def tanh(self, x: Number) -> Number:
        """Hyperbolic tangent, by the series of sine and cosine near zero."""
        real, a = self.real, _size(x)
        if a <= real(0.55):
            z = x * x
            return x * self._horner(self.format.sinh, z) / self._horner(self.format.cosh, z)
        y = real(1.0) - real(2.0) / (self.exp(real(2.0) * a) + real(1.0))
        return -y if x < 0 else y
