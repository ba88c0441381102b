"""Elementary functions as compiled: roots by either way, and functions of every float."""

from __future__ import annotations

import ctypes

import numpy as np
import pytest
import spread
from plants import generated
from toolchain import BITS, C_COMPILERS, C_ONLY, FLAGS, call, each, needs_compiler

import fkgen

pytestmark = [needs_compiler(), pytest.mark.filterwarnings("ignore::RuntimeWarning")]

REAL = {"double": np.float64, "float": np.float32}
WORD = {"double": np.uint64, "float": np.uint32}
WAYS = {"instruction": (), "digits": ("-DFKGEN_NO_ASM",)}


def compiled(folder, function, scalar, compiler, flags):
    """A function of the shared file, over arrays."""
    table = spread.specs(scalar)["kf_functions"].to_dict()
    table["code"]["elementary"] = "shared"
    stem = f"fkgen_elementary_{scalar}"
    for file, text in generated(fkgen.Spec.from_dict(table)).files.items():
        if file.startswith(stem):
            (folder / file).write_text(text)
    (folder / "over.c").write_text(f"""
#include "{stem}.h"
void over(const {scalar} *x, {scalar} *y, long count);
void over(const {scalar} *x, {scalar} *y, long count)
{{
    long i;
    for (i = 0; i < count; ++i)
    {{
        y[i] = fkgen_{scalar}_{function}(x[i]);
    }}
}}
""")
    command = [*C_COMPILERS[compiler], "-std=c99", BITS, *FLAGS, *C_ONLY, *flags]
    sources = ("over.c", f"{stem}.c")
    call(*command, "-shared", "-fPIC", *sources, "-o", "over.so", cwd=folder)
    library = ctypes.CDLL(str(folder / "over.so"))

    def over(x):
        y = np.empty_like(x)
        library.over(*(ctypes.c_void_p(each.ctypes.data) for each in (x, y)), ctypes.c_long(x.size))
        return y

    return over


def arguments(scalar, count):
    """Bits of every kind: all exponents, subnormals, neighbours of squares, what has no root."""
    rng, real, word = np.random.default_rng(13), REAL[scalar], WORD[scalar]
    bits = 8 * real(0).itemsize
    anything = rng.integers(0, 2**bits, count, dtype=word).view(real)
    subnormal = rng.integers(0, 1 << np.finfo(real).nmant, count, dtype=word).view(real)
    squares = rng.integers(1, 1 << (np.finfo(real).nmant // 2 + 1), count).astype(real) ** 2
    halves = (rng.integers(1 << np.finfo(real).nmant, 2 << np.finfo(real).nmant, count) + 0.5) ** 2
    near = [np.nextafter(squares, real(side)) for side in (0, np.inf)]
    odd = np.array([0.0, -0.0, np.inf, -np.inf, np.nan, -1.0, np.finfo(real).max], real)
    return np.concatenate([anything, subnormal, squares, *near, halves.astype(real), odd])


@pytest.mark.parametrize("level", ["-O0", "-O2"])
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("compiler", each(C_COMPILERS))
@pytest.mark.parametrize("scalar", ["double", "float"])
def test_roots_are_those_of_ieee_754(scalar, compiler, way, level, tmp_path):
    x = arguments(scalar, 20_000)
    found = compiled(tmp_path, "sqrt", scalar, compiler, (*WAYS[way], level))(x)
    expected = np.sqrt(x)
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(np.signbit(found)[x == 0], np.signbit(x[x == 0]))


def test_digits_give_the_root_of_every_significand_of_a_float(tmp_path):
    bits = np.arange(0x3F800000, 0x40800000, dtype=np.uint32)  # from 1 to 4
    x = bits.view(np.float32)
    found = compiled(tmp_path, "sqrt", "float", next(iter(C_COMPILERS)), ("-DFKGEN_NO_ASM", "-O2"))(
        x
    )
    np.testing.assert_array_equal(found, np.sqrt(x))


@pytest.mark.floats
def test_digits_give_the_root_of_every_float(tmp_path):
    over = compiled(tmp_path, "sqrt", "float", next(iter(C_COMPILERS)), ("-DFKGEN_NO_ASM", "-O2"))
    for x in every_float(1):
        np.testing.assert_array_equal(over(x), np.sqrt(x))


def every_float(stride):
    """All floats, or one of so many, in pieces."""
    piece = stride << 16  # what fits into caches
    for first in range(0, 1 << 32, piece):
        bits = np.arange(first, min(first + piece, 1 << 32), stride, dtype=np.uint64)
        yield bits.astype(np.uint32).view(np.float32)


#: Units in the last place that a float may err by: half of one, and what the polynomial adds.
#: Angles up to 100; beyond it the last digits of pi count too, near zeros of the function.
ULPS = {"exp": 0.92, "log": 0.85, "sin": 0.95, "cos": 0.95, "tan": 0.8, "asin": 0.75, "acos": 0.75}
ULPS |= {"sinh": 0.75, "cosh": 0.7, "tanh": 0.75}
NUMPY = {"asin": np.arcsin, "acos": np.arccos}


@pytest.mark.parametrize("stride", [251, pytest.param(1, marks=pytest.mark.floats)])
@pytest.mark.parametrize("function", ULPS)
def test_floats_err_by_less_than_one_unit(function, stride, tmp_path):
    over = compiled(tmp_path, function, "float", next(iter(C_COMPILERS)), ("-O2",))
    reference = NUMPY.get(function) or getattr(np, function)
    for x in every_float(stride):
        exact, found = reference(x.astype(np.float64)), over(x)
        allowed = np.spacing(np.abs(exact).astype(np.float32)).astype(float)
        if function in {"sin", "cos", "tan"}:
            far = np.abs(x) > 100.0
            exact[np.abs(x) > 1e5] = np.nan
            slope = 1.0 + exact[far] ** 2 if function == "tan" else 1.0
            allowed[far] += np.abs(x[far]) * 2.0**-53 * slope
        with np.errstate(over="ignore"):
            np.testing.assert_array_equal(np.isnan(found), np.isnan(exact))
            finite = np.isfinite(exact.astype(np.float32))
        np.testing.assert_array_equal(found[~finite], exact[~finite].astype(np.float32))
        zeros = x == 0
        np.testing.assert_array_equal(np.signbit(found[zeros]), np.signbit(exact[zeros]))
        errors = np.abs(found[finite] - exact[finite])
        assert np.all(errors <= ULPS[function] * allowed[finite])
