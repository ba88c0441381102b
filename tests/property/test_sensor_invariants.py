"""Filters for faulty sensors: what holds for every record, law, unit and name of a mode."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from plants import built, distance, interpreted, random_model
from sensor_specs import DENSE, EVERY, SWITCHING, chain, every, plane, sensed

import fkgen
from fkgen.errors import StepRefused
from fkgen.oracle.exact.enumeration import enumerate_modes
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.plants.sensor import SensorLaw

WEIGHING = ("one_step", "one_step_paper", "imm", "imm_zeros", "imm_product", "imm3", "imm_jump")
GAUSSIAN = ("one_step", "imm")

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
def records(draw, plant):
    """Measurements with gaps, inputs of any size, and what a genie is told."""
    T = draw(st.integers(1, 8))
    y = draw(arrays.arrays(np.float64, (T, plant.model.ny), elements=gaps))
    u = draw(arrays.arrays(np.float64, (T, plant.model.nu), elements=numbers))
    if plant.filter.family != "genie":
        return y, u, {}
    told = {"gamma": st.sampled_from([0.0, 1.0]), "delta": st.sampled_from([1.0, 10.0])}
    return y, u, {name: draw(arrays.arrays(np.float64, T, elements=e)) for name, e in told.items()}


def now(params, k):
    return {name: values[k] for name, values in params.items()}


@pytest.mark.parametrize("name", EVERY)
@given(data=st.data())
@some
def test_covariances_are_symmetric_and_positive(name, data):
    plant = every()[name]
    y, u, params = data.draw(records(plant))
    result = built(plant).run(y, u, params)
    assert (result.status >= 0).all()
    ports = [p for p in result.ports if p.endswith(("covariance", "second_moment"))]
    assert len(ports) >= 3
    for port in ports:
        P = result[port]
        np.testing.assert_array_equal(P, np.swapaxes(P, -1, -2))
        # Rounding of the largest eigenvalue.
        eigenvalues = np.linalg.eigvalsh(P)
        assert (eigenvalues[..., 0] >= -1e-12 * np.abs(eigenvalues[..., -1])).all(), port


@pytest.mark.parametrize("name", WEIGHING)
@given(data=st.data())
@some
def test_probabilities_are_probabilities_and_sum_to_one(name, data):
    plant = every()[name]
    y, u, _ = data.draw(records(plant))
    result = built(plant).run(y, u)
    for prefix in ("", "predicted_"):
        p, log = result[f"{prefix}mode_probability"], result[f"{prefix}log_weight"]
        # One rounding per mode.
        np.testing.assert_allclose(p.sum(axis=1), 1.0, rtol=0.0, atol=1e-13)
        assert ((p >= 0.0) & (p <= 1.0 + 1e-14)).all()
        held = p > 1e-300
        np.testing.assert_allclose(np.log(p[held]), log[held], rtol=1e-12, atol=1e-13)
        assert (log[~held] < -690.0).all()


@pytest.mark.parametrize("name", WEIGHING)
@given(data=st.data())
@some
def test_the_law_of_the_next_mode_is_that_of_this_one_through_the_kernel(name, data):
    plant = every()[name]
    y, u, _ = data.draw(records(plant))
    result = built(plant).run(y, u)
    faults = plant.faults
    kernel = np.array(faults.jump.transition if name == "imm_jump" else faults.sensor.kernel)
    if name == "imm3":  # both modes without signal come as one, with the law of the noise unsaid
        kernel = kernel[:, :2].sum(axis=1, keepdims=True)
        rate = result.mode_probability[:, :2].sum(axis=1) * kernel[0]
        rate += result.mode_probability[:, 2] * kernel[2]
        found = result.predicted_mode_probability[:, :2].sum(axis=1)
        np.testing.assert_allclose(found, rate, rtol=1e-13)
        return
    np.testing.assert_allclose(
        result.predicted_mode_probability, result.mode_probability @ kernel, rtol=0.0, atol=1e-14
    )


@pytest.mark.parametrize("name", EVERY)
@given(data=st.data())
@some
def test_a_run_is_its_steps_and_a_batch_is_its_runs(name, data):
    plant = every()[name]
    y, u, params = data.draw(records(plant))
    other = np.where(np.isnan(y), 0.5, -y)
    whole, single = built(plant).run(y, u, params), fkgen.build(plant)
    batch = built(plant).run_batch(np.stack([y, other]), u, params)
    second = built(plant).run(other, u, params)
    for port in whole.ports:
        np.testing.assert_array_equal(batch[port][0], whole[port])
        np.testing.assert_array_equal(batch[port][1], second[port])
    for k in range(len(y)):
        snapshot = single.step(y[k], u[k] if u.shape[1] else None, now(params, k))
        assert snapshot.status == whole.status[k]
        for port in set(whole.ports) - {"innovation"}:  # NaN where a row is missing
            np.testing.assert_array_equal(snapshot[port], whole[port][k])


@pytest.mark.parametrize("name", EVERY)
@given(data=st.data(), bad=st.sampled_from([np.inf, -np.inf]))
@some
def test_a_refused_step_changes_nothing(name, data, bad):
    plant = every()[name]
    y, u, params = data.draw(records(plant))
    found = fkgen.build(plant)
    for k in range(len(y)):
        found.step(y[k], u[k] if u.shape[1] else None, now(params, k))
    before = found.snapshot()
    broken = y[-1].copy()
    broken[data.draw(st.integers(0, 1))] = bad
    good = u[-1] if u.shape[1] else None
    with pytest.raises(StepRefused):
        found.step(broken, good)
    if u.shape[1]:
        with pytest.raises(StepRefused):
            found.step(y[-1], np.full(u.shape[1], bad))
    if name in WEIGHING:
        with pytest.raises(StepRefused):
            found.step(np.full(2, 1e200), good)
    if name == "genie":
        wrong = data.draw(st.floats(-10.0, 10.0).filter(lambda v: v not in {0.0, 1.0}))
        with pytest.raises(StepRefused):
            found.step(y[-1], good, {"gamma": wrong})
    assert found.snapshot() == before


@st.composite
def laws(draw, *, first=None):
    """Kernels and starts, some of their entries zero: (kernel, initial)."""
    share = st.one_of(st.just(0.0), st.floats(0.01, 1.0))
    kernel = draw(arrays.arrays(np.float64, (4, 4), elements=share)) + 1e-3 * np.eye(4)
    start = draw(arrays.arrays(np.float64, 4, elements=share)) + 1e-3
    if first is not None:
        start = np.eye(4)[first]
    return kernel / kernel.sum(axis=1, keepdims=True), start / start.sum()


@pytest.mark.parametrize("family", GAUSSIAN)
@given(data=st.data(), seed=st.integers(0, 1000))
@few
def test_naming_the_noisy_mode_nominal_changes_the_names_only(family, data, seed):
    kernel, start = data.draw(laws())
    order, model = [1, 0, 3, 2], plane()
    here = sensed(model, chain(kernel, start), family=family)
    turned = chain(kernel[np.ix_(order, order)], start[order], noise_factor=0.1)
    noisy = model | {"R": (10.0 * np.array(model["R"])).tolist()}
    there = sensed(noisy, turned, family=family)
    y = 2.0 * np.random.default_rng(seed).standard_normal((8, 2))
    a, b = (interpreted(spec, y, np.zeros((8, 0))) for spec in (here, there))
    # The same sums in another order; the factor 0.1 is rounded.
    for port in ("filtered_state", "filtered_covariance", "predicted_state", "nis"):
        assert distance(b[port], a[port]) < 1e-9, port
    assert distance(b["mode_probability"], a["mode_probability"][:, order]) < 1e-9


@pytest.mark.parametrize("family", GAUSSIAN)
@given(data=st.data(), first=st.integers(0, 3), seed=st.integers(0, 1000))
@few
def test_a_known_first_mode_makes_two_samples_bayes_rule(family, data, first, seed):
    kernel, start = data.draw(laws(first=first))
    spec = sensed(random_model(91, 2, 2, correlated=True), chain(kernel, start), family=family)
    y, u = 2.0 * np.random.default_rng(seed).standard_normal((2, 2)), np.zeros((2, 0))
    found = interpreted(spec, y, u)
    exact = enumerate_modes(LinearSystem.from_spec(spec, 2), SensorLaw.from_spec(spec), y, u)
    for port in ("filtered_state", "filtered_covariance", "mode_probability", "log_likelihood"):
        assert distance(found[port], getattr(exact, port)) < 1e-9, port


def in_units(spec, T, Y):
    """The plant with x' = T x and y' = Y y; Y permutes and scales rows, all of which can fail."""
    m, given_spec = spec.model, spec.to_dict()
    back = np.linalg.inv(T)
    given_spec["model"] = {
        "A": T @ m.A.values() @ back,
        "C": Y @ m.C.values() @ back,
        "Q": T @ m.Q.values() @ T.T,
        "R": Y @ m.R.values() @ Y.T,
        "x0": (T @ m.x0.values()).ravel(),
        "P0": T @ m.P0.values() @ T.T,
    }
    return fkgen.Spec.from_dict(given_spec)


UNITS = {
    **{name: options for name, options in SWITCHING.items() if name != "weighted"},
    "linear_optimal": {"family": "linear_optimal"},
    "augmented": {"family": "linear_optimal", "form": "augmented"},
    "genie": {"family": "genie"},
}


@pytest.mark.parametrize("name", list(UNITS))
@given(data=st.data())
@few
def test_other_units_and_another_order_say_the_same(name, data):
    law = {} if name == "genie" else chain(DENSE, [0.4, 0.1, 0.2, 0.3])
    spec = sensed(plane(), law, **UNITS[name])
    scale = st.lists(st.floats(1e-3, 1e3), min_size=2, max_size=2)
    T, Y = (np.diag(data.draw(scale))[data.draw(st.permutations(range(2)))] for _ in range(2))
    T @= np.array([[1.0, data.draw(st.floats(-1.0, 1.0))], [0.0, 1.0]])
    place = np.argmax(Y != 0.0, axis=1)
    factor = Y[np.arange(2), place]
    rng = np.random.default_rng(6)
    y, u = 2.0 * rng.standard_normal((10, 2)), np.zeros((10, 0))
    y[3, 0] = y[5] = y[7, 1] = np.nan
    a, b = interpreted(spec, y, u), interpreted(in_units(spec, T, Y), y[:, place] * factor, u)
    expected = {
        "filtered_state": a["filtered_state"] @ T.T,
        "filtered_covariance": T @ a["filtered_covariance"] @ T.T,
        "predicted_state": a["predicted_state"] @ T.T,
        "innovation": a["innovation"][:, place] * factor,
        "nis": a["nis"],
    }
    if "mode_probability" in a:
        expected["mode_probability"] = a["mode_probability"]
    if "measurement_gain" in a:
        expected["measurement_gain"] = T @ a["measurement_gain"] @ np.linalg.inv(Y)
    for port, value in expected.items():
        # Rows are processed in another order, with entries scaled by up to 1e6.
        assert distance(b[port], value) < 1e-9, port
    present = np.isfinite(y) @ np.log(np.abs(factor[np.argsort(place)]))  # densities are per unit
    np.testing.assert_allclose(
        b["log_likelihood"] + present, a["log_likelihood"], rtol=0.0, atol=1e-8
    )


@pytest.mark.parametrize("name", list(UNITS))
@given(row=st.integers(0, 2), seed=st.integers(0, 1000))
@few
def test_a_missing_row_is_a_deleted_row(name, row, seed):
    model = plane() | {key: random_model(92, 2, 3, correlated=True)[key] for key in "CR"}
    kept = [i for i in range(3) if i != row]
    fewer = model | {
        "C": [model["C"][i] for i in kept],
        "R": [[model["R"][i][j] for j in kept] for i in kept],
    }
    law = {} if name == "genie" else chain(DENSE, [0.4, 0.1, 0.2, 0.3])
    whole, part = (sensed(each, law, **UNITS[name]) for each in (model, fewer))
    rng = np.random.default_rng(seed)
    y, u = 2.0 * rng.standard_normal((6, 3)), np.zeros((6, 0))
    y[2] = y[:, row] = np.nan
    a, b = interpreted(whole, y, u), interpreted(part, y[:, kept], u)
    ports = ["filtered_state", "filtered_covariance", "predicted_state", "predicted_covariance"]
    ports += ["mode_probability"] if "mode_probability" in a else []
    for port in (*ports, "nis", "log_likelihood"):
        # The same path with other zeros.
        assert distance(a[port], b[port]) < 1e-11, port
