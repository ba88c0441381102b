"""What holds for every record, and for every way to write the same plant down."""

from __future__ import annotations

import numpy as np
import pytest
import spread
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from plants import built, distance, independent, interpreted, random_model, record, spec

import fkgen
from fkgen.errors import StepRefused

ESTIMATES = ("filtered_state", "filtered_covariance", "predicted_state", "predicted_covariance")
COVARIANCES = (
    "filtered_covariance",
    "predicted_covariance",
    "innovation_covariance",
    "actuation_covariance",
    "mode_covariance",
    "mode_filtered_covariance",
    "compressed_noise",
    "predicted_compressed_noise",
)
KINDS = (
    *("kf_correlated", "mkf_independent", "mkf_sensed", "mme", "mme_independent"),
    *("dfcf", "cpcf"),
)

#: Examples are the same in every run; a failure is found again.
some = settings(
    max_examples=6,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
few = settings(some, max_examples=3)

numbers = st.floats(-1e3, 1e3, allow_subnormal=False)
gaps = st.one_of(numbers, st.just(np.nan))


@st.composite
def records(draw, q, p):
    """Measurements with gaps, inputs of any size."""
    T = draw(st.integers(1, 8))
    y = draw(arrays.arrays(np.float64, (T, p), elements=gaps))
    u = draw(arrays.arrays(np.float64, (T, q), elements=numbers))
    return y, u


def drawn(data, plant):
    return data.draw(records(plant.model.nu, plant.model.ny))


@pytest.mark.parametrize("name", KINDS)
@given(data=st.data())
@some
def test_covariances_are_symmetric_and_positive(name, data):
    plant = spread.specs()[name]
    y, u = drawn(data, plant)
    result = built(plant).run(y, u)
    assert (result.status >= 0).all()
    for port in set(COVARIANCES) & set(result.ports):
        P = result[port]
        np.testing.assert_array_equal(P, np.swapaxes(P, -1, -2))
        # Rounding of the largest eigenvalue.
        eigenvalues = np.linalg.eigvalsh(P)
        assert (eigenvalues[..., 0] >= -1e-12 * np.abs(eigenvalues[..., -1])).all()


@pytest.mark.parametrize("name", [n for n in spread.NAMES if n.startswith("mme")])
@given(data=st.data())
@some
def test_probabilities_are_probabilities_and_sum_to_one(name, data):
    plant = spread.specs()[name]
    y, u = drawn(data, plant)
    result = built(plant).run(y, u)
    weight = result.mode_probability
    # One rounding per hypothesis.
    np.testing.assert_allclose(weight.sum(axis=1), 1.0, rtol=0.0, atol=1e-12)
    assert ((weight >= 0.0) & (weight <= 1.0 + 1e-15)).all()
    rates = np.array(plant.filter.options.hypotheses)
    estimate = result.success_rate_estimate.reshape(len(y), -1)
    assert (estimate >= rates.min(axis=0) - 1e-12).all()
    assert (estimate <= rates.max(axis=0) + 1e-12).all()


@pytest.mark.parametrize("name", KINDS)
@given(data=st.data())
@some
def test_a_run_is_its_steps(name, data):
    plant = spread.specs()[name]
    y, u = drawn(data, plant)
    whole, single = built(plant).run(y, u), fkgen.build(plant)
    for k in range(len(y)):
        snapshot = single.step(y[k], u[k])
        assert snapshot.status == whole.status[k]
        for port in set(whole.ports) - {"innovation"}:  # NaN where a row is missing
            np.testing.assert_array_equal(snapshot[port], whole[port][k])


@pytest.mark.parametrize("name", KINDS)
@given(data=st.data())
@some
def test_a_batch_is_its_runs(name, data):
    plant = spread.specs()[name]
    y, u = drawn(data, plant)
    other = np.where(np.isnan(y), 0.5, -y)
    batch = built(plant).run_batch(np.stack([y, other]), u)
    separate = built(plant).run_batch(np.stack([y, other]), np.stack([u, u]))
    for m, one in enumerate((y, other)):
        alone = built(plant).run(one, u)
        for port in alone.ports:
            np.testing.assert_array_equal(batch[port][m], alone[port])
            np.testing.assert_array_equal(separate[port][m], alone[port])
        np.testing.assert_array_equal(batch.status[m], alone.status)


@pytest.mark.parametrize("name", KINDS)
@given(data=st.data(), bad=st.sampled_from([np.inf, -np.inf]))
@some
def test_a_refused_step_changes_nothing(name, data, bad):
    plant = spread.specs()[name]
    y, u = drawn(data, plant)
    found = fkgen.build(plant)
    for k in range(len(y)):
        found.step(y[k], u[k])
    before = found.snapshot()
    broken = y[-1].copy()
    broken[data.draw(st.integers(0, len(broken) - 1))] = bad
    with pytest.raises(StepRefused):
        found.step(broken, u[-1])
    with pytest.raises(StepRefused):
        found.step(y[-1], np.full(u.shape[1], bad))
    assert found.snapshot() == before


@pytest.mark.parametrize("name", KINDS)
@given(data=st.data())
@some
def test_what_comes_later_does_not_change_what_was_said(name, data):
    plant = spread.specs()[name]
    y, u = drawn(data, plant)
    cut = data.draw(st.integers(1, len(y)))
    whole, part = built(plant).run(y, u), built(plant).run(y[:cut], u[:cut])
    for port in part.ports:
        np.testing.assert_array_equal(part[port], whole[port][:cut])


def changed(plant, T, Y, U):
    """The plant in other units or another order: x' = T x, y' = Y y, u' = U u."""
    m = plant.model
    Ti, Ui = np.linalg.inv(T), np.linalg.inv(U)
    given = plant.to_dict()
    given["model"] = {
        "A": T @ m.A.values() @ Ti,
        "B": T @ m.B.values() @ Ui,
        "C": Y @ m.C.values() @ Ti,
        "D": Y @ m.D.values() @ Ui,
        "Q": T @ m.Q.values() @ T.T,
        "R": Y @ m.R.values() @ Y.T,
        "x0": (T @ m.x0.values()).ravel(),
        "P0": T @ m.P0.values() @ T.T,
    }
    return fkgen.Spec.from_dict(given)


def transformable():
    """Plants whose inputs fail independently or together: any order of them is as good."""
    model = random_model(101, 3, 2, 2, direct=True, correlated=True)
    bank = {"actuator": {"dependence": "common"}, "hypotheses": [0.3, 0.8]}
    return {
        "kf": spec(model, family="kf"),
        "mkf": spec(model, family="mkf", actuator=independent(0.6)),
        "mme": spec(model, family="mme", **bank),
    }


@pytest.mark.parametrize("family", ["kf", "mkf", "mme"])
@given(data=st.data())
@few
def test_other_units_and_another_order_say_the_same(family, data):
    plant = transformable()[family]
    y, u = record(plant, 10, missing=0.2)
    scale = st.lists(st.floats(1e-3, 1e3), min_size=3, max_size=3)
    T = np.diag(data.draw(scale))[data.draw(st.permutations(range(3)))]
    Y = np.diag(data.draw(scale)[:2])[data.draw(st.permutations(range(2)))]
    U = np.diag(data.draw(scale)[:2])[data.draw(st.permutations(range(2)))]
    place = np.argmax(Y != 0.0, axis=1)
    factor = Y[np.arange(2), place]
    a = interpreted(plant, y, u)
    b = interpreted(changed(plant, T, Y, U), y[:, place] * factor, u @ U.T)
    # Rows are processed in another order, with entries scaled by up to 1e6.
    expected = {
        "filtered_state": a["filtered_state"] @ T.T,
        "predicted_state": a["predicted_state"] @ T.T,
        "filtered_covariance": T @ a["filtered_covariance"] @ T.T,
        "predicted_covariance": T @ a["predicted_covariance"] @ T.T,
        "innovation": a["innovation"][:, place] * factor,
        "nis": a["nis"],
    }
    if family == "mkf":
        expected["gain"] = T @ a["gain"] @ np.linalg.inv(Y)
    if family == "mme":
        expected["mode_probability"] = a["mode_probability"]
    for port, value in expected.items():
        assert distance(b[port], value) < 1e-9, port


@pytest.mark.parametrize("family", ["kf", "mkf"])
@given(row=st.integers(0, 2), data=st.data())
@few
def test_a_missing_row_is_a_deleted_row(family, row, data):
    model = random_model(102, 2, 3, 1, direct=True, correlated=True)
    kept = [i for i in range(3) if i != row]
    fewer = model | {
        "C": [model["C"][i] for i in kept],
        "D": [model["D"][i] for i in kept],
        "R": [[model["R"][i][j] for j in kept] for i in kept],
    }
    faults = {} if family == "kf" else {"actuator": independent(0.6)}
    whole, part = (spec(m, family=family, **faults) for m in (model, fewer))
    y = data.draw(arrays.arrays(np.float64, (6, 3), elements=gaps))
    u = data.draw(arrays.arrays(np.float64, (6, 1), elements=numbers))
    y[:, row] = np.nan
    a, b = interpreted(whole, y, u), interpreted(part, y[:, kept], u)
    for port in ESTIMATES:
        # The same path with other zeros; D u reaches 1e3 times the noise.
        assert distance(a[port], b[port]) < 1e-9
