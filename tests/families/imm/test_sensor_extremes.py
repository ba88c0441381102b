"""Missing, distant and impossible samples: what the filters that weigh modes make of them."""

from __future__ import annotations

import numpy as np
import pytest
from plants import assert_agree, distance, random_model, run
from sensor_specs import (
    DENSE,
    EXACT,
    HOLES,
    MATCHED,
    SCALAR,
    SWITCHING,
    chain,
    final,
    plane,
    product,
    seen,
    sensed,
    textbook,
)

import fkgen
from fkgen.errors import StepRefused

STICKY = [[0.8, 0.2], [0.3, 0.7]]
LAW = product(STICKY, [[0.9, 0.1], [0.4, 0.6]], initial=(0.6, 0.8))
SCALARS = ("double", "float")
ALL = ("one_step", "imm", "imm3")

#: Up to here squares are logarithms that the type can tell from that of zero.
FAR = {"double": 1e140, "float": 1e14}


def scalar_plant(which, scalar="double", law=LAW):
    """The plant of sec. VI with a prior that is not certain."""
    return sensed(SCALAR | {"P0": [[1.0]]}, law, code={"scalar": scalar}, **SWITCHING[which])


def rows_plant(which):
    return sensed(plane(), chain(DENSE, [0.4, 0.1, 0.2, 0.3], rows=[0]), **SWITCHING[which])


@pytest.mark.parametrize("which", MATCHED)
def test_a_missing_sample_moves_the_probabilities_by_the_chain_alone(which):
    spec = rows_plant(which)
    y, u, _ = seen(spec, 12)
    y[4:7] = np.nan
    result = run(spec, y, u)
    P, mu = np.array(DENSE), result.mode_probability[3]
    for k in (4, 5, 6):
        mu = mu @ P  # the law of mode k given y[0..3], by hand
        # A sum of four products, in another order.
        np.testing.assert_allclose(result.mode_probability[k], mu, rtol=1e-14)
        np.testing.assert_array_equal(
            result.mode_probability[k], result.predicted_mode_probability[k - 1]
        )
        np.testing.assert_allclose(
            result.filtered_state[k], result.predicted_state[k - 1], rtol=1e-12, atol=1e-13
        )
        assert result.status[k] == 1
        assert result.log_likelihood[k] == result.nis[k] == 0.0
        assert np.isnan(result.innovation[k]).all()


def test_a_missing_first_sample_leaves_the_prior_and_the_law_of_the_start():
    for which in MATCHED:
        spec = rows_plant(which)
        result = run(spec, np.full((1, 2), np.nan))
        np.testing.assert_array_equal(result.mode_probability[0], [0.4, 0.1, 0.2, 0.3])
        np.testing.assert_array_equal(result.filtered_state[0], spec.model.x0.values()[:, 0])
        # A mixture of four equal Gaussians.
        assert distance(result.filtered_covariance[0], spec.model.P0.values()) < 1e-15


@pytest.mark.parametrize("which", MATCHED)
def test_a_missing_row_that_cannot_fail_changes_what_the_other_says_by_its_noise_only(which):
    model = random_model(45, 2, 2)  # R is diagonal
    fewer = model | {"C": model["C"][:1], "R": [[model["R"][0][0]]]}
    law = chain(DENSE, [0.4, 0.1, 0.2, 0.3], rows=[0])
    whole, part = (sensed(each, law, **SWITCHING[which]) for each in (model, fewer))
    y, u, _ = seen(whole, 10)
    y[:, 1] = np.nan
    ports = ("filtered_state", "filtered_covariance", "mode_probability", "log_likelihood", "nis")
    assert_agree(run(whole, y, u), run(part, y[:, :1], u), ports, 1e-12)


@pytest.mark.exhaustive
@pytest.mark.parametrize("which", MATCHED)
def test_twenty_thousand_missing_samples_lead_to_the_stationary_law(which):
    spec = rows_plant(which)
    y, u, _ = seen(spec, 20020)
    y[5:20010] = np.nan
    result = run(spec, y, u, keep=("mode_probability", "filtered_covariance", "filtered_state"))
    mu = result.mode_probability
    # The rounding of a sum, once a sample: 20000 of them may add up.
    np.testing.assert_allclose(mu.sum(axis=1), 1.0, rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(mu[20009] @ np.array(DENSE), mu[20009], rtol=1e-11)
    A, Q = spec.model.A.values(), spec.model.Q.values()
    P = result.filtered_covariance[20009]
    np.testing.assert_allclose(A @ P @ A.T + Q, P, rtol=1e-12)  # the Lyapunov equation
    assert np.isfinite(result.filtered_state).all()
    again = textbook(spec, y[:200], u[:200])  # another 20000 change nothing but rounding
    assert distance(mu[5:15], again.mode_probability[5:15]) < EXACT


@pytest.mark.parametrize("scalar", SCALARS)
@pytest.mark.parametrize("which", ALL)
def test_a_measurement_of_a_hundred_million_is_filtered(which, scalar):
    spec = scalar_plant(which, scalar)
    y, u, _ = seen(spec, 10)
    y[3], y[6] = 1e8, -1e8
    result = run(spec, y, u)
    assert (result.status == 0).all()
    for port in result.ports:
        assert np.isfinite(result[port]).all(), port
    # Roundings of the type.
    eps = np.finfo(scalar if scalar == "double" else "float32").eps
    np.testing.assert_allclose(result.mode_probability.sum(axis=1), 1.0, rtol=0.0, atol=8 * eps)
    assert result.mode_probability[3, 1] > 0.999  # the widest density that there is
    if scalar == "double":  # weights are exponentials of differences of numbers of 1e15
        expected = textbook(spec, y, u)
        assert distance(result.filtered_state, expected.filtered_state) < EXACT
        assert distance(result.mode_probability, expected.mode_probability) < EXACT


@pytest.mark.parametrize("scalar", SCALARS)
@pytest.mark.parametrize("which", ALL)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_measurement_too_far_for_any_density_is_refused_and_changes_nothing(sign, which, scalar):
    found = fkgen.build(scalar_plant(which, scalar))
    for y in (0.3, -0.2, 0.5):
        found.step(y)
    before = found.snapshot()
    for y in (1e200, 1e300) if scalar == "double" else (1e18, 1e38):
        with pytest.raises(StepRefused) as caught:
            found.step(sign * y)
        assert caught.value.name == "PLANT_RESULT_NOT_FINITE"
        assert caught.value.status == -5
        assert found.snapshot() == before
    assert found.step(0.1).status == 0


@pytest.mark.parametrize("scalar", SCALARS)
@pytest.mark.parametrize("which", ALL)
def test_at_every_distance_a_sample_is_used_or_refused_but_never_spoils_the_filter(which, scalar):
    found = fkgen.build(scalar_plant(which, scalar))
    found.step(0.1)
    start = found.snapshot()
    top = np.log10(np.finfo(found._dtype).max)
    for exponent in np.linspace(0.0, top - 0.01, 120):
        found.reset()
        found.step(0.1)
        try:
            now = found.step(10.0**exponent)
        except StepRefused:
            assert found.snapshot() == start
            assert 10.0**exponent > FAR[scalar]
            continue
        for port in now.ports:
            assert np.isfinite(now[port]).all(), (port, exponent)
        assert now.mode_probability.sum() == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("scalar", SCALARS)
@pytest.mark.parametrize("which", MATCHED)
def test_zeros_of_the_law_stay_zeros_whatever_is_measured(which, scalar):
    spec = scalar_plant(which, scalar, chain(HOLES, [1.0, 0.0, 0.0, 0.0]))
    y = np.array([0.1, 30.0, np.nan, -1e5, 0.2, 1e8, 0.0, np.nan, 0.4, -50.0])[:, None]
    result = run(spec, y)
    assert (result.status >= 0).all()
    reached = np.array([1.0, 0.0, 0.0, 0.0]) > 0.0
    for k in range(len(y)):
        assert not result.mode_probability[k][~reached].any()
        reached = reached @ (np.array(HOLES) > 0.0)
        assert not result.predicted_mode_probability[k][~reached].any()
        for port in ("filtered_state", "predicted_covariance"):
            assert np.isfinite(result[port][k]).all()


@pytest.mark.parametrize("which", MATCHED)
def test_a_mode_that_is_almost_impossible_comes_back_when_it_is_seen(which):
    # delta = C for ever, once it comes; nothing but 1e-300 speaks for it at first.
    kernel = [[1.0, 1e-300, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [1.0, 0, 0, 0], [0, 1.0, 0, 0]]
    spec = scalar_plant(which, law=chain(kernel, [1.0, 0.0, 0.0, 0.0]))
    rng = np.random.default_rng(2)
    y = np.vstack([rng.standard_normal((30, 1)), 8.0 * rng.standard_normal((150, 1))])
    mu = run(spec, y).mode_probability
    assert 0.0 < mu[29, 1] < 1e-200
    assert mu[-1, 1] > 0.999
    # Exponents of some hundreds keep 13 digits.
    assert distance(mu, textbook(spec, y, None).mode_probability) < EXACT


@pytest.mark.parametrize("which", ALL)
def test_an_outlier_is_taken_for_noise_and_moves_the_state_less_than_a_filter_without_faults(which):
    spec = scalar_plant(which)
    y = np.zeros((30, 1))
    y[20] = 12.0
    result = run(spec, y)
    assert result.mode_probability[20, 0] < 1e-6
    healthy = fkgen.Spec.from_dict(
        {"name": "plant", "model": {**SCALAR, "P0": [[1.0]]}, "filter": {"family": "kf"}}
    )
    moved, without = (abs(run(each, y).filtered_state[20, 0]) for each in (spec, healthy))
    assert moved < 0.5 * without
    # And it is forgotten: the plant's own memory is 0.8 per sample.
    assert abs(result.filtered_state[-1, 0]) < 0.1 * moved


@pytest.mark.parametrize("which", MATCHED)
def test_silence_is_taken_for_a_lost_signal(which):
    law = product([[0.98, 0.02], [0.02, 0.98]], [[0.9, 0.1]] * 2, initial=(0.5, 0.9))
    slow = {**SCALAR, "A": [[0.99]], "x0": [40.0], "P0": [[1.0]]}
    spec = sensed(slow, law, **SWITCHING[which])
    y = 40.0 * 0.99 ** np.arange(30.0)
    y[15:] = 0.0
    mu = run(spec, y).mode_probability
    assert mu[14, :2].sum() > 0.999
    assert (mu[15:20, 2:].sum(axis=1) > 0.999).all()
    # The estimate goes on as the plant does.
    assert final(spec, y[:20], "filtered_state")[0] == pytest.approx(40 * 0.99**19, rel=0.01)


@pytest.mark.parametrize("which", ALL)
def test_float_is_double_to_its_digits(which):
    single, double = (scalar_plant(which, scalar) for scalar in ("float", "double"))
    y, u, _ = seen(double, 300, missing=0.1)
    a, b = run(single, y, u), run(double, y, u)
    # Roundings of 6e-8 of exponents of some ten, forgotten within tens of samples.
    for port in ("filtered_state", "filtered_covariance", "mode_probability", "predicted_state"):
        np.testing.assert_allclose(a[port], b[port], rtol=0.0, atol=1e-4)
