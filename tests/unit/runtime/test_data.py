"""Records that do not fit are refused in one line that says what fits."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from plants import PARAMETERS, SENSED, VARYING, built, motor, random_model, record, spec

import fkgen
from fkgen.errors import DataError, StepRefused
from fkgen.runtime import record as checks

PLANT = motor("mkf", SENSED)
GIVEN = spec(VARYING, family="kf", parameters=PARAMETERS)
SINGLE = spec(random_model(84, 2, 1), family="kf")
Y, U = np.zeros((5, 2)), np.ones((5, 1))


@pytest.mark.parametrize(
    ("y", "u", "message"),
    [
        (np.zeros(5), U, r"y: given shape \(5,\); expected shape \(T, 2\)"),
        (np.zeros((5, 3)), U, r"y: given shape \(5, 3\)"),
        (np.zeros((2, 5, 2)), U, r"y: given shape \(2, 5, 2\)"),
        (0.0, U, "y: given shape"),
        (None, U, r"y: given nothing; expected shape \(T, 2\): y0, y1"),
        (Y, None, r"u: given nothing; expected shape \(T, 1\): u0"),
        (Y, np.ones((4, 1)), "u: given 4 samples; expected 5, as many as y has"),
        (Y, np.ones((5, 2)), r"u: given shape \(5, 2\)"),
        (Y, 1.0, "u: given 1 samples"),
        ([["a", "b"]] * 5, U, r"y\.y0\[0\]: given text 'a'; expected a real number"),
        (Y + 1j, U, "y: given type complex128"),
        (Y > 0.0, U, "y: given type bool"),
        ([[None, {}]] * 5, U, r"y\.y1\[0\]: given \{\} of type dict; expected a real number"),
        (Y, [["one"]] * 5, r"u\.u0\[0\]: given text 'one'"),
    ],
)
def test_records_of_another_shape_or_type_are_refused(y, u, message):
    with pytest.raises(DataError, match=message):
        built(PLANT).run(y, u)


def test_inputs_for_a_plant_without_any_are_refused():
    with pytest.raises(DataError, match="u: given inputs; expected none: the model has no B"):
        built(SINGLE).run(np.zeros((5, 1)), np.zeros((5, 1)))


def test_inputs_without_columns_are_no_inputs():
    y = np.arange(4.0)[:, None]
    expected = built(SINGLE).run(y).filtered_state
    found = built(SINGLE).run(y, np.zeros((4, 0))).filtered_state
    np.testing.assert_array_equal(found, expected)


def test_one_column_may_be_a_flat_array_and_anything_numeric_will_do():
    filtered = built(SINGLE)
    expected = filtered.run(np.arange(4.0)[:, None]).filtered_state
    for y in ([0, 1, 2, 3], np.arange(4, dtype=np.int16), np.arange(4, dtype=np.float32)):
        np.testing.assert_array_equal(filtered.run(y).filtered_state, expected)
    strided = np.zeros((4, 2))
    strided[:, 0] = np.arange(4.0)
    np.testing.assert_array_equal(filtered.run(strided[:, :1]).filtered_state, expected)


def test_none_is_a_missing_row():
    filtered = built(SINGLE)
    given = filtered.run([1.0, None, 2.0])
    np.testing.assert_array_equal(given.status, [0, 1, 0])


def test_a_record_without_samples_gives_results_without_samples():
    result = built(PLANT).run(np.zeros((0, 2)), np.zeros((0, 1)))
    assert result.filtered_covariance.shape == (0, 2, 2)
    assert result.status.shape == (0,)


def test_an_unknown_port_is_refused_with_a_suggestion():
    with pytest.raises(DataError, match="keep: given 'filterd_state'; expected 'filtered_state'"):
        built(PLANT).run(Y, U, keep=["filterd_state"])
    result = built(PLANT).run(Y, U, keep=["nis"])
    with pytest.raises(DataError, match="port: given 'filtered_state'"):
        result["filtered_state"]
    with pytest.raises(AttributeError, match="no port 'filtered_state' was kept; there are: nis"):
        _ = result.filtered_state
    with pytest.raises(DataError, match="port: given 'gian'"):
        built(PLANT).state("gian")


def test_what_is_kept_is_what_there_is():
    result = built(PLANT).run(Y, U, keep=("nis", "filtered_state"))
    assert set(result.ports) == {"nis", "filtered_state"} == set(result)
    assert built(PLANT).run(Y, U, keep="nis").ports == ("nis",)
    assert built(PLANT).run(Y, U).ports == built(PLANT).ports
    np.testing.assert_array_equal(result["nis"], result.nis)


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"dtt": 0.1}, r"params\.dtt: given an unknown name; expected 'dt'"),
        ({"quite_else": 0.1}, "expected one of: dt, angle"),
        ({"dt": np.nan}, r"params\.dt\[0\]: given nan; expected a finite number"),
        ({"dt": [0.1, 0.2]}, r"params\.dt: given shape \(2,\); expected a number or shape \(5,\)"),
        ({"dt": "0.1"}, r"params\.dt: given text"),
    ],
)
def test_parameters_that_do_not_fit_are_refused(params, message):
    with pytest.raises(DataError, match=message):
        built(GIVEN).run(Y, U, params)


def test_parameters_of_a_filter_without_any_are_refused():
    with pytest.raises(DataError, match="expected nothing: the filter has none"):
        built(PLANT).run(Y, U, {"dt": 0.1})


@pytest.mark.parametrize(
    ("y", "u", "params"),
    [
        ([1.0, 2.0, 3.0], [1.0], None),
        ([1.0, 2.0], [1.0, 2.0], None),
        (["a", "b"], [1.0], None),
        ([1.0, 2.0], [1.0], {"td": 0.1}),
        ([1.0, 2.0], [1.0], {"dt": "fast"}),
    ],
)
def test_a_step_that_does_not_fit_is_refused_and_changes_nothing(y, u, params):
    found = fkgen.build(GIVEN)
    found.step([1.0, 2.0], [1.0])
    before = found.snapshot()
    with pytest.raises(DataError, match=r"given .* expected"):
        found.step(y, u, params)
    assert found.snapshot() == before


@pytest.mark.parametrize(("y", "u"), [([1.0], [1.0]), (1.0, [1.0]), ([1.0, 2.0], None)])
def test_a_step_never_repeats_a_number_to_fill_a_vector(y, u):
    with pytest.raises(DataError):
        fkgen.build(GIVEN).step(y, u)


def test_a_step_of_a_filter_without_inputs_refuses_some():
    with pytest.raises(DataError):
        fkgen.build(SINGLE).step([1.0], [1.0])


def test_a_refused_parameter_is_forgotten():
    found = fkgen.build(GIVEN)
    with pytest.raises(StepRefused):
        found.step([1.0, 2.0], [1.0], {"dt": -0.05})
    assert found.step([1.0, 2.0], [1.0]).status == 0


@pytest.mark.parametrize("params", [{"dt": 0.2}, {"dt": 0.2, "angle": -1.0}])
def test_a_step_with_parameters_is_a_run_with_parameters(params):
    y, u = record(GIVEN, 4, params=params)
    found = fkgen.build(GIVEN)
    expected = built(GIVEN).run(y, u, params)
    for k in range(4):
        snapshot = found.step(y[k], u[k], params)
        np.testing.assert_array_equal(snapshot.predicted_state, expected.predicted_state[k])
    found.reset()
    plain = built(GIVEN).run(y[:1], u[:1])
    np.testing.assert_array_equal(found.step(y[0], u[0]).predicted_state, plain.predicted_state[0])


@pytest.mark.parametrize(
    ("y", "u", "message"),
    [
        (np.zeros((5, 2)), U, r"y: given shape \(5, 2\); expected shape \(M, T, 2\)"),
        (np.zeros((3, 5, 2)), np.ones((2, 5, 1)), "u: given 2 records; expected 3"),
        (np.zeros((3, 5, 2)), None, "u: given nothing"),
        (np.zeros((3, 5, 2)), np.ones((3, 4, 1)), "u: given 4 samples"),
    ],
)
def test_batches_that_do_not_fit_are_refused(y, u, message):
    with pytest.raises(DataError, match=message):
        built(PLANT).run_batch(y, u)


def test_a_batch_without_records_or_samples_is_empty():
    for shape in ((0, 5, 2), (3, 0, 2)):
        run = built(PLANT).run_batch(np.zeros(shape), np.zeros((shape[1], 1)))
        assert run.filtered_state.shape == (*shape[:2], 2)
        assert run.status.shape == shape[:2]


def test_a_batch_that_no_memory_holds_is_refused_before_it_begins(monkeypatch):
    monkeypatch.setattr(checks, "memory", lambda: 1000)
    with pytest.raises(DataError, match=r"keep: given 1 ports of 3 x 50 samples: .* GiB; expected"):
        built(PLANT).run_batch(np.zeros((3, 50, 2)), np.zeros((50, 1)), keep=["filtered_state"])
    with pytest.raises(DataError, match=r"y: given numbers whose copy takes .* GiB; expected"):
        built(PLANT).run_batch(np.zeros((50, 3, 2)).swapaxes(0, 1), np.zeros((50, 1)))


def test_a_large_copy_is_announced_and_has_the_same_results(monkeypatch):
    monkeypatch.setattr(checks, "NOTED", 1000)
    y = np.random.default_rng(1).standard_normal((50, 3, 2))
    u = np.zeros((50, 1))
    whole = built(PLANT).run_batch(np.ascontiguousarray(y.swapaxes(0, 1)), u)
    with pytest.warns(UserWarning, match="y is copied .* a C-contiguous array of float64 is not"):
        turned = built(PLANT).run_batch(y.swapaxes(0, 1), u)
    np.testing.assert_array_equal(turned.filtered_state, whole.filtered_state)


def test_results_are_of_the_scalar_type_of_the_filter():
    single = motor("mkf", SENSED, code={"scalar": "float"})
    assert built(single).run(Y, U).filtered_state.dtype == np.float32
    assert built(PLANT).run(Y.astype(np.float32), U).filtered_state.dtype == np.float64


def test_a_snapshot_stays_as_it_was_and_says_what_it_is():
    found = fkgen.build(PLANT)
    first = found.step([0.1, 0.2], [1.0])
    state = first.filtered_state.copy()
    second = found.step([0.3, 0.4], [1.0])
    np.testing.assert_array_equal(first.filtered_state, state)
    assert first != second
    assert first.ports == found.ports
    assert "filtered_state" in repr(first)
    with pytest.raises(AttributeError, match="no port 'speed'"):
        _ = first.speed


def test_a_snapshot_can_be_copied():
    first = fkgen.build(PLANT).step([0.1, 0.2], [1.0])
    assert copy.deepcopy(first) == first
