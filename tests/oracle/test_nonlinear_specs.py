"""Specs with equations as functions: the same numbers as those written in Python."""

from __future__ import annotations

import inspect

import equations
import numpy as np
import pytest
from nonlinear_plants import robot_f, robot_h

from fkgen.oracle.plants.dual import Dual, jacobian_of, seeded, values_of
from fkgen.oracle.plants.equations import ARITHMETIC, looked_up, system_of
from fkgen.problem.text.lookup import Table


def robot_spec(**given):
    model = equations.ROBOT | {"h": {"range": "hypot(x, y)", "bearing": "atan2(y, x) - heading"}}
    return equations.read(model | given)


def test_a_robot_is_the_robot_written_by_hand():
    spec, T = robot_spec(), 3
    dt = np.array([0.1, 0.3, 0.2])
    plant, rng = system_of(spec, T, {"dt": dt}), np.random.default_rng(1)
    assert plant.space.kinds == ("line", "line", "circle")
    np.testing.assert_array_equal(plant.wraps, [False, True])
    np.testing.assert_allclose(plant.W, np.full((T, 1), 1e-4))
    for k in range(T):
        x, u, w = rng.normal(size=3), rng.normal(size=2), rng.normal(size=1)
        there = robot_f(x, u, w, {"dt": dt[k]})
        np.testing.assert_allclose(values_of(plant.step(k, x, u, w)), there, rtol=1e-14)
        np.testing.assert_allclose(plant.measured(k, x, u), robot_h(x, u, {}), rtol=1e-14)
        G = plant.moved(k, x, u).G
        np.testing.assert_allclose(G, [[0.0], [0.0], [dt[k]]])


@pytest.mark.parametrize("time", [{}, {"time": "continuous", "sample_time": "dt"}])
def test_an_attitude_turns_and_sees_as_its_own_evaluation_says(time):
    """The spec's own evaluation in floats, of a step by rk4 too; derivatives by differences."""
    f = {"q": "[gx, gy, gz] - b"} if time else {"q": "q * rate"}
    spec = equations.read(equations.ATTITUDE | {"f": f} | time)
    plant, rng = system_of(spec, 2, {"dt": np.array([0.1, 0.2])}), np.random.default_rng(2)
    assert plant.increments == {0}
    for k, dt in enumerate((0.1, 0.2)):
        x, u = plant.space.normal(rng.normal(size=7)), rng.normal(size=3)
        moved, seen = spec.model.equations.evaluate(x, u, [], {"dt": dt})
        np.testing.assert_allclose(plant.moved(k, x, u).x, moved, rtol=1e-13)
        np.testing.assert_allclose(plant.measured(k, x, u), seen, rtol=1e-13)
        assert plant.seen(k, x, u).H.shape == (3, 6)
        assert plant.moved(k, x, u).F.shape == (6, 6)
    if time:
        np.testing.assert_allclose(plant.noises(1)[1], 0.2 * spec.model.Q.values())


@pytest.mark.parametrize("kind", ["linear", "pchip"])
def test_a_table_is_held_at_its_ends_and_has_the_slope_to_the_right(kind):
    table = Table("ocv", (0.0, 0.5, 1.0, 3.0), (3.0, 3.5, 3.6, 4.2), kind)
    for at in (-1.0, 0.0, 0.2, 0.5, 0.9, 2.5, 3.0, 4.0):
        found = looked_up(table, Dual(at, [1.0]))
        assert values_of([found])[0] == pytest.approx(table.value(at), rel=1e-14)
        slope = (table.value(at + 1e-7) - table.value(at)) / 1e-7
        np.testing.assert_allclose(jacobian_of([found], 1), [[slope]], atol=2e-6)


def test_every_word_of_the_language_has_its_meaning_here():
    from fkgen.problem.equations import ARRAYS

    assert ARITHMETIC.keys() == ARRAYS.keys()
    a, b = 0.3, 0.7
    for name, function in ARITHMETIC.items():
        if name not in {"if", "interp"}:
            binary = inspect.unwrap(function).nin == 2
            given = (a, b) if binary else (a,)
            assert function(*given) == pytest.approx(float(ARRAYS[name](*given)), rel=1e-15)
            dual = function(*seeded(given, len(given)))
            assert values_of([dual])[0] == pytest.approx(float(ARRAYS[name](*given)), rel=1e-15)
    assert ARITHMETIC["if"](a < b, 1.0, np.nan) == 1.0
