"""The filter of jumping plants against every path of modes, whole matrices, and older filters."""

from __future__ import annotations

import numpy as np
import pytest
from jump_plants import (
    EXAMPLE_A,
    EXAMPLE_B,
    EXAMPLE_S,
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

from fkgen.oracle import enumerate_paths
from fkgen.oracle.claims.jump import loss_test

MOMENTS = (
    *("filtered_state", "filtered_covariance", "predicted_state", "predicted_covariance"),
    *("innovation", "innovation_covariance", "nis", "log_likelihood", "mode_law"),
)
VERDICTS = ("fault_declared", "test_dof", "consecutive_rejections")
JUDGED = (*MOMENTS, "test_statistic", "test_threshold")

#: Sums of some thousand products of numbers of order one to a hundred.
EXACT = 1e-10

#: Unknown arrivals: the second moments of the state are noise, and the filter trusts little.
CHANNELS = {
    "always": {},
    "known": {"arrival": "known", "arrival_rate": 0.6},
    "unknown": {"arrival_rate": 0.7},
    "chain": {"arrival_chain": GILBERT},
    "rate 0": {"arrival_rate": 0.0},
    "rate 1": {"arrival_rate": 1.0},
}
PLANTS = {
    "two modes": random_table(1, 2, 2, 1),
    "three modes, two rows": random_table(2, 3, 2, 2),
    "correlated": random_table(3, 2, 3, 2, correlated=True),
    "offsets": random_table(4, 3, 2, 1, offsets=True),
    "inputs": random_table(5, 2, 2, 2, q=1, correlated=True),
    "inputs and offsets": random_table(6, 2, 1, 1, q=2, offsets=True),
    "one mode": random_table(7, 1, 2, 1, offsets=True),
    "A": EXAMPLE_A,
    "B": EXAMPLE_B,
    "S": EXAMPLE_S,
}
DETECTORS = {
    "llr": {"detector": "llr"},
    "nis": {"detector": "nis", "alpha": 0.3},
    "energy": {"detector": "energy"},
    "window": {"detector": "energy", "kappa": 0.7, "window": 3},
    "restart": {"detector": "nis", "alpha": 0.6, "lock_out": 2, "reinitialise": True},
    "window restarted": {
        "detector": "energy",
        "kappa": 0.3,
        "window": 2,
        "lock_out": 1,
        "reinitialise": True,
    },
}


def assert_same(found, expected, ports, tolerance=EXACT):
    errors = {name: distance(found[name], getattr(expected, name)) for name in ports}
    assert {name: e for name, e in errors.items() if not e <= tolerance} == {}


@pytest.mark.parametrize("channel", CHANNELS.values(), ids=CHANNELS)
@pytest.mark.parametrize("plant", PLANTS.values(), ids=PLANTS)
def test_estimates_are_projections_over_all_paths(plant, channel):
    filtering = spec_of(plant, **channel)
    T = 5 if len(plant["faults"]["jump"]["modes"]) > 2 else 6
    y, u = record_of(filtering, T, missing=0.2)
    expected = enumerate_paths(believed(filtering, T), y, u)
    assert_same(interpreted(filtering, y, u), expected, MOMENTS)


@pytest.mark.parametrize("detector", DETECTORS.values(), ids=DETECTORS)
@pytest.mark.parametrize("plant", PLANTS.values(), ids=PLANTS)
def test_a_rejected_sample_is_as_good_as_a_missing_one(plant, detector):
    filtering = spec_of(plant, arrival_rate=0.6, **detector)
    T = 5 if len(plant["faults"]["jump"]["modes"]) > 2 else 6
    y, u = record_of(filtering, T, missing=0.15)
    expected = enumerate_paths(believed(filtering, T), y, u, loss_test(filtering))
    found = interpreted(filtering, y, u)
    assert_same(found, expected, JUDGED)
    for name in VERDICTS:
        np.testing.assert_array_equal(found[name], getattr(expected, name))


LONG = {
    "A": (EXAMPLE_A, {}),
    "A unknown": (EXAMPLE_A, {"arrival_rate": 0.85}),
    "A chain": (EXAMPLE_A, {"arrival_chain": GILBERT}),
    "B known": (EXAMPLE_B, {"arrival": "known", "arrival_rate": 0.85}),
    "B llr": (EXAMPLE_B, {"arrival_rate": 0.85, "detector": "llr"}),
    "A nis": (EXAMPLE_A, {"arrival_rate": 0.85, "detector": "nis"}),
    "A energy": (EXAMPLE_A, {"arrival_rate": 0.85, "detector": "energy", "window": 5}),
    "S llr": (EXAMPLE_S, {"arrival_rate": 0.85, "detector": "llr"}),
    "A stationary": (EXAMPLE_A, {"gain": "stationary"}),
    "B stationary": (EXAMPLE_B, {"arrival_rate": 0.85, "gain": "stationary"}),
    "A chain stationary": (EXAMPLE_A, {"arrival_chain": GILBERT, "gain": "stationary"}),
    "A llr stationary": (
        EXAMPLE_A,
        {"arrival_rate": 0.85, "detector": "llr", "gain": "stationary"},
    ),
    "S restart stationary": (
        EXAMPLE_S,
        {
            "arrival_rate": 0.5,
            "detector": "nis",
            "alpha": 0.5,
            "gain": "stationary",
            "lock_out": 2,
            "reinitialise": True,
        },
    ),
}


@pytest.mark.parametrize("case", LONG.values(), ids=LONG)
def test_decisions_and_estimates_are_those_of_whole_matrices(case):
    plant, options = case
    filtering = spec_of(plant, **options)
    y, u = record_of(filtering, 100, missing=0.05)
    expected, found = textbook_of(filtering, y, u), interpreted(filtering, y, u)
    tested = filtering.filter.options.detector != "none"
    # The whole matrices form V as a difference: second moments of 1e3 beside noise of 1.
    assert_same(found, expected, JUDGED if tested else MOMENTS, 1e-9)
    for name in VERDICTS if tested else ():
        np.testing.assert_array_equal(found[name], getattr(expected, name))


@pytest.mark.parametrize("gain", ["time_varying", "stationary"])
def test_compiled_code_says_with_its_status_what_it_decided(gain):
    filtering = spec_of(EXAMPLE_S, arrival_rate=0.3, detector="llr", lock_out=4, gain=gain)
    y, u = record_of(filtering, 300, missing=0.05)
    expected, found = textbook_of(filtering, y, u), run(filtering, y)
    assert_same(found, expected, JUDGED, 1e-9)
    for name in VERDICTS:
        np.testing.assert_array_equal(found[name], getattr(expected, name))
    present = np.isfinite(y).any(axis=1)
    verdict = np.where(found.fault_declared > 0, 2, 0)
    status = np.where(found.consecutive_rejections >= 4, 3, verdict)
    np.testing.assert_array_equal(found.status, np.where(present, status, 1))
    assert set(found.status.tolist()) == {0, 1, 2, 3}


def test_parameters_move_every_matrix_of_a_mode():
    modes = [
        {"A": [["0.9*a", 0.1], [0.0, "a"]], "c": ["b", 0.0], "R": [["0.3 + b**2", 0], [0, 1]]},
        {"A": [["0.7*a", "b"], [0.1, 0.5]], "Q": [["1 + a", 0], [0, 0.2]], "C": [["a", 0], [0, 1]]},
    ]
    plant = random_table(8, 2, 2, 2)
    filtering = spec_of(plant, modes=modes, parameters={"a": 0.9, "b": 0.2}, arrival_rate=0.7)
    rng = np.random.default_rng(3)
    params = {"a": rng.uniform(0.5, 1.1, 6), "b": rng.uniform(-1, 1, 6)}
    y, u = record_of(filtering, 6, missing=0.2, params=params)
    expected = enumerate_paths(believed(filtering, 6, params), y, u)
    assert_same(interpreted(filtering, y, u, params), expected, MOMENTS)


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
