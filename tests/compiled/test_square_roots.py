"""Square roots are rounded correctly, by the processor's instruction and digit by digit alike."""

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


def roots(folder, scalar, compiler, flags):
    """The function of the shared file, over arrays."""
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
        y[i] = fkgen_{scalar}_sqrt(x[i]);
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
    found = roots(tmp_path, scalar, compiler, (*WAYS[way], level))(x)
    expected = np.sqrt(x)
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(np.signbit(found)[x == 0], np.signbit(x[x == 0]))


def test_digits_give_the_root_of_every_significand_of_a_float(tmp_path):
    bits = np.arange(0x3F800000, 0x40800000, dtype=np.uint32)  # from 1 to 4
    x = bits.view(np.float32)
    found = roots(tmp_path, "float", next(iter(C_COMPILERS)), ("-DFKGEN_NO_ASM", "-O2"))(x)
    np.testing.assert_array_equal(found, np.sqrt(x))


@pytest.mark.exhaustive
def test_digits_give_the_root_of_every_float(tmp_path):
    over = roots(tmp_path, "float", next(iter(C_COMPILERS)), ("-DFKGEN_NO_ASM", "-O2"))
    for high in range(0, 1 << 16, 1 << 8):
        x = np.arange(high << 16, (high + (1 << 8)) << 16, dtype=np.uint64).astype(np.uint32)
        np.testing.assert_array_equal(over(x.view(np.float32)), np.sqrt(x.view(np.float32)))
