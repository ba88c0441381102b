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
    #: exp, sin, cos, atan, sinh, cosh: Taylor coefficients, lowest first: of r, and of z = r r
    exp: tuple[float, ...]
    sin: tuple[float, ...]
    cos: tuple[float, ...]
    atan: tuple[float, ...]
    sinh: tuple[float, ...]
    cosh: tuple[float, ...]
    #: ln2, half_pi: The constant as a sum, leading parts with trailing zeros, so that multiples
    #: are exact
    ln2: tuple[float, float]
    half_pi: tuple[float, float, float]
    overflow: float
    underflow: float


def _alternating(degree: int, divisor: Callable[[int], int]) -> tuple[float, ...]:
    return tuple((-1.0) ** k / divisor(k) for k in range(degree + 1))


def _format(degrees: tuple[int, ...], **constants: Any) -> Format:
    exp, sin, cos, atan, sinh, cosh = degrees
    return Format(
        exp=tuple(1.0 / math.factorial(k) for k in range(exp + 1)),
        sin=_alternating(sin, lambda k: math.factorial(2 * k + 1)),
        cos=_alternating(cos, lambda k: math.factorial(2 * k)),
        atan=_alternating(atan, lambda k: 2 * k + 1),
        sinh=tuple(1.0 / math.factorial(2 * k + 1) for k in range(sinh + 1)),
        cosh=tuple(1.0 / math.factorial(2 * k) for k in range(cosh + 1)),
        **constants,
    )


_hex = float.fromhex

#: log: Chebyshev fits on z < (sqrt(2) - 1)^4; they err by 5e-18 and 2e-11 of the logarithm.
FORMATS: dict[Scalar, Format] = {
    "double": _format(
        (13, 8, 9, 12, 9, 7),
        mantissa=52,
        bias=1023,
        log=(
            *(0.666666666666667, 0.39999999999899505, 0.28571428625975487, 0.2222221113479508),
            *(0.18182889125261723, 0.15331721600556042, 0.14616449685043406),
        ),
        ln2=(_hex("0x1.62E42FEFp-1"), _hex("0x1.473DE6AF278EDp-34")),
        half_pi=tuple(map(_hex, ("0x1.921FB544p0", "0x1.0B4611A6p-34", "0x1.3198A2E037073p-69"))),
        overflow=709.782712893384,
        underflow=-745.1332191019411,
    ),
    "float": _format(
        (7, 4, 5, 5, 5, 4),
        mantissa=23,
        bias=127,
        log=(0.6666666655449709, 0.40000121839806124, 0.28550820815960665, 0.23330467216303835),
        ln2=(_hex("0x1.62E4p-1"), _hex("0x1.7F7D1CF8p-20")),
        half_pi=(_hex("0x1.92p0"), _hex("0x1.FB4p-12"), _hex("0x1.4442D18p-24")),
        overflow=88.72283,
        underflow=-103.97208,
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

    def _power_of_two(self, exponent: int) -> Number:
        bits = self._bits((exponent + self.format.bias) << self.format.mantissa)
        return bits.view(self.real)

    def log(self, x: Number) -> Number:
        """Natural logarithm; NaN below zero, -infinity at zero."""
        real, f = self.real, self.format
        if not x > 0:
            return real(-1.0) / real(0.0) if x == 0 else (x - x) / real(0.0)
        if x - x != 0:
            return x
        shift = 0
        if x < self.tiny:
            x, shift = x * self._power_of_two(f.mantissa + 2), f.mantissa + 2
        bits, one = int(x.view(self._bits)), f.bias << f.mantissa
        e = (bits >> f.mantissa) - f.bias - shift  # x = m 2^e with m in [1, 2)
        m: Number = self._bits((bits & ((1 << f.mantissa) - 1)) | one).view(real)
        if m > real(math.sqrt(2.0)):
            m, e = m * real(0.5), e + 1
        t = m - real(1.0)
        s = t / (t + real(2.0))
        z = s * s
        w = z * z
        p = self._horner(f.log[0::2], w) + z * self._horner(f.log[1::2], w)
        k = real(e)
        return k * real(f.ln2[0]) + ((s * z * p + k * real(f.ln2[1])) + (s + s))

    def exp(self, x: Number) -> Number:
        """Exponential; 0 and infinity beyond the range."""
        real, f = self.real, self.format
        if np.isnan(x):
            return x
        if x > real(f.overflow):
            return real(np.inf)
        if x < real(f.underflow):
            return real(0.0)
        half = real(0.5) if x >= 0 else real(-0.5)
        k = int(x * real(1.0 / math.log(2.0)) + half)
        n = real(k)
        r = (x - n * real(f.ln2[0])) - n * real(f.ln2[1])
        y = self._horner(f.exp, r)
        first = int(k / 2)
        return y * self._power_of_two(first) * self._power_of_two(k - first)

    def floor(self, x: Number) -> Number:
        """Largest whole number that is not above x."""
        whole = self.real(2.0**self.format.mantissa)
        if not -whole < x < whole:
            return x
        result = self.real(int(x))
        return result - self.real(1.0) if result > x else result

    def sqrt(self, x: Number) -> Number:
        """Square root by Newton's iteration from a guess that halves the exponent."""
        real, f = self.real, self.format
        if not x > 0:
            return x if x == 0 else (x - x) / real(0.0)
        if x - x != 0:
            return x
        back = real(1.0)
        if x < self.tiny:
            even = (f.mantissa + 2) // 2 * 2
            x, back = x * self._power_of_two(even), self._power_of_two(-even // 2)
        bits = int(x.view(self._bits))
        guess = (bits >> 1) + (f.bias << (f.mantissa - 1))
        y: Number = self._bits(guess).view(self.real)
        for _ in range(6):
            y = real(0.5) * (y + x / y)
        return y * back

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
        if a > real(self.format.overflow) - real(1.0):
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
