"""What the filter of jumping plants becomes: a Kalman filter, open loop, fewer modes."""

from __future__ import annotations

import numpy as np
import pytest
from jump_plants import (
    EXAMPLE_A,
    EXAMPLE_B,
    GILBERT,
    believed,
    changed,
    filtered,
    random_table,
    record_of,
    spec_of,
    textbook_of,
)
from plants import distance, interpreted, run, spec

from fkgen.oracle.exact.paths import enumerate_paths

MOMENTS = (
    *("filtered_state", "filtered_covariance", "predicted_state", "predicted_covariance"),
    *("innovation", "innovation_covariance", "nis", "log_likelihood", "mode_law"),
)

#: Sums of some thousand products of numbers of order one to a hundred.
EXACT = 1e-10


def assert_same(found, expected, ports, tolerance=EXACT):
    errors = {name: distance(found[name], getattr(expected, name)) for name in ports}
    assert {name: e for name, e in errors.items() if not e <= tolerance} == {}


def kalman(plant, mode=0):
    """The Kalman filter of one mode as the whole plant."""
    model = plant["model"] | plant["faults"]["jump"]["modes"][mode]
    model.pop("c", None)
    return spec(model)


def one_plant(plant):
    """All modes alike."""
    same = plant["faults"]["jump"]["modes"][0]
    return changed(plant, modes=[same] * len(plant["faults"]["jump"]["modes"]))


KALMAN = (*MOMENTS[:-1],)


@pytest.mark.parametrize("plant", [random_table(9, 1, 3, 2), one_plant(random_table(10, 3, 3, 2))])
def test_one_mode_or_modes_alike_are_the_kalman_filter(plant):
    filtering = spec_of(plant)
    y, u = record_of(filtering, 60, missing=0.2)
    found, expected = interpreted(filtering, y, u), interpreted(kalman(plant), y, u)
    assert max(distance(found[name], expected[name]) for name in KALMAN) < EXACT


@pytest.mark.exhaustive
def test_undamped_modes_alike_are_the_kalman_filter_after_8000_samples():
    """Their second moments are 1e12 by then; the sum of the parts would have lost four digits."""
    plant = one_plant(changed(EXAMPLE_A, modes=[{"A": [[1, 1, 0.5], [0, 1, 1], [0, 0, 1]]}] * 3))
    filtering = spec_of(plant)
    y, _ = record_of(filtering, 8000)
    found, expected = run(filtering, y), run(kalman(plant), y)
    assert found.mode_second_moment[-1].max() > 1e11
    ports = (*MOMENTS[:4], "innovation_covariance")
    assert max(distance(found[name], expected[name]) for name in ports) < 1e-9
    rounding = 1e2 * np.finfo(float).eps * np.abs(y).max()  # y itself is known no better
    np.testing.assert_allclose(found.innovation, expected.innovation, rtol=0, atol=rounding)


def test_nothing_measured_leaves_the_unconditional_moments():
    y = np.full((40, 1), np.nan)
    found = filtered(EXAMPLE_B, y)
    x, spread = moments_by_recursion(EXAMPLE_B, 40)
    assert distance(found["filtered_state"], x) < EXACT
    assert distance(found["filtered_covariance"], spread) < EXACT


def moments_by_recursion(plant, T):
    """Mean and covariance of x from moments given the mode, by total expectation."""
    jump, model = plant["faults"]["jump"], plant["model"]
    P, law = np.array(jump["transition"]), np.array(jump["initial"])
    n = len(model["x0"])
    mean = np.tile(model["x0"], (len(law), 1))
    cov = np.tile(model["P0"], (len(law), 1, 1))
    states, covariances = [], []
    for _ in range(T):
        x = law @ mean
        states.append(x)
        d = mean - x
        covariances.append(np.einsum("i,iab->ab", law, cov + d[:, :, None] * d[:, None, :]))
        moved = np.array([np.array(m["A"]) @ mean[i] + m["c"] for i, m in enumerate(jump["modes"])])
        spread = np.array(
            [
                np.array(m["A"]) @ cov[i] @ np.array(m["A"]).T + m["Q"]
                for i, m in enumerate(jump["modes"])
            ]
        )
        later = law @ P
        mixing = law[:, None] * P / later
        mean = mixing.T @ moved
        d = moved[:, None, :] - mean[None, :, :]
        cov = np.einsum("ij,iab->jab", mixing, spread) + np.einsum("ij,ija,ijb->jab", mixing, d, d)
        law = later
    return np.array(states), np.array(covariances).reshape(T, n, n)


@pytest.mark.parametrize(
    "options", [{"arrival_rate": 0.0}, {"arrival_rate": 0.0, "detector": "llr"}]
)
def test_a_rate_of_zero_never_corrects(options):
    y, _ = record_of(spec_of(EXAMPLE_A), 30)
    found, blind = filtered(EXAMPLE_A, y, **options), filtered(EXAMPLE_A, np.full((30, 1), np.nan))
    for name in ("filtered_state", "filtered_covariance", "predicted_covariance"):
        assert distance(found[name], blind[name]) < EXACT
    if "detector" in options:
        assert found["fault_declared"].all()
        assert np.isfinite(found["test_statistic"]).all()


@pytest.mark.parametrize(
    "options", [{"arrival_rate": 1.0}, {"arrival_rate": 1.0, "detector": "llr"}]
)
def test_a_rate_of_one_trusts_every_sample(options):
    y, _ = record_of(spec_of(EXAMPLE_A), 30, missing=0.2)
    y[7] = 1e4
    found, trusting = filtered(EXAMPLE_A, y, **options), filtered(EXAMPLE_A, y)
    for name in MOMENTS:
        assert distance(found[name], trusting[name]) == 0.0
    if "detector" in options:
        assert not found["fault_declared"].any()
        assert np.isfinite(found["test_statistic"]).all()


def test_an_unknown_rate_is_a_chain_without_memory():
    y, _ = record_of(spec_of(EXAMPLE_B, arrival_rate=0.7), 40)
    rate = filtered(EXAMPLE_B, y, arrival_rate=0.7)
    chain = filtered(EXAMPLE_B, y, arrival_chain=[[0.3, 0.7], [0.3, 0.7]])
    assert max(distance(rate[name], chain[name]) for name in MOMENTS) < 1e-9


def test_a_chain_of_arrivals_is_a_chain_of_modes_without_signal():
    modes = EXAMPLE_A["faults"]["jump"]["modes"]
    P, law = (np.array(EXAMPLE_A["faults"]["jump"][key]) for key in ("transition", "initial"))
    double = changed(EXAMPLE_A)
    double["faults"]["jump"] = {
        "transition": np.kron(GILBERT, P).tolist(),
        "initial": np.kron([1 / 7, 6 / 7], law).tolist(),
        "modes": [mode | {"C": [[0, 0, 0]]} for mode in modes] + modes,
    }
    y, _ = record_of(spec_of(EXAMPLE_A, arrival_chain=GILBERT), 40)
    found, expected = filtered(EXAMPLE_A, y, arrival_chain=GILBERT), filtered(double, y)
    assert max(distance(found[name], expected[name]) for name in KALMAN) < 1e-9


def test_offsets_of_zero_change_nothing():
    y, _ = record_of(spec_of(EXAMPLE_A), 40)
    still = changed(EXAMPLE_A, model={"B": [[0], [0], [0]]})
    found, expected = filtered(still, y, np.ones((40, 1))), filtered(EXAMPLE_A, y)
    assert max(distance(found[name], expected[name]) for name in MOMENTS) < EXACT


def test_an_offset_is_an_input_of_one():
    drift = [mode["c"] for mode in EXAMPLE_B["faults"]["jump"]["modes"]]
    driven = changed(
        EXAMPLE_A,
        model={"B": [[0], [0], [0]]},
        modes=[{"B": [[each] for each in c], "c": [0, 0, 0]} for c in drift],
    )
    y, _ = record_of(spec_of(EXAMPLE_B), 40)
    found, expected = filtered(driven, y, np.ones((40, 1))), filtered(EXAMPLE_B, y)
    assert max(distance(found[name], expected[name]) for name in MOMENTS) < EXACT


def test_a_sensor_twice_is_a_sensor_of_half_the_variance_or_none_at_all():
    """Rows that repeat each other without own noise: S is singular, one of them is enough."""
    y, _ = record_of(spec_of(EXAMPLE_A), 40, missing=0.2)
    twice = changed(
        EXAMPLE_A,
        model={"C": [[1, 0, 0], [1, 0, 0]], "R": [[1, 1], [1, 1]]},
        modes=[{"R": np.full((2, 2), mode["R"][0][0]).tolist()} for mode in modes_of(EXAMPLE_A)],
    )
    found, expected = filtered(twice, np.hstack([y, y])), filtered(EXAMPLE_A, y)
    for name in MOMENTS[:4]:
        assert distance(found[name], expected[name]) < 1e-9
    assert distance(found["nis"], expected["nis"]) < 1e-9


def modes_of(plant):
    return plant["faults"]["jump"]["modes"]


def test_a_sensor_without_noise_shows_the_position():
    exact = changed(EXAMPLE_A, modes=[{"R": [[0.0]]}] * 3, model={"R": [[0.0]]})
    y, _ = record_of(spec_of(exact), 40)
    found = filtered(exact, y)
    np.testing.assert_allclose(found["filtered_state"][:, 0], y[:, 0], rtol=1e-12)
    assert np.abs(found["filtered_covariance"][:, 0, 0]).max() < 1e-9


@pytest.mark.parametrize("initial", [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
def test_modes_of_probability_zero_do_no_harm(initial):
    P = [[0.5, 0.5, 0.0], [0.3, 0.7, 0.0], [0.1, 0.2, 0.7]]  # the last is never entered
    filtering = spec_of(EXAMPLE_B, transition=P, initial=initial)
    y, u = record_of(filtering, 5)
    found = interpreted(filtering, y, u)
    assert_same(found, enumerate_paths(believed(filtering, 5), y, u), MOMENTS)
    if initial[2] == 0.0:
        assert not found["mode_law"][:, 2].any()


def test_covariances_stay_symmetric_and_positive():
    y, _ = record_of(spec_of(EXAMPLE_B, arrival_rate=0.8), 100, missing=0.1)
    found = filtered(EXAMPLE_B, y, arrival_rate=0.8)
    for name in ("augmented_covariance", "filtered_covariance", "predicted_covariance"):
        P = found[name]
        assert np.array_equal(P, P.transpose(0, 2, 1))
        deviation = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
        correlation = P / deviation[:, :, None] / deviation[:, None, :]
        assert np.linalg.eigvalsh(correlation).min() > -1e-9


#: Position, velocity and a damped acceleration, driven and with offsets; manoeuvres come and go.
TRACK = {
    "name": "track",
    "model": {
        "A": [[1.0, 0.1, 0.005], [0.0, 1.0, 0.1], [0.0, 0.0, 0.9]],
        "B": [[0.0], [0.1], [0.4]],
        "C": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.3]],
        "D": [[0.5], [0.0]],
        "Q": np.diag([0.0, 1e-4, 1e-2]).tolist(),
        "R": [[0.4, 0.1], [0.1, 0.3]],
        "c": [0.1, 0.0, -0.2],
        "d": [0.0, 0.7],
        "x0": [1.0, -2.0, 0.0],
        "P0": np.diag([3.0, 1.0, 0.5]).tolist(),
    },
    "faults": {
        "jump": {
            "transition": [[0.9, 0.1], [0.3, 0.7]],
            "modes": [{}, {"Q": np.diag([0.01, 0.1, 1.0]).tolist(), "R": np.eye(2).tolist()}],
        }
    },
    "filter": {"family": "mjls_lmmse", "gain": "stationary"},
}
#: The chain above is in mode 1 a quarter of the time, whatever its start.
MEAN = {"Q": np.diag([0.0025, 0.025075, 0.2575]).tolist(), "R": [[0.55, 0.075], [0.075, 0.475]]}


@pytest.mark.parametrize("options", [{}, {"initial": [0.1, 0.9]}, {"arrival": "known"}], ids=str)
def test_modes_that_differ_in_noise_have_the_constant_gain_of_the_mean_noise(options):
    more = {"arrival_rate": 0.8} if "arrival" in options else {}
    filtering = spec_of(TRACK, **options, **more)
    y, u = record_of(filtering, 80, missing=0.2)
    found = interpreted(filtering, y, u)
    expected = interpreted(spec(TRACK["model"] | MEAN, gain="stationary"), y, u)
    assert max(distance(found[name], expected[name]) for name in KALMAN) < EXACT


@pytest.mark.parametrize("detector", ["llr", "nis"])
def test_a_constant_gain_of_integrators_restarts_from_the_mean_that_inputs_move(detector):
    options = {"detector": detector, "arrival_rate": 0.5, "lock_out": 2, "reinitialise": True}
    filtering = spec_of(TRACK, **options)
    y, u = record_of(filtering, 60, missing=0.1)
    expected, found = textbook_of(filtering, y, u), interpreted(filtering, y, u)
    assert (expected.consecutive_rejections == 2).sum() > 1
    assert_same(found, expected, KALMAN)
    np.testing.assert_array_equal(found["fault_declared"], expected.fault_declared)
