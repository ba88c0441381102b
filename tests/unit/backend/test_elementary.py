"""Functions in plain arithmetic: errors in units in the last place."""

from __future__ import annotations

import itertools
import math

import mpmath
import numpy as np
import pytest
from plants import built, generated, spec

from fkgen.backend.elementary import Elementary

#: The reference goes on where a number overflows or is none, as C does.
pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")

REAL = {"double": np.float64, "float": np.float32}

#: Largest errors in ulps that are allowed: half of one for the last rounding, and what reduction
#: and polynomial add. The square root is exact.
ULPS = {"exp": 0.95, "log": 0.9, "sqrt": 0.5, "sin": 0.95, "cos": 0.95, "tan": 0.8, "atan2": 0.9}
ULPS |= {"asin": 0.8, "acos": 0.8, "sinh": 0.9, "cosh": 0.75, "tanh": 0.85, "hypot": 0.9}

LIMITS = {"double": (-708.0, 709.0), "float": (-87.0, 88.0)}


def arguments(name, scalar, count):
    """Arguments over the range of a function, in its scalar type."""
    rng = np.random.default_rng(len(name))
    low, high = LIMITS[scalar]
    spans = {
        "exp": rng.uniform(low, high, count),
        "log": np.exp(rng.uniform(low, high, count)),
        "sqrt": np.exp(rng.uniform(low, high, count)),
    }
    waves = np.concatenate([rng.uniform(-4.0, 4.0, count), rng.uniform(-1000.0, 1000.0, count)])
    near = 1.0 + rng.uniform(-1e-3, 1e-3, count)
    small = rng.choice([-1.0, 1.0], count) * np.exp(rng.uniform(-40.0, 0.0, count))
    if name in {"asin", "acos"}:
        edge = rng.choice([-1.0, 1.0], count) * (1.0 - np.exp(rng.uniform(-30.0, 0.0, count)))
        return np.concatenate([rng.uniform(-1.0, 1.0, count), small, edge]).astype(REAL[scalar])
    if name in {"sinh", "cosh", "tanh"}:
        wide = rng.uniform(low, high + 1.0, count)
        return np.concatenate([rng.uniform(-3, 3, count), small, wide]).astype(REAL[scalar])
    if name == "log":
        return np.concatenate([spans["log"], near]).astype(REAL[scalar])
    return spans.get(name, waves).astype(REAL[scalar])


def ulps(found, exact, scalar):
    """Error in units in the last place of the exact value."""
    spacing = float(np.spacing(REAL[scalar](abs(exact))))
    return abs(float((mpmath.mpf(float(found)) - exact) / spacing))


@pytest.mark.parametrize("scalar", ["double", "float"])
@pytest.mark.parametrize("name", sorted(ULPS.keys() - {"atan2", "hypot"}))
def test_functions_err_by_less_than_their_ulps(name, scalar):
    function = getattr(Elementary(scalar), name)
    with mpmath.workdps(50), np.errstate(all="ignore"):
        errors = [
            ulps(function(x), getattr(mpmath, name)(mpmath.mpf(float(x))), scalar)
            for x in arguments(name, scalar, 400)
        ]
    assert max(errors) <= ULPS[name]


@pytest.mark.parametrize("scalar", ["double", "float"])
def test_atan2_errs_by_less_than_its_ulps_in_every_octant(scalar):
    rng = np.random.default_rng(2)
    far = {"double": 350.0, "float": 40.0}[scalar]
    points = rng.standard_normal((400, 2)) * np.exp(rng.uniform(-5.0, 5.0, (400, 2)))
    points[::4] *= np.exp(rng.uniform(-far, far, (100, 1)))
    points[1::4] *= np.exp(rng.uniform(-far, far, (100, 2)))
    points[2::4, 1] = points[2::4, 0] * rng.uniform(0.4, 0.43, 100)  # about tan(pi/8)
    function = Elementary(scalar).atan2
    with mpmath.workdps(50):
        for y, x in points.astype(REAL[scalar]):
            exact = mpmath.atan2(mpmath.mpf(float(y)), mpmath.mpf(float(x)))
            assert ulps(function(y, x), exact, scalar) <= ULPS["atan2"]


@pytest.mark.parametrize("scalar", ["double", "float"])
def test_hypot_errs_by_less_than_its_ulps_and_overflows_only_with_its_result(scalar):
    rng = np.random.default_rng(3)
    real, hypot = REAL[scalar], Elementary(scalar).hypot
    far = {"double": 700.0, "float": 85.0}[scalar]
    sizes = np.exp(rng.uniform(-far, far, 400))
    points = sizes[:, None] * rng.standard_normal((400, 2)) * np.exp(rng.uniform(-5, 2, (400, 2)))
    largest = float(np.finfo(real).max)
    corner = [[0.7 * largest, -0.7 * largest], [0.0, -3.0], [0.9 * largest, 0.0], [-3.0, 4.0]]
    with mpmath.workdps(50):
        for x, y in np.concatenate([points, corner]).astype(real):
            exact = mpmath.hypot(mpmath.mpf(float(x)), mpmath.mpf(float(y)))
            assert ulps(hypot(x, y), exact, scalar) <= ULPS["hypot"]
    with np.errstate(all="ignore"):
        assert hypot(real(largest), real(largest)) == np.inf


@pytest.mark.parametrize("scalar", ["double", "float"])
class TestSpecialValues:
    def test_logarithm(self, scalar):
        log, real = Elementary(scalar).log, REAL[scalar]
        with np.errstate(all="ignore"):
            assert log(real(0.0)) == -np.inf
            assert np.isnan(log(real(-1.0)))
            assert np.isnan(log(real(np.nan)))
            assert log(real(np.inf)) == np.inf
            assert log(real(1.0)) == 0.0

    def test_logarithm_of_a_subnormal_number(self, scalar):
        real = REAL[scalar]
        smallest = np.finfo(real).smallest_subnormal
        exact = mpmath.log(mpmath.mpf(float(smallest)))
        assert ulps(Elementary(scalar).log(smallest), exact, scalar) <= ULPS["log"]

    def test_exponential(self, scalar):
        exp, real = Elementary(scalar).exp, REAL[scalar]
        assert exp(real(0.0)) == exp(real(-0.0)) == 1.0
        with np.errstate(all="ignore"):
            assert exp(real(-np.inf)) == exp(real(-1e5)) == 0.0
            assert exp(real(np.inf)) == exp(real(1e5)) == np.inf
            assert np.isnan(exp(real(np.nan)))

    def test_exponential_fades_out_without_a_jump(self, scalar):
        exp, real = Elementary(scalar).exp, REAL[scalar]
        low = {"double": -745.0, "float": -103.0}[scalar]
        with np.errstate(all="ignore"):
            last = exp(real(low))
        assert 0.0 < last < np.finfo(real).tiny

    def test_square_root(self, scalar):
        sqrt, real = Elementary(scalar).sqrt, REAL[scalar]
        with np.errstate(all="ignore"):
            assert sqrt(real(0.0)) == 0.0
            assert np.signbit(sqrt(real(-0.0)))
            assert np.isnan(sqrt(real(-1.0)))
            assert sqrt(real(np.inf)) == np.inf
            assert np.isnan(sqrt(real(np.nan)))
        for root in (1.0, 2.0, 3.0, 12.0, 0.25):
            assert sqrt(real(root * root)) == root

    def test_square_root_of_a_subnormal_number(self, scalar):
        smallest = np.finfo(REAL[scalar]).smallest_subnormal
        exact = mpmath.sqrt(mpmath.mpf(float(smallest)))
        assert ulps(Elementary(scalar).sqrt(smallest), exact, scalar) <= ULPS["sqrt"]

    def test_waves(self, scalar):
        functions, real = Elementary(scalar), REAL[scalar]
        assert functions.sin(real(0.0)) == 0.0
        assert functions.cos(real(0.0)) == 1.0
        assert functions.tan(real(0.0)) == 0.0
        with np.errstate(all="ignore"):
            for x in (np.inf, -np.inf, np.nan, 2e5):
                assert np.isnan(functions.sin(real(x)))
                assert np.isnan(functions.cos(real(x)))
        assert functions.sin(real(-0.5)) == -functions.sin(real(0.5))
        assert functions.cos(real(-0.5)) == functions.cos(real(0.5))

    def test_arcs(self, scalar):
        functions, real = Elementary(scalar), REAL[scalar]
        assert functions.asin(real(1.0)) == real(np.pi / 2)
        assert functions.asin(real(0.0)) == 0.0
        assert functions.acos(real(1.0)) == 0.0
        assert functions.acos(real(-1.0)) == real(np.pi)
        with np.errstate(all="ignore"):
            for x in (1.0001, -1.0001, np.inf, np.nan):
                assert np.isnan(functions.asin(real(x)))
                assert np.isnan(functions.acos(real(x)))

    def test_hyperbolic_functions(self, scalar):
        functions, real = Elementary(scalar), REAL[scalar]
        assert functions.sinh(real(0.0)) == 0.0
        assert functions.cosh(real(0.0)) == 1.0
        with np.errstate(all="ignore"):
            for x in (1e4, np.inf):
                assert functions.sinh(real(-x)) == -np.inf
                assert functions.cosh(real(-x)) == np.inf
                assert functions.tanh(real(-x)) == -1.0
            for name in ("sinh", "cosh", "tanh"):
                assert np.isnan(getattr(functions, name)(real(np.nan)))

    def test_zeros_keep_their_signs(self, scalar):
        functions, real = Elementary(scalar), REAL[scalar]
        for name in ("sin", "tan", "asin", "sinh", "tanh", "sqrt"):
            for zero in (0.0, -0.0):
                found = getattr(functions, name)(real(zero))
                assert (found, np.signbit(found)) == (0.0, np.signbit(zero)), name

    def test_angles_of_zeros_are_those_of_libm(self, scalar):
        atan2, real = Elementary(scalar).atan2, REAL[scalar]
        for y, x in itertools.product((0.0, -0.0, 1.0, -1.0), repeat=2):
            found, expected = atan2(real(y), real(x)), real(math.atan2(y, x))
            assert (found, np.signbit(found)) == (expected, np.signbit(expected)), (y, x)

    def test_hyperbolic_functions_overflow_only_with_their_results(self, scalar):
        functions, real = Elementary(scalar), REAL[scalar]
        last = real({"double": 710.4758600739439, "float": 89.415985}[scalar])
        assert np.isfinite(functions.sinh(last))
        assert np.isfinite(functions.cosh(-last))
        beyond = np.nextafter(last, real(np.inf))
        with np.errstate(all="ignore"):
            assert functions.sinh(-beyond) == -np.inf
            assert functions.cosh(beyond) == np.inf

    def test_the_smallest_numbers_stay(self, scalar):
        functions, real = Elementary(scalar), REAL[scalar]
        for x in (np.finfo(real).smallest_subnormal, -np.finfo(real).tiny):
            for name in ("sin", "tan", "asin", "sinh", "tanh"):
                assert getattr(functions, name)(x) == x, name

    def test_a_nan_stays_one(self, scalar):
        functions, real = Elementary(scalar), REAL[scalar]
        for name in ("atan2", "hypot"):
            points = [(np.nan, other) for other in (1.0, 0.0, np.nan)]
            for point in (*points, *(point[::-1] for point in points)):
                assert np.isnan(getattr(functions, name)(*map(real, point)))

    def test_angles_on_the_axes(self, scalar):
        atan2, real = Elementary(scalar).atan2, REAL[scalar]
        expected = {(0, 1): 0.0, (1, 0): np.pi / 2, (-1, 0): -np.pi / 2, (0, -1): np.pi}
        for (y, x), angle in expected.items():
            assert atan2(real(y), real(x)) == real(angle)
        assert atan2(real(0.0), real(0.0)) == 0.0

    def test_angles_of_the_largest_and_smallest_points(self, scalar):
        atan2, real = Elementary(scalar).atan2, REAL[scalar]
        least, most = np.finfo(real).smallest_subnormal, np.finfo(real).max
        for size in (least, most):
            assert atan2(size, size) == real(np.pi / 4)
            assert atan2(size, -size) == real(3 * np.pi / 4)
        assert atan2(least, most) == atan2(real(1.0), real(np.inf)) == 0.0
        assert atan2(real(-np.inf), real(1.0)) == -real(np.pi / 2)


@pytest.mark.parametrize("scalar", ["double", "float"])
@pytest.mark.parametrize("name", [*sorted(ULPS), "abs"])
def test_compiled_functions_give_the_bits_of_the_reference(name, scalar):
    two, arc = name in {"atan2", "hypot"}, name in {"asin", "acos"}
    expression = f"{name}(a, b)" if two else f"{name}(a)"
    one = [[1.0]]
    noise = {"C": one, "Q": one, "R": one, "x0": [0.0], "P0": one}
    model = {"A": [[0.0]], "B": [[expression]], **noise}  # beyond 1e154 no covariance could follow
    plant = spec(model, family="kf", parameters={"a": 0.5, "b": 0.7}, code={"scalar": scalar})
    assert f"plant_{name}(" in generated(plant).files["plant.c"] or name == "abs"
    rng = np.random.default_rng(9)
    a = rng.uniform(-3.0, 3.0, 300) if name not in {"log", "sqrt"} else rng.uniform(1e-6, 9.0, 300)
    a[:3] = [-0.0, 1.0, 1e-30] if name != "log" else [1.0, 2.0, 1e-30]
    a[3:6] = [0.5, 0.55, -1.0] if arc else [1e-5, 30.0, {"double": 708.9, "float": 87.9}[scalar]]
    a = np.sin(a) if arc else a
    found, real = built(plant), REAL[scalar]
    functions = Elementary(scalar)
    for value in a.astype(real):
        other = real(0.7)
        found.reset()
        filtered = found.step([np.nan], [1.0], {"a": value, "b": other}).predicted_state
        if name == "abs":
            expected = abs(value)
        elif two:
            expected = getattr(functions, name)(value, other)
        else:
            expected = getattr(functions, name)(value)
        np.testing.assert_array_equal(filtered, [expected])
