"""exp, log, sqrt and friends in plain arithmetic: the same bits on every IEEE target.

Each function is a range reduction and a polynomial; the C templates and the Python reference below
perform the same operations in the same order. Coefficients are Taylor coefficients, or Chebyshev
fits where that halves the degree (`log`); accuracies are tested against libm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partialmethod
from typing import Any

import numpy as np

from fkgen.backend.ir import Operator, Scalar

#: A NumPy scalar of the program's type.
Number = Any
#: A number as a head less what the head exceeds it by.
Pair = tuple[Number, Number]


@dataclass(frozen=True, slots=True, kw_only=True)
class Format:
    """Constants of one scalar type: IEEE 754 binary64 or binary32, and polynomial coefficients."""

    mantissa: int  # mantissa, bias: Bits of the fraction, and of the exponent's offset
    bias: int
    log: tuple[float, ...]  # p(z) with log((1 + s)/(1 - s)) = 2 s + s z p(z), z = s s
    exp: tuple[float, ...]  # q(r) with exp(r) = 1 + r + r r q(r)
    sin: tuple[float, ...]  # p(z) with sin(r) = r + r z p(z), z = r r
    cos: tuple[float, ...]  # p(z) with cos(r) = 1 - z/2 + z z p(z)
    tan: tuple[float, ...]  # p(z) with 2 tan(r/2) = r + r z p(z), z = r r
    atan: tuple[float, ...]  # p(z) with atan(q) = q + q z p(z), z = q q
    asin: tuple[float, ...]  # p(z) with asin(v) = v + v z p(z), z = v v
    #: ln2, half_pi, quarter_pi: The constant as a sum, leading parts with trailing zeros, so that
    #: multiples are exact
    ln2: tuple[float, float]
    quarter_pi: tuple[float, float]
    half_pi: tuple[float, ...]
    #: overflow, underflow: exp of them and beyond is infinite, and 0
    overflow: float
    underflow: float

    @property
    def eighth(self) -> float:
        """tan(pi/8): beyond this quotient an angle is counted from pi/4."""
        return math.tan(math.pi / 8.0)

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
    def sign(self) -> int:
        """The bit of the sign."""
        return 1 << (self.mantissa + self.bias.bit_length() + 1)

    @property
    def upper(self) -> int:
        """A mask of the upper half of a significand, whose square is exact."""
        half = self.mantissa // 2 + 1
        return (2 * self.sign - 1) >> half << half

    @property
    def far(self) -> int:
        """Squares of numbers from 2^-far to 2^far are normal, and so is their unit of rounding."""
        return self.bias // 2 - 11

    @property
    def unit(self) -> int:
        """The power of two that brings all others between these."""
        return self.bias + self.mantissa - self.far

    @property
    def even(self) -> int:
        """An even power of two that lifts every number to a normal one."""
        return (self.mantissa + 2) // 2 * 2


_hex = float.fromhex

#: log, exp: Remez fits of least relative error, on (sqrt(1/2), sqrt(2)) and (-log(2)/2, log(2)/2),
#: coefficients rounded one after the other and those left fitted anew. They err by 2e-18 and 9e-20
#: in double, 9e-10 and 5e-10 in float; tan, on (-pi/4, pi/4), by 2e-18 and 2e-9.
FORMATS: dict[Scalar, Format] = {
    "double": Format(
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
        sin=(
            -0.1666666666666663,
            0.00833333333332184,
            -0.00019841269829358644,
            2.7557313538593055e-06,
            -2.505073442971143e-08,
            1.5895439353100722e-10,
        ),
        cos=(
            0.041666666666666595,
            -0.0013888888888873338,
            2.4801587288996726e-05,
            -2.755731421479159e-07,
            2.0875705007432117e-09,
            -1.1358725475176406e-11,
        ),
        tan=(
            *(0.08333333333333376, 0.008333333333305715, 0.0008432539688701921),
            *(8.5427682865717e-05, 8.655544908352053e-06, 8.768306484372367e-07),
            *(8.920609471371218e-08, 8.531395175155176e-09, 1.2540510025690095e-09),
        ),
        atan=(
            -0.333333333333332,
            0.19999999999953672,
            -0.14285714280183792,
            0.11111110781878467,
            -0.0909089769246056,
            0.07692058835454084,
            -0.0666308719101043,
            0.058477655887819655,
            -0.05038767884096675,
            0.03805190369340053,
            -0.017894758614626697,
        ),
        asin=(
            0.1666666666666666,
            0.07500000000002384,
            0.04464285713982725,
            0.03038194463775042,
            0.022372151807556067,
            0.01735294138255033,
            0.013961923606315273,
            0.011585539563931548,
            0.009484574677601415,
            0.010009050510717146,
            0.0006761860916763652,
            0.024858382025754355,
            -0.02621567519471982,
            0.03369649092254303,
        ),
        quarter_pi=(_hex("0x1.921fb54442d18p-1"), _hex("0x1.1a62633145c07p-55")),
        ln2=(_hex("0x1.62E42FEFp-1"), _hex("0x1.473DE6AF278EDp-34")),
        half_pi=tuple(map(_hex, ("0x1.921FB544p0", "0x1.0B4611A6p-34", "0x1.3198A2E037073p-69"))),
        overflow=710.0,
        underflow=-746.0,
    ),
    "float": Format(
        mantissa=23,
        bias=127,
        log=(0.6666677594184875, 0.39977583289146423, 0.2987079620361328),
        exp=(
            *(0.5, 0.16666647791862488, 0.041666481643915176, 0.008337867446243763),
            *(0.001393331796862185, 0.0001733816316118464),
        ),
        sin=(-0.16666655, 0.008332189, -0.00019518285),
        cos=(0.041666646, -0.001388731, 2.443237e-05),
        tan=(0.08333323150873184, 0.008334930986166, 0.000835536397062242, 9.985448559746146e-05),
        atan=(-0.33333316, 0.19998528, -0.14244393, 0.1059919, -0.06090127),
        asin=(0.16666752, 0.074953094, 0.045469433, 0.024181692, 0.0421664),
        quarter_pi=(_hex("0x1.921fb00000000p-1"), _hex("0x1.5110b40000000p-23")),
        ln2=(_hex("0x1.62E4p-1"), _hex("0x1.7F7D1CF8p-20")),
        half_pi=tuple(map(_hex, ("0x1.92p0", "0x1.FAp-12", "0x1.54p-20", "0x1.10b4620000000p-30"))),
        overflow=89.0,
        underflow=-104.0,
    ),
}


def _size(x: Number) -> Number:
    """The magnitude as C asks for it: minus zero stays."""
    return -x if x < 0 else x


def _sum(large: Number, small: Number, rest: Number) -> Pair:
    """The sum large + small - rest, of which the first is the largest or 0, as such a pair."""
    total = large + small
    return total, ((total - large) - small) + rest


def _joined(large: Number, small: Number, rest: Number) -> Number:
    """The same, all but exact."""
    total, excess = _sum(large, small, rest)
    return total - excess


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

    def _upper(self, x: Number) -> Number:
        """The upper half of a significand."""
        return self._of_bits(int(x.view(self._bits)) & self.format.upper)

    def _excess(self, q: Number, below: Number, above: Number) -> Number:
        """What q below exceeds above by, where q is nearly their quotient: by halves of factors."""
        upper, part = self._upper(q), self._upper(below)
        return ((upper * part - above) + upper * (below - part)) + (q - upper) * below

    def _quotient(self, above: Pair, below: Pair) -> Pair:
        """The quotient of two such numbers."""
        inverse = self.real(1.0) / below[0]
        q = above[0] * inverse
        excess = self._excess(q, below[0], above[0])
        return q, ((excess + above[1]) - q * below[1]) * inverse

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

    def _reduced(self, x: Number) -> tuple[Pair, int]:
        """r, as a pair, and k, with x = r + k pi/2."""
        real, f = self.real, self.format
        offset = real(1.5 * 2.0**f.mantissa)
        k = (x * real(2.0 / math.pi) + offset) - offset
        *exact, middle, small = (k * real(part) for part in f.half_pi)
        near = x
        for part in exact:
            near = near - part
        first = near - middle
        excess = ((first - near) + middle) + small
        r = first - excess
        return (r, (r - first) + excess), int(k)

    def _wave(self, quarter: int, x: Number) -> Number:
        """Sine of x and some quarters of a turn; NaN beyond 1e5, where digits would get lost."""
        real, f = self.real, self.format
        if not abs(x) <= real(1e5):
            return (x - x) / real(0.0)
        (r, excess), k = self._reduced(x)
        one, z = real(1.0), r * r
        w = z * z
        if (k + quarter) & 1:
            rest = w * self._halves(f.cos, z, w) + r * excess
            z = real(0.5) * z
            y = one - z
            y = y - ((z - (one - y)) - rest)
        else:
            y = r - (excess - r * (z * self._halves(f.sin, z, w)))
        return -y if (k + quarter) & 2 else y

    sin = partialmethod(_wave, 0)
    cos = partialmethod(_wave, 1)

    def tan(self, x: Number) -> Number:
        """Tangent, likewise: that of r, by half the angle, or -1 over it."""
        real, f = self.real, self.format
        if not abs(x) <= real(1e5):
            return (x - x) / real(0.0)
        (r, less), k = self._reduced(x)
        one, z = real(1.0), r * r
        excess = less - r * (z * self._halves(f.tan, z, z * z))
        y = r - excess  # with what it exceeds it by, 2 tan(r/2)
        square = y * y
        quarter = real(0.25) * square
        excess = ((y - r) + excess) + less * quarter
        below = one - quarter
        lost = real(0.5) * (y * excess) - real(0.25) * self._excess(y, y, square)
        pair, other = (y, excess), (below, ((below - one) + quarter) - lost)
        if k & 1:
            pair, other = (-other[0], -other[1]), pair
        q, excess = self._quotient(pair, other)
        return q - excess

    def atan2(self, y: Number, x: Number) -> Number:
        """Angle of the point (x, y)."""
        real, f = self.real, self.format
        a, b = abs(y), abs(x)
        low, high = (a, b) if a <= b else (b, a)
        scale = real(1.0)  # its reciprocal is neither infinite nor subnormal then
        if high > real(2.0 ** (f.bias - 3)):
            scale = real(2.0**-4)
        elif high < real(2.0**-f.far):
            scale = real(2.0**f.unit)
        low, high = scale * low, scale * high
        k, more, less = real(0.0), real(0.0), real(0.0)
        if low > high * real(f.eighth):
            k, more, less = real(1.0), low, high
        above, below = low - less, high + more
        inverse = real(1.0) / below if below > 0 else low + high  # a NaN stays one
        q = above * inverse
        lost = ((above + less) - low) + q * ((high - below) + more)  # by difference and sum
        rest = (self._excess(q, below, above) + lost) * inverse if below - below == 0 else real(0.0)
        if not a <= b:
            q, rest, k = -q, -rest, real(2.0) - k
        if np.signbit(x):
            q, rest, k = -q, -rest, real(4.0) - k
        z = q * q
        rest = (rest - q * (z * self._halves(f.atan, z, z * z))) - k * real(f.quarter_pi[1])
        angle = _joined(k * real(f.quarter_pi[0]), q, rest)
        return -angle if np.signbit(y) else angle

    def _arc(self, cosine: int, x: Number) -> Number:
        """Arc sine or arc cosine; NaN outside [-1, 1]."""
        real, f = self.real, self.format
        a, sign, one = _size(x), real(-1.0 if x < 0 else 1.0), real(1.0)
        z, v, h, k, factor = x * x, x, x, real(-0.0), one
        if a > real(0.5):
            z, k, factor = real(0.5) * (one - a), sign, real(-2.0) * sign
            v = self.sqrt(z)
            h = self._upper(v)
        if cosine:
            k, factor = one - k, -factor
        lost = (h * h - z) / (h + v) if h + v > 0 else real(0.0)  # by the rounding of v
        rest = factor * (lost - v * (z * self._halves(f.asin, z, z * z)))
        pair = [real(2.0 * part) for part in f.quarter_pi]
        return _joined(k * pair[0], factor * h, rest - k * pair[1])

    asin = partialmethod(_arc, 0)
    acos = partialmethod(_arc, 1)

    def hypot(self, x: Number, y: Number) -> Number:
        """Length of (x, y), which overflows only if the result does."""
        real, f = self.real, self.format
        a, b = _size(x), _size(y)
        most = max(b, a)
        unit = f.unit if most < real(2.0**-f.far) else -f.unit if most > real(2.0**f.far) else 0
        large, small = real(2.0**unit) * most, real(2.0**unit) * (min(a, b))
        square = small * small
        h = self.sqrt(large * large + square)
        if h > 0 and h - h == 0:
            d = h - large
            h = h + ((square - (large + large) * d) - d * d) / (h + h)
        return real(2.0**-unit) * h

    def _grown(self, a: Number) -> tuple[Pair, int]:
        """e, as a pair, and k, with exp(a) = (1 + e) 2^k, for a from 0 on."""
        real, f = self.real, self.format
        a = min(a, real(f.overflow + 1.0))
        k = (a * real(1.0 / math.log(2.0)) + real(f.rounder)) - real(f.rounder)
        high, low = a - k * real(f.ln2[0]), k * real(f.ln2[1])
        r = high - low
        z = r * r
        half = real(f.exp[0]) * z
        low = (low - z * (r * self._halves(f.exp[1:], r, z))) - half
        head = high - low
        return (head, (head - high) + low), int(k)

    def _hyperbolic(self, sign: float, x: Number) -> Number:
        """(exp(a) - sign exp(-a))/2, a = |x|: with exp(a) = (1 + e) 2^k in units of 2^k/2."""
        real, f = self.real, self.format
        if np.isnan(x):
            return x
        e, k = self._grown(abs(x))
        unit = self._of_bits((f.bias - k) << f.mantissa if k < f.bias else 0)  # 2^-k, or 0
        unit = real(sign) * unit * unit
        q, excess = self._quotient(e, _sum(real(1.0), *e))
        one, lost = _sum(real(1.0), -unit, real(0.0))
        small, excess = _sum(e[0], unit * q, e[1] + unit * excess)
        y = real(0.5) * _joined(one, small, excess + lost)
        first = (k + 2 * f.bias) >> 1
        second = k + 2 * f.bias - first
        return y * self._of_bits(first << f.mantissa) * self._of_bits(second << f.mantissa)

    def sinh(self, x: Number) -> Number:
        """Hyperbolic sine."""
        return np.copysign(self._hyperbolic(1.0, x), x)

    def cosh(self, x: Number) -> Number:
        """Hyperbolic cosine."""
        return self._hyperbolic(-1.0, x)

    def tanh(self, x: Number) -> Number:
        """Hyperbolic tangent: (exp(2 a) - 1)/(exp(2 a) + 1), a = |x|, in units of 2^k."""
        real, f = self.real, self.format
        if np.isnan(x):
            return x
        e, k = self._grown(abs(x) + abs(x))
        unit = self._of_bits((f.bias - k) << f.mantissa if k < f.bias else 0)
        sums = []
        for part in (-unit, unit):
            one, lost = _sum(real(1.0), part, e[1])
            sums.append(_sum(one, e[0], lost))
        q, excess = self._quotient(*sums)
        return np.copysign(q - excess, x)
