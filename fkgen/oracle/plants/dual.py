"""Forward-mode derivatives: numbers that carry what becomes of a few seeds.

A `Dual` behaves as a NumPy scalar: operators and ufuncs (``np.sin(x)``) take it, alone or mixed
with plain numbers, and comparisons see its value. ``np.where`` and the look-up of a table work too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from fkgen.oracle.exact.gaussian import Array

#: A number of a model: a float, an array of them, or a Dual.
Number: TypeAlias = Any
Numbers: TypeAlias = Sequence[Any] | Array

Partial = Callable[..., Any]


def _by_base(a: Number, b: Number) -> Number:
    return np.where(b == 0.0, 0.0, b * np.power(a, np.where(b == 0.0, 1.0, b - 1.0)))


#: Partial derivatives of ufuncs, one for each argument; a derivative at a kink is that to the right
_PARTIALS: dict[Any, tuple[Partial, ...]] = {
    np.add: (lambda _, __: 1.0, lambda _, __: 1.0),
    np.subtract: (lambda _, __: 1.0, lambda _, __: -1.0),
    np.multiply: (lambda _, b: b, lambda a, _: a),
    np.divide: (lambda _, b: 1.0 / b, lambda a, b: -a / b / b),
    np.power: (_by_base, lambda a, b: np.log(a) * np.power(a, b)),
    np.arctan2: (
        lambda a, b: b / (a * a + b * b),
        lambda a, b: -a / (a * a + b * b),
    ),
    np.hypot: (lambda a, b: a / np.hypot(a, b), lambda a, b: b / np.hypot(a, b)),
    np.maximum: (lambda a, b: 1.0 * (a >= b), lambda a, b: 1.0 * (a < b)),
    np.minimum: (lambda a, b: 1.0 * (a <= b), lambda a, b: 1.0 * (a > b)),
    np.negative: (lambda _: -1.0,),
    np.positive: (lambda _: 1.0,),
    np.absolute: (lambda a: np.where(a < 0.0, -1.0, 1.0),),
    np.sign: (lambda _: 0.0,),
    np.square: (lambda a: 2.0 * a,),
    np.sqrt: (lambda a: 0.5 / np.sqrt(a),),
    np.exp: (np.exp,),
    np.log: (lambda a: 1.0 / a,),
    np.sin: (np.cos,),
    np.cos: (lambda a: -np.sin(a),),
    np.tan: (lambda a: 1.0 + np.tan(a) ** 2,),
    np.arcsin: (lambda a: 1.0 / np.sqrt(1.0 - a * a),),
    np.arccos: (lambda a: -1.0 / np.sqrt(1.0 - a * a),),
    np.arctan: (lambda a: 1.0 / (1.0 + a * a),),
    np.sinh: (np.cosh,),
    np.cosh: (np.sinh,),
    np.tanh: (lambda a: 1.0 - np.tanh(a) ** 2,),
}
#: What sees the value alone.
_PLAIN: set[Any] = {np.less, np.less_equal, np.greater, np.greater_equal, np.equal, np.not_equal}
_PLAIN |= {np.isfinite, np.isnan}


class Dual(np.lib.mixins.NDArrayOperatorsMixin):
    """A number and its derivatives with respect to m seeds."""

    __slots__ = ("slopes", "value")

    def __init__(self, value: ArrayLike, slopes: ArrayLike) -> None:
        """Take a value of any shape (...) and its slopes (..., m)."""
        self.value = np.asarray(value, float)
        self.slopes = np.asarray(slopes, float)

    def __array_ufunc__(self, ufunc: Any, method: str, *arguments: Any, **options: Any) -> Any:
        """Compute a function and the chain rule."""
        if method != "__call__" or options:
            return NotImplemented
        values = [value_of(each) for each in arguments]
        if ufunc in _PLAIN:
            return ufunc(*values)
        if ufunc not in _PARTIALS:
            return NotImplemented
        slopes: Any = 0.0
        for argument, partial in zip(arguments, _PARTIALS[ufunc], strict=True):
            if isinstance(argument, Dual):
                slopes = slopes + np.asarray(partial(*values))[..., None] * argument.slopes
        return Dual(ufunc(*values), slopes)

    def __array_function__(self, function: Any, _: Any, arguments: Any, options: Any) -> Any:
        """Choose by a condition, or find an interval."""
        if function is np.where and len(arguments) == 3:
            condition, first, second = arguments
            chosen = value_of(condition)
            value = np.where(chosen, value_of(first), value_of(second))
            width = self.slopes.shape[-1]
            sides = (slopes_of(side, width) for side in (first, second))
            return Dual(value, np.where(np.asarray(chosen)[..., None], *sides))
        if function is np.searchsorted:
            return np.searchsorted(*map(value_of, arguments), **options)
        return NotImplemented


def value_of(number: Number) -> Any:
    """The number without its derivatives."""
    return number.value if isinstance(number, Dual) else number


def slopes_of(number: Number, seeds: int) -> Array:
    """The derivatives of a number: zeros where it is a plain one."""
    if isinstance(number, Dual):
        return number.slopes
    return np.zeros((*np.shape(number), seeds))


def seeded(values: ArrayLike, seeds: int, first: int = 0) -> list[Dual]:
    """The entries of a vector (n,) as the seeds from the first one on, of all seeds."""
    vector = np.asarray(values, float)
    return [Dual(value, np.eye(seeds)[first + i]) for i, value in enumerate(vector)]


def values_of(numbers: Numbers) -> Array:
    """A vector without its derivatives."""
    return np.array([value_of(each) for each in numbers], float)


def jacobian_of(numbers: Numbers, seeds: int) -> Array:
    """The derivatives of a vector, (n, seeds)."""
    return np.array([slopes_of(each, seeds) for each in numbers], float).reshape(-1, seeds)
