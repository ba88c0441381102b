"""What compiled filters refuse, by name, and that nothing changes then: seen from Python."""

from __future__ import annotations

import pickle
from copy import copy

import numpy as np
import pytest
from plants import MOTOR, PARAMETERS, SENSED, VARYING, common, motor, random_model, spec

import fkgen
from fkgen.errors import StepRefused

INF, NAN = np.inf, np.nan


def fresh(plant):
    """A filter of its own, three samples into a record."""
    found = fkgen.build(plant)
    p, q = plant.model.ny, plant.model.nu
    for _ in range(3):
        found.step(np.full(p, 0.1), np.full(q, 1.0) if q else None)
    return found


def assert_refused(found, name, y, u=None, params=None):
    before = found.snapshot()
    with pytest.raises(StepRefused) as caught:
        found.step(y, u, params)
    assert caught.value.name == f"PLANT_{name}"
    assert caught.value.status < 0
    assert found.snapshot() == before


PLANTS = {
    "kf": motor("kf", SENSED),
    "mkf": motor("mkf", SENSED),
    "mme": motor("mme", SENSED),
    "float": motor("mme", SENSED, code={"scalar": "float"}),
    "joseph": motor("kf", SENSED, code={"update": "joseph"}),
}


@pytest.mark.parametrize("name", list(PLANTS))
@pytest.mark.parametrize(
    ("y", "u"),
    [
        ([0.0, INF], [1.0]),
        ([-INF, 0.0], [1.0]),
        ([INF, NAN], [1.0]),
        ([0.0, 0.0], [INF]),
        ([0.0, 0.0], [-INF]),
        ([0.0, 0.0], [NAN]),
        ([NAN, NAN], [NAN]),
    ],
)
def test_infinities_and_inputs_that_are_no_numbers_are_refused(name, y, u):
    assert_refused(fresh(PLANTS[name]), "INPUT_NOT_FINITE", y, u)


@pytest.mark.parametrize("name", list(PLANTS))
def test_a_missing_sample_is_no_refusal_but_says_so(name):
    found = fresh(PLANTS[name])
    assert found.step([NAN, NAN], [1.0]).status == 1
    assert found.step([NAN, 0.1], [1.0]).status == 0


@pytest.mark.parametrize("name", ["kf", "mkf", "joseph"])
def test_a_covariance_that_lost_its_positivity_is_refused(name):
    found = fresh(PLANTS[name])
    found.state("predicted_covariance")[:] = [-1.0, 0.0, -1.0]
    assert_refused(found, "NOT_POSITIVE_DEFINITE", [0.0, 0.0], [1.0])
    assert_refused(found, "NOT_POSITIVE_DEFINITE", [NAN, NAN], [1.0])


@pytest.mark.parametrize("name", ["mme", "float"])
@pytest.mark.parametrize("mode", [0, 4])
def test_one_hypothesis_that_lost_its_positivity_is_enough(name, mode):
    found = fresh(PLANTS[name])
    held = "mode_factors" if name == "float" else "mode_covariance"
    found.state(held).reshape(5, 3)[mode] = [1.0, 0.0, -1.0]
    assert_refused(found, "NOT_POSITIVE_DEFINITE", [0.0, 0.0], [1.0])


@pytest.mark.parametrize("member", ["predicted_state", "predicted_covariance"])
@pytest.mark.parametrize("value", [NAN, INF])
def test_an_instance_that_holds_no_numbers_is_refused(member, value):
    found = fresh(PLANTS["kf"])
    found.state(member)[:] = value
    before = bytes(found.state(member).tobytes())
    with pytest.raises(StepRefused):
        found.step([0.0, 0.0], [1.0])
    assert found.state(member).tobytes() == before


@pytest.mark.parametrize("family", ["kf", "mkf"])
def test_a_result_that_would_overflow_is_refused(family):
    # The speed is a thousand times what is measured, so 1e308 corrects it by 1e311.
    model = MOTOR | {"C": [[0.0, 1e-3]], "R": [[5e-12]]}
    assert_refused(fresh(motor(family, model)), "RESULT_NOT_FINITE", [1e308], [1.0])


def test_a_result_that_overflows_in_the_prediction_alone_is_refused():
    found = fresh(motor("kf", MOTOR | {"A": [[2.0, 0.0], [0.0, 0.9]]}))
    found.state("predicted_state")[:] = [1.7e308, 0.0]
    assert_refused(found, "RESULT_NOT_FINITE", [NAN], [1.0])


def test_likelihoods_that_overflow_in_a_bank_are_refused():
    found = fresh(PLANTS["mme"])
    assert_refused(found, "RESULT_NOT_FINITE", [1e200, 0.0], [1.0])


@pytest.mark.parametrize("rate", [-0.1, 1.1, np.nextafter(1.0, 2.0)])
@pytest.mark.parametrize("model", [MOTOR, SENSED], ids=["speed", "speed_and_voltage"])
def test_a_run_time_rate_outside_zero_and_one_is_refused(model, rate):
    plant = motor("mkf", model, actuator=common("xi"), parameters={"xi": 0.7})
    found = fresh(plant)
    y = [0.1] * plant.model.ny
    assert_refused(found, "PARAMETER_OUT_OF_RANGE", y, [1.0], {"xi": rate})


@pytest.mark.parametrize("rate", [0.0, 1.0])
def test_a_run_time_rate_of_zero_or_one_is_legal(rate):
    plant = motor("mkf", SENSED, actuator=common("xi"), parameters={"xi": 0.7})
    assert fresh(plant).step([0.1, 0.1], [1.0], {"xi": rate}).status == 0


def test_a_parameter_that_makes_a_variance_negative_is_refused():
    found = fresh(spec(VARYING, family="kf", parameters=PARAMETERS))
    assert_refused(found, "PARAMETER_OUT_OF_RANGE", [0.1, 0.1], [1.0], {"dt": -0.05})


def test_a_parameter_outside_the_domain_of_a_function_is_refused():
    model = random_model(81, 1, 1) | {"A": [["log(a)"]]}
    found = fresh(spec(model, family="kf", parameters={"a": 2.0}))
    assert_refused(found, "RESULT_NOT_FINITE", [0.1], None, {"a": -1.0})


@pytest.mark.parametrize("name", list(PLANTS))
def test_a_refused_sample_of_a_record_counts_as_missing(name):
    plant = PLANTS[name]
    rng = np.random.default_rng(3)
    y, u = rng.standard_normal((12, 2)), np.ones((12, 1))
    broken, missing = y.copy(), y.copy()
    broken[[0, 5], 1] = INF
    missing[[0, 5]] = NAN
    found = fkgen.build(plant)
    got, expected = found.run(broken, u), found.run(missing, u)
    np.testing.assert_array_equal(got.status, np.where(expected.status == 1, -2, 0))
    np.testing.assert_array_equal(got.refused, np.isin(np.arange(12), [0, 5]))
    assert not got.held.any()
    for port in found.ports:
        np.testing.assert_array_equal(got[port], expected[port])


@pytest.mark.parametrize("name", list(PLANTS))
def test_a_sample_with_an_input_that_is_no_number_is_held(name):
    plant = PLANTS[name]
    rng = np.random.default_rng(4)
    y, u = rng.standard_normal((12, 2)), np.ones((12, 1))
    y[4, 0] = NAN
    u[[0, 5, 6]] = NAN
    found = fkgen.build(plant)
    got = found.run(y, u)
    np.testing.assert_array_equal(got.held, np.isnan(u[:, 0]))
    np.testing.assert_array_equal(got.held, got["held"])
    left = found.run(y[~got.held], u[~got.held])
    start = found.run(y[:0], u[:0], start=(found.reset(), found.snapshot())[1])
    assert start.status.size == 0
    for port in found.ports:
        np.testing.assert_array_equal(got[port][~got.held], left[port])
        for k in (5, 6):
            np.testing.assert_array_equal(got[port][k], got[port][4])
    x0, P0 = plant.model.x0.values().ravel(), plant.model.P0.values()
    for of in ("filtered", "predicted"):
        np.testing.assert_array_equal(got[f"{of}_state"][0], x0.astype(found.layout.dtype))
        np.testing.assert_array_equal(got[f"{of}_covariance"][0], P0.astype(found.layout.dtype))
    assert np.isnan(got.innovation[0]).all()


@pytest.mark.parametrize("ranged", [False, True])
def test_a_snapshot_shows_the_innovations_that_a_run_shows(ranged):
    """NaN where the row is missing or out of its range; 0 where y is what was predicted."""
    outputs = [{"name": "a", "range": [-9.0, 9.0]} if ranged else {"name": "a"}, {"name": "b"}]
    model = {"A": [[1.0]], "C": [[1.0], [1.0]], "Q": [[0.1]], "R": [[1.0, 0.0], [0.0, 1.0]]}
    model |= {"x0": [0.0], "P0": [[1.0]], "outputs": outputs}
    table = {"name": "rows", "model": model, "filter": {"family": "kf"}}
    found = fkgen.build(fkgen.Spec.from_dict(table))
    first = [10.0 if ranged else np.nan, 0.0]
    wanted = [[np.nan, 0.0], [2.0, np.nan], [np.nan, np.nan]]
    assert np.isnan(found.snapshot().innovation).all()
    for y, innovation in zip((first, [2.0, np.nan], None), wanted, strict=True):
        taken = found.step(y)
        for each in (
            taken,
            found.snapshot(),
            pickle.loads(pickle.dumps(taken)),  # noqa: S301 - our own bytes
            copy(found).snapshot(),
        ):
            np.testing.assert_array_equal(each.innovation, innovation)
    run = found.run([first, [2.0, np.nan], [np.nan, np.nan]])
    np.testing.assert_array_equal(run.innovation, wanted)
    found.step([1.0, 1.0])
    found.restore(taken)
    with pytest.raises(fkgen.StepRefused):
        found.update([np.inf, 1.0])
    assert np.isnan(found.predict().innovation).all()
    found.reset()
    assert np.isnan(found.snapshot().innovation).all()


def test_a_sample_with_a_parameter_out_of_its_range_or_no_number_is_held():
    found = fkgen.build(spec(VARYING, family="kf", parameters=PARAMETERS))
    y, u = np.full((8, 2), 0.1), np.ones((8, 1))
    dt = np.array([0.1, 0.1, -0.05, 0.1, NAN, INF, 0.1, 0.1])
    got = found.run(y, u, {"dt": dt})
    wrong = ~(dt > 0) | np.isinf(dt)
    np.testing.assert_array_equal(got.held, wrong)
    np.testing.assert_array_equal(got.status[wrong], -4)
    kept = found.run(y[~wrong], u[~wrong], {"dt": dt[~wrong]})
    np.testing.assert_array_equal(got.predicted_state[~wrong], kept.predicted_state)


def test_a_sample_of_which_even_the_prediction_overflows_is_held():
    found = fkgen.build(motor("kf", MOTOR | {"A": [["a", 0.0], [0.0, 0.9]]}, parameters={"a": 0.9}))
    a = np.array([0.9, 0.9, 1e200, 0.9])
    got = found.run(np.full(4, 0.1), np.ones(4), {"a": a})
    np.testing.assert_array_equal(got.held, [False, False, True, False])
    np.testing.assert_array_equal(got.status, [0, 0, -5, 0])


@pytest.mark.parametrize(
    ("scalar", "huge", "far"), [("double", 1e308, 1e307), ("float", 3e38, 1e38)]
)
def test_no_port_of_an_accepted_sample_is_anything_but_finite(scalar, huge, far):
    model = {"A": [[1.0]], "Q": [["q"]], "x0": [0.0], "P0": [[1.0]]}
    one = model | {"C": [[1.0]], "R": [["r"]]}
    two = model | {"C": [[1.0], [0.0]], "R": [["r", "c"], ["c", "2*r"]]}
    wild = {"r": [1.0, huge, INF, 1.0], "q": [1.0, huge, 1.0], "c": [0.1, huge, -INF, NAN]}
    for table, p in ((one, 1), (two, 2)):
        given = {"q": 1.0, "r": 1.0} | ({"c": 0.0} if p == 2 else {})
        found = fkgen.build(spec(table, family="kf", parameters=given, code={"scalar": scalar}))
        for name, values in wild.items():
            for value in values if name in given else ():
                for size in (0.1, far, -far):
                    y = np.full((4, p), 0.1)
                    y[2, 0], y[3, 1:] = size, NAN
                    got = found.run(y, params={name: np.array([given[name], value] * 2)})
                    for port in found.ports:
                        sound = np.isfinite(got[port][~got.refused])
                        assert sound.all() or port == "innovation"


def test_the_message_names_the_status_and_says_what_it_means():
    with pytest.raises(StepRefused, match=r"-2 \(PLANT_INPUT_NOT_FINITE\): u holds NaN"):
        fresh(PLANTS["kf"]).step([0.0, 0.0], [NAN])


def test_a_noise_covariance_that_is_not_positive_is_refused_for_correlated_rows():
    model = random_model(82, 2, 2) | {"R": [[1.0, "c"], ["c", 1.0]]}
    found = fresh(spec(model, family="kf", parameters={"c": 0.5}))
    assert found.step([0.1, 0.1], None, {"c": 0.999}).status == 0
    assert_refused(found, "NOT_POSITIVE_DEFINITE", [0.1, 0.1], None, {"c": 5.0})
