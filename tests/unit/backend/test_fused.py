"""Fused multiply-adds: their rounding against rational numbers, and which products they take."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from plants import generated, motor, random_model, spec

from fkgen.backend import ir
from fkgen.backend.execute import ARITHMETIC
from fkgen.backend.fused.products import fused
from fkgen.backend.fused.rounding import fma
from fkgen.backend.ir import Assign, Element, IfPositive, Literal, Operate, Operator, Space, Temp
from fkgen.backend.printer import Printer
from fkgen.symbolic.index import variable

#: Digits, least exponent of a unit in the last place, least exponent that overflows.
FORMATS = {np.float64: (53, -1074, 1024), np.float32: (24, -149, 128)}
REALS = list(FORMATS)


def nearest(exact, real):
    """A rational number that is not 0, rounded to the nearest of a type by its definition."""
    digits, least, beyond = FORMATS[real]
    size = abs(exact)
    exponent = size.numerator.bit_length() - size.denominator.bit_length()
    exponent -= size < Fraction(2) ** exponent  # 2^exponent <= size < 2^(exponent + 1)
    unit = Fraction(2) ** max(exponent - digits + 1, least)
    found = round(size / unit) * unit  # of two equally near the even one
    value = np.inf if found >= Fraction(2) ** beyond else float(found)
    return real(np.copysign(value, float(exact > 0) - 0.5))


def expected(a, b, c):
    exact = Fraction(float(a)) * Fraction(float(b)) + Fraction(float(c))
    if exact == 0:  # IEEE 754, 6.3: as a b and c are signed if both are zero, else plus
        return a * b + c if c == 0 else type(a)(0.0)
    return nearest(exact, type(a))


def assert_rounded(cases):
    for a, b, c in cases:
        assert fma(a, b, c).tobytes() == expected(a, b, c).tobytes(), (a, b, c)


def drawn(rng, real, low, high, size):
    """Numbers of both signs with exponents between two limits."""
    digits = FORMATS[real][0]
    whole = rng.integers(2 ** (digits - 1), 2**digits, size) * rng.choice([-1, 1], size)
    with np.errstate(over="ignore", under="ignore"):
        return np.ldexp(whole.astype(real), rng.integers(low, high, size) - digits).astype(real)


@pytest.mark.parametrize("real", REALS)
def test_ordinary_numbers_are_rounded_once(real):
    rng = np.random.default_rng(1)
    assert_rounded(drawn(rng, real, -30, 30, (2000, 3)))


@pytest.mark.parametrize("real", REALS)
def test_what_a_product_loses_is_left_where_the_sum_cancels(real):
    rng = np.random.default_rng(2)
    a, b = drawn(rng, real, -3, 3, (2, 2000))
    near = np.nextafter(a * b, rng.choice([-1.0, 1.0], 2000).astype(real) * real(np.inf))
    c = -np.where(rng.random(2000) < 0.5, a * b, near)
    assert_rounded(zip(a, b, c, strict=True))
    assert any(fma(*each) != each[0] * each[1] + each[2] for each in zip(a, b, c, strict=True))


@pytest.mark.parametrize("real", REALS)
def test_sums_near_the_middle_of_two_numbers_are_rounded_once(real):
    """c an integer of all digits, a b a half and something too small for twice the digits."""
    digits = FORMATS[real][0]
    rng, step = np.random.default_rng(3), real(2.0) ** real(1 - digits)
    cases = []
    for _ in range(300):
        c = real(rng.integers(2 ** (digits - 1), 2**digits) * rng.choice([-1, 1]))
        one, half = rng.choice([1.0, -1.0], 2)
        a = real(1.0) + real(one) * step
        cases += [(a, (real(2.0) - a) * real(half / 2), c), (real(half), real(0.5), c)]
    assert_rounded(cases)
    assert any(np.float32(float(a) * float(b) + float(c)) != fma(a, b, c) for a, b, c in cases) or (
        real is np.float64
    )


@pytest.mark.parametrize("real", REALS)
def test_subnormal_and_huge_numbers_are_rounded_once(real):
    rng, (digits, least, beyond) = np.random.default_rng(4), FORMATS[real]
    middle = least // 2
    tiny, large = drawn(rng, real, middle - 8, middle + digits // 2, (2, 2, 500))
    below = drawn(rng, real, least + 1, least + digits + 4, 500)
    assert_rounded(zip(*tiny, below, strict=True))
    large = drawn(rng, real, beyond // 2 - 1, beyond // 2 + 2, (2, 500))
    above = drawn(rng, real, beyond - 2, beyond + 1, 500)
    finite = np.isfinite(above)
    with np.errstate(over="ignore"):
        assert_rounded(np.array([*large, above])[:, finite].T)
        far = [drawn(rng, real, least + 1, beyond, 2000) for _ in range(3)]
        assert_rounded(zip(*far, strict=True))


@pytest.mark.parametrize("real", REALS)
def test_zeros_infinities_and_nan_are_those_of_the_sum(real):
    special = [real(v) for v in (0.0, -0.0, 1.5, -1.5, np.inf, -np.inf, np.nan)]
    with np.errstate(invalid="ignore"):
        for a in special:
            for b in special:
                for c in special:
                    found, sum_ = fma(a, b, c), a * b + c
                    same = np.isnan(found) and np.isnan(sum_)
                    assert same or found.tobytes() == sum_.tobytes(), (a, b, c)
    largest = np.finfo(real).max
    with np.errstate(over="ignore"):
        assert fma(largest, largest, real(-np.inf)) == -np.inf
        assert fma(largest, real(2.0), -largest) == largest
        assert fma(largest, -largest, real(1.0)) == -np.inf


def test_differences_have_the_signs_of_their_names():
    a, b, c = np.float64(3.0), np.float64(5.0), np.float64(100.0)
    found = {each: ARITHMETIC[each](a, b, c) for each in ir.FUSED}
    assert found == {Operator.FMA: 115.0, Operator.FMS: -85.0, Operator.FNMA: 85.0}


# ------------------------------------------------------------------------- which products

A, B, C, D = (Element(Space.INPUT, "y", i) for i in range(4))
FIRST, SECOND, THIRD, SUM = map(Temp, range(4))
PORT = Element(Space.NEXT, "filtered_state", 0)
PRODUCT = Operate(FIRST, Operator.MUL, (A, B))
OTHER = Operate(SECOND, Operator.MUL, (C, D))


def after(*body):
    """What becomes of statements."""
    phase = ir.Phase(locals=(), body=body, reads_input=False, reads_parameters=False)
    return fused(replace(phase, chunks=((0, ""),))).body


def summed(operator, *arguments, target=SUM):
    return Operate(target, operator, arguments)


@pytest.mark.parametrize(
    ("operator", "arguments", "becomes"),
    [
        (Operator.ADD, (C, FIRST), Operator.FMA),
        (Operator.ADD, (FIRST, C), Operator.FMA),
        (Operator.SUB, (C, FIRST), Operator.FNMA),
        (Operator.SUB, (FIRST, C), Operator.FMS),
    ],
)
def test_a_product_goes_into_the_only_sum_that_uses_it(operator, arguments, becomes):
    found = after(PRODUCT, summed(operator, *arguments), Assign(PORT, SUM))
    assert found == (Operate(SUM, becomes, (A, B, C)), Assign(PORT, SUM))


@pytest.mark.parametrize(
    ("operator", "becomes"), [(Operator.ADD, Operator.FMA), (Operator.SUB, Operator.FNMA)]
)
def test_of_two_products_the_right_one_is_fused(operator, becomes):
    found = after(PRODUCT, OTHER, summed(operator, FIRST, SECOND), Assign(PORT, SUM))
    assert found == (PRODUCT, Operate(SUM, becomes, (C, D, FIRST)), Assign(PORT, SUM))


def test_a_sum_of_products_is_a_chain_in_ascending_order():
    third = Operate(THIRD, Operator.MUL, (A, D))
    part, total = Temp(7), Temp(8)
    found = after(
        PRODUCT,
        OTHER,
        summed(Operator.ADD, FIRST, SECOND, target=part),
        third,
        summed(Operator.ADD, part, THIRD, target=total),
        Assign(PORT, total),
    )
    fma_ = Operator.FMA
    assert found[:-1] == (
        PRODUCT,
        Operate(part, fma_, (C, D, FIRST)),
        Operate(total, fma_, (A, D, part)),
    )


def test_a_product_with_another_use_stays():
    for use in (Assign(PORT, FIRST), Operate(THIRD, Operator.SUB, (FIRST, D))):
        body = (PRODUCT, summed(Operator.ADD, FIRST, C), use, Assign(PORT, SUM))
        assert after(*body) == body
    doubled = (PRODUCT, summed(Operator.ADD, FIRST, FIRST), Assign(PORT, SUM))
    assert after(*doubled) == doubled


def test_no_product_moves_past_what_is_stored_or_into_a_condition():
    stored = (PRODUCT, Assign(A, C), summed(Operator.ADD, FIRST, C), Assign(PORT, SUM))
    assert after(*stored) == stored
    inside = (PRODUCT, IfPositive(D, (summed(Operator.ADD, FIRST, C), Assign(PORT, SUM))))
    assert after(*inside) == inside


def test_products_under_conditions_are_fused_there():
    body = (PRODUCT, summed(Operator.ADD, C, FIRST), Assign(PORT, SUM))
    assert after(IfPositive(D, body)) == (IfPositive(D, after(*body)),)


def test_every_further_term_of_a_product_of_matrices_is_fused():
    i, j, k = map(variable, "ijk")
    place = [Element(Space.LOCAL, name, at) for name, at in (("L", i + k), ("R", k + j))]
    for start, less, first in ((None, False, 6), (PORT, False, 0), (PORT, True, 0)):
        node = ir.Product(PORT, start, *place, 2, 3, 4, less=less, lower=False)
        (found,) = after(node)
        further = {Operator.FNMA if less else Operator.FMA: 24 - first}
        assert found == replace(node, fused=True)
        assert found.operators == Counter({Operator.MUL: first}) + Counter(further)


# ---------------------------------------------------------------------------------- in text


@pytest.mark.parametrize(
    ("operator", "first", "text"),
    [
        (Operator.FMA, Temp(1), "fma(t1, t2, t3)"),
        (Operator.FMS, Temp(1), "fma(t1, t2, -t3)"),
        (Operator.FNMA, Temp(1), "fma(-t1, t2, t3)"),
        (Operator.FNMA, Literal(0.5), "fma(-0.5, t2, t3)"),
        (Operator.FNMA, Literal(-0.5), "fma(0.5, t2, t3)"),
    ],
)
def test_a_fused_operation_is_a_call_with_signs(operator, first, text):
    program = generated(motor("kf")).program
    node = Operate(Temp(4), operator, (first, Temp(2), Temp(3)))
    assert Printer(program).statement(node) == f"const double t4 = {text};"
    single = Printer(replace(program, scalar="float")).statement(node)
    assert " = fmaf(" in single


def plant(**code):
    return spec(random_model(91, 4, 2), family="kf", code=code)


def test_nothing_is_fused_unless_it_is_asked_for():
    files = generated(plant()).files
    assert not any("fma" in text or "math.h" in text for text in files.values())
    assert plant(fma=False).canonical() == plant().canonical() != plant(fma=True).canonical()


@pytest.mark.parametrize(("scalar", "called"), [("double", "fma"), ("float", "fmaf")])
def test_the_files_say_what_is_called_and_how_often(scalar, called):
    source = generated(plant(fma=True, scalar=scalar))
    header = " ".join(source.files["plant.h"].replace(" * ", " ").split())
    assert f"no libm but {called}()" in header
    assert f"{called}(a, b, c) of <math.h> is a b + c, rounded once" in header
    program = source.program
    assert f"{program.flops} floating-point operations, {program.fused} of them fused" in header
    assert f" = {called}(" in source.files["plant.c"]
    assert f'"fused": {program.fused},' in source.files["manifest.json"]
    assert "target_link_libraries(plant PUBLIC" in source.files["CMakeLists.txt"]


def test_products_and_sums_count_as_one_operation_where_they_are_one():
    apart, together = (generated(plant(fma=each)).program for each in (False, True))
    assert together.flops == apart.flops - together.fused
    assert together.fused > 0.4 * together.flops
