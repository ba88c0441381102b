"""Questions that cannot be asked: what was given, what was expected, and why."""

from __future__ import annotations

import numpy as np
import pytest
from effect_plants import paper
from plants import common, motor, random_model, spec

import fkgen
from fkgen.errors import DataError
from fkgen.profiles import drift, from_csv, pulse, ramp, step


def refused(call, match):
    with pytest.raises(DataError, match=match) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_profiles_are_what_their_names_say():
    assert pulse(4, 1, [2.0, 0.0]).tolist() == [[0, 0], [2, 0], [0, 0], [0, 0]]
    assert step(4, 1, 3.0).ravel().tolist() == [0, 3, 3, 3]
    assert step(4, 1, 3.0, stop=3).ravel().tolist() == [0, 3, 3, 0]
    assert step(4, 1, 3.0, stop=99).ravel().tolist() == [0, 3, 3, 3]
    assert ramp(6, 1, 3.0, length=3).ravel().tolist() == [0, 1, 2, 3, 3, 3]
    assert drift(5, 2, 0.5).ravel().tolist() == [0, 0, 0.5, 1.0, 1.5]


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: pulse(0, 0, 1.0), "steps: given 0"),
        (lambda: pulse(5, 5, 1.0), "start: given 5; expected a sample from 0 to 4"),
        (lambda: pulse(5, -1, 1.0), "start: given -1"),
        (lambda: step(5, 2, 1.0, stop=2), "stop: given 2; expected a sample after start = 2"),
        (lambda: step(5, 2, [[1.0]]), "amplitude"),
        (lambda: step(5, 2, [1.0, np.nan]), "amplitude"),
        (lambda: step(5, 2, "much"), "amplitude"),
        (lambda: ramp(5, 2, 1.0, length=0), "length: given 0"),
    ],
)
def test_profiles_that_cannot_be(call, match):
    refused(call, match)


def test_a_profile_from_a_file_has_zeros_where_there_is_no_column(tmp_path):
    path = tmp_path / "fault.csv"
    path.write_text("t,y1\n0,0.5\n1,1.5\n", encoding="utf-8")
    assert from_csv(path, ["y0", "y1"]).tolist() == [[0.0, 0.5], [0.0, 1.5]]
    refused(lambda: from_csv(path, ["z"]), r"none of the columns \(there are: t, y1\)")
    path.write_text("y1\n0.5\n\nx\n", encoding="utf-8")
    refused(lambda: from_csv(path, ["y1"]), "line 4, column y1")


A = paper("A")
GOOD = step(20, 3, [1.0, 0.0])


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: fkgen.fault_effect(A), "the fault: given nothing"),
        (lambda: fkgen.fault_effect(A, np.zeros((0, 2))), "a profile without samples"),
        (lambda: fkgen.fault_effect(A, [[1.0, 2.0], [3.0]]), "rows of different lengths"),
        (lambda: fkgen.fault_effect(A, np.zeros((20, 3))), r"sensor: given shape \(20, 3\)"),
        (lambda: fkgen.fault_effect(A, np.zeros(20)), r"sensor: given shape \(20,\)"),
        (lambda: fkgen.fault_effect(A, GOOD, steps=21), "steps: given 21; expected 20"),
        (lambda: fkgen.fault_effect(A, GOOD, np.zeros((19, 1))), "sensor: given 20 samples"),
        (lambda: fkgen.fault_effect(A, GOOD, mode="pant"), "mode: given 'pant'; expected 'plant'"),
        (lambda: fkgen.fault_effect(A, GOOD * np.nan), r"sensor\[0\], y0: given nan"),
        (lambda: fkgen.fault_effect(A, GOOD, params={"tau": 1.0}), "params.tau"),
        (lambda: fkgen.fault_effect(A, GOOD, y=np.zeros((19, 2))), "y: given 19 samples"),
        (lambda: fkgen.fault_effect(A, [["a", "b"]]), r"sensor\[0, 0\]: given text 'a'"),
        (lambda: fkgen.fault_effect(motor(), step(20, 3, [1.0])), "the gain of mkf depends on u"),
        (
            lambda: fkgen.fault_effect(spec(random_model(1, 2, 1)), input=np.zeros((9, 1))),
            "input: given a profile; expected none: the model has no B",
        ),
        (lambda: fkgen.fault_effect(A, GOOD).power(0.0), r"false_alarm: given 0.0"),
        (lambda: fkgen.fault_effect(A, GOOD).settled(1.0), r"fraction: given 1.0"),
        (
            lambda: fkgen.fault_effect(motor("mme"), np.zeros((9, 2)), u=np.ones((9, 1)), runs=1),
            "runs: given 1",
        ),
    ],
)
def test_questions_that_do_not_fit(call, match):
    refused(call, match)


def test_an_unstable_plant_over_a_long_horizon_stops_with_a_message():
    model = random_model(1, 2, 1, 1)
    model["A"] = (2.0 * np.array(model["A"])).tolist()
    unstable = spec(model)
    fault = step(3000, 0, [1.0])
    assert np.isfinite(fkgen.fault_effect(unstable, fault).state_deviation).all()
    refused(
        lambda: fkgen.fault_effect(unstable, input=fault, mode="plant"),
        r"steps: given 3000 samples; expected at most \d+: then numbers overflow",
    )


def test_a_mixture_has_no_power_of_a_chi_square_test():
    found = fkgen.fault_effect(motor("mme"), np.ones((5, 2)), u=np.ones((5, 1)), runs=2)
    refused(lambda: found.power(0.01), "whose innovation is a mixture")


def driven(**params):
    """mkf whose rate and dynamics are parameters, over 9 samples."""
    model = random_model(3, 1, 1, 1) | {"A": [["sqrt(a)"]]}
    parameters = {"xi": 0.5, "a": 0.25}
    found = spec(model, family="mkf", actuator=common("xi"), parameters=parameters)
    return fkgen.fault_effect(found, np.ones((9, 1)), u=np.ones((9, 1)), params=params)


@pytest.mark.parametrize(
    ("params", "match"),
    [
        ({"xi": np.full(8, 0.5)}, r"params.xi: given shape \(8,\); expected a number or \(9,\)"),
        ({"xi": np.nan}, "params.xi: given NaN or an infinity"),
        ({"xi": [0.5] * 8 + [1.5]}, r"a success rate of \[1.5\] at sample 8; expected rates in"),
        ({"a": -1.0}, "params: given these values; expected values at which every entry"),
        ({"xi": "half"}, "params.xi: given text"),
        ({"b": 1.0}, "params.b: given an unknown name"),
    ],
)
def test_parameters_that_do_not_fit(params, match):
    assert np.isfinite(driven(xi=0.25, a=np.full(9, 0.5)).state_deviation).all()
    refused(lambda: driven(**params), match)


def test_a_variance_below_zero_is_refused():
    model = random_model(3, 1, 1) | {"R": [["r"]]}
    found = spec(model, parameters={"r": 1.0})
    refused(
        lambda: fkgen.fault_effect(found, np.ones((9, 1)), params={"r": -1.0}),
        "params: given a record that the filter refuses at sample 0",
    )


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: fkgen.detectability(A, "y7"), "direction: given 'y7'"),
        (lambda: fkgen.detectability(A, [1.0]), r"direction: given shape \(1,\)"),
        (lambda: fkgen.detectability(A, [0.0, 0.0]), "not all of them zero"),
        (lambda: fkgen.detectability(A, "y0", 0.0), "false_alarm: given 0.0"),
        (lambda: fkgen.detectability(A, "y0", 1e-3, 1.0), "power: given 1.0"),
        (lambda: fkgen.detectability(A, "y0", 0.5, 0.4), "more than false_alarm = 0.5"),
        (lambda: fkgen.detectability(A, "y0", window=0), "window: given 0"),
        (
            lambda: fkgen.detectability(A, "y0", u=[1.0, 2.0]),
            "u: given .*; expected 1 finite numbers",
        ),
        (lambda: fkgen.detectability(motor("mme"), "y0"), "the family mme; .* simulate it"),
    ],
)
def test_tests_that_do_not_fit(call, match):
    refused(call, match)


def test_a_filter_that_does_not_come_to_rest_has_no_least_bias():
    model = random_model(1, 2, 1)
    model |= {"A": [[1.0, 0.0], [0.0, 0.5]], "C": [[0.0, 1.0]]}
    refused(lambda: fkgen.detectability(spec(model), "y0"), "does not come to rest")


def test_settling_is_the_first_sample_from_which_on_the_effect_stays_small():
    found = fkgen.fault_effect(A, pulse(200, 5, [1.0, 1.0]))
    size = np.abs(found.error_deviation)
    for i, k in enumerate(found.settled(0.01)):
        peak = size[:, i].max()
        assert size[k:, i].max() <= 0.01 * peak < size[k - 1, i]
    assert found.settled(1e-12).tolist() == [200, 200, 200]
    assert fkgen.fault_effect(A, 0.0 * GOOD).settled(0.01).tolist() == [0, 0, 0]


def test_power_starts_at_the_false_alarm():
    found = fkgen.fault_effect(A, step(30, 10, [0.0, 1.0]))
    power = found.power(0.01)
    np.testing.assert_allclose(power[:10], 0.01, rtol=1e-9)
    assert power[10] > 0.99
    y = np.zeros((30, 2))
    y[12] = np.nan
    assert fkgen.fault_effect(A, step(30, 10, [0.0, 1.0]), y=y).power(0.01)[12] == 0.0
