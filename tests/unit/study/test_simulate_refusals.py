"""What `simulate` refuses, and how it says so."""

from __future__ import annotations

import numpy as np
import plants
import pytest

import fkgen

PLANT = plants.random_model(2, 2, 1, 1)


@pytest.fixture(scope="module")
def plant():
    return plants.spec(PLANT)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"runs": 0}, "runs: given 0; expected a whole number from 1"),
        ({"runs": 2.5}, "runs: given 2.5; expected a whole number"),
        ({"steps": -3}, "steps: given -3; expected a whole number from 1"),
        ({"seed": -1}, "seed: given -1; expected a whole number from 0"),
        ({"seed": 2**64}, "seed: given 18446744073709551616"),
        ({"first": 2**32}, "first: given 4294967296"),
        ({"u": None}, "u: given nothing; expected a number, or shape (10, 1): u0"),
        ({"u": np.ones((9, 1))}, "u: given shape (9, 1); expected a number, shape (1,), (10, 1)"),
        ({"u": np.nan}, "u: given NaN or an infinity"),
        ({"sensor": np.ones((10, 2))}, "sensor: given shape (10, 2); expected shape (10, 1)"),
        ({"sensor": np.full((10, 1), np.nan)}, "expected finite numbers; 0 is no fault"),
        ({"input": "pulse"}, "input: given text 'pulse'; expected a real number"),
        ({"params": {"tau": 1.0}}, "params.tau: given an unknown name"),
    ],
)
def test_numbers_and_shapes_that_do_not_fit(plant, given, message):
    arguments = {"runs": 3, "steps": 10, "u": 1.0} | given
    with pytest.raises(fkgen.DataError) as refused:
        fkgen.simulate(plant, **arguments)
    assert message in str(refused.value)


def test_a_plant_without_inputs_takes_none():
    with pytest.raises(fkgen.DataError, match="the model has no B"):
        fkgen.simulate(plants.spec(plants.random_model(2, 2, 1)), 1, 5, u=1.0)


def test_an_unstable_plant_stops_with_a_message():
    spec = plants.spec(plants.random_model(2, 2, 1) | {"A": [[1.5, 0.0], [0.0, 0.2]]})
    assert np.isfinite(fkgen.simulate(spec, 3, 1500).y).all()
    with pytest.raises(fkgen.DataError, match=r"overflow at sample 17\d\d of trial 0.*not stable"):
        fkgen.simulate(spec, 3, 5000)


def test_parameters_that_make_no_law_are_refused():
    rate = plants.motor(actuator=plants.common("rate"), parameters={"rate": 0.5})
    with pytest.raises(fkgen.DataError, match=r"rate outside \[0, 1\], at sample 4 of trial 0"):
        fkgen.simulate(rate, 2, 5, u=1.0, params={"rate": [0.1, 0.2, 0.3, 1.0, 1.1]})
    noise = plants.spec(PLANT | {"R": [["r"]]}, parameters={"r": 0.5})
    with pytest.raises(fkgen.DataError, match="a variance below 0"):
        fkgen.simulate(noise, 2, 5, u=1.0, params={"r": -1.0})
    ranged = plants.spec(PLANT, parameters={"r": {"default": 0.5, "max": 1.0}})
    with pytest.raises(fkgen.DataError, match=r"out of range, .* at sample 2 of trial 0"):
        fkgen.simulate(ranged, 2, 5, u=1.0, params={"r": [0.1, 1.0, 1.1, 0.2, 0.3]})


def test_a_genie_without_a_law_has_nothing_to_draw():
    spec = plants.spec(plants.random_model(2, 2, 1), family="genie", sensor={"noise_factor": 4.0})
    with pytest.raises(fkgen.SpecError, match="law that faults are drawn from"):
        fkgen.simulate(spec, 2, 5)


def test_parameters_of_a_batch_may_differ_from_record_to_record(plant):
    spec = plants.spec(PLANT | {"R": [["r"]]}, parameters={"r": 0.5})
    filtered, drawn = plants.built(spec), fkgen.simulate(spec, 3, 6, u=1.0)
    r = np.random.default_rng(0).uniform(0.2, 2.0, (3, 6))
    many = filtered.run_batch(drawn.y, drawn.u, {"r": r})
    for m in range(3):
        one = filtered.run(drawn.y[m], drawn.u, {"r": r[m]})
        assert np.array_equal(many.filtered_state[m], one.filtered_state)
    with pytest.raises(fkgen.DataError, match=r"expected a number or shape \(6,\) or \(3, 6\)"):
        filtered.run_batch(drawn.y, drawn.u, {"r": r[:2]})
