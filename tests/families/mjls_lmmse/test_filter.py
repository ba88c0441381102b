"""The filter of jumping plants against every path of modes and whole matrices."""

from __future__ import annotations

import numpy as np
import pytest
from jump_plants import (
    EXAMPLE_A,
    EXAMPLE_B,
    EXAMPLE_S,
    GILBERT,
    believed,
    random_table,
    record_of,
    spec_of,
    textbook_of,
)
from plants import distance, interpreted, run

from fkgen.oracle.claims.jump import loss_test
from fkgen.oracle.exact.paths import enumerate_paths

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
