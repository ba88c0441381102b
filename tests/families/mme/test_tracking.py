"""How fast the floor lets the compiled bank follow a success rate that changes."""

from __future__ import annotations

import numpy as np
import pytest
from plants import RATES, SENSED, built, motor

RUNS, AT, AFTER = 500, 500, 300

#: By independent code: median and 90 % delay to the new rate, per floor, and the mean weight
#: of the right hypothesis in the long run. Gaussian likelihood, no noise but the faults.
DELAYS = {
    (0.9, 0.3): {1e-12: (14, 32), 1e-6: (8, 27), 1e-4: (6, 25), 1e-3: (6, 20)},
    (0.3, 0.9): {1e-12: (26, 36), 1e-6: (12, 20), 1e-4: (8, 14), 1e-3: (4, 11)},
}
LONG_RUN = {1e-6: 0.994, 1e-4: 0.955, 1e-3: 0.83}


def records(before, after):
    """Measurements (RUNS, T, 2) of the motor whose rate changes after AT samples, and inputs."""
    A, B, C, D = (np.array(SENSED[letter]) for letter in "ABCD")
    rng = np.random.default_rng(3)
    T = AT + AFTER
    x, y = np.zeros((RUNS, 2)), np.empty((RUNS, T, 2))
    for k in range(T):
        works = (rng.random((RUNS, 1)) < (before if k < AT else after)).astype(float)
        y[:, k] = x @ C.T + works @ D.T
        x = x @ A.T + works @ B.T
    return y, np.ones((T, 1))


def weights(y, u, **options):
    plant = motor("mme", **options)
    return built(plant).run_batch(y, u, keep=("mode_probability",)).mode_probability


@pytest.mark.exhaustive
@pytest.mark.parametrize("change", list(DELAYS), ids=["down", "up"])
def test_the_floor_finds_a_new_rate_within_the_delays_of_the_table(change):
    y, u = records(*change)
    right = RATES.index(change[1])
    for floor, (median, late) in DELAYS[change].items():
        found = weights(y, u, weight_floor=floor, likelihood="gaussian")[:, AT:].argmax(axis=2)
        assert (found == right).any(axis=1).all()
        delays = (found == right).argmax(axis=1)
        # Standard errors from 500 runs are 0.5 and 1.5; the table's own are as large.
        assert abs(np.median(delays) - median) <= 2.0
        assert abs(np.quantile(delays, 0.9) - late) <= 5.0


def test_a_larger_floor_costs_weight_in_the_long_run():
    y, u = records(0.9, 0.3)
    for floor, expected in LONG_RUN.items():
        found = weights(y, u, weight_floor=floor, likelihood="gaussian")
        # Runs repeat within a few thousandths.
        assert found[:, AT + 150 :, RATES.index(0.3)].mean() == pytest.approx(expected, abs=0.01)


def test_without_a_floor_the_new_rate_is_not_found():
    y, u = records(0.9, 0.3)
    found = weights(y, u, weight_floor=0.0, likelihood="gaussian")
    assert (found[:, -1].argmax(axis=1) != RATES.index(0.3)).all()


def test_the_default_mixture_with_the_default_floor_tracks_as_well():
    y, u = records(0.9, 0.3)
    found = weights(y, u)[:, AT:].argmax(axis=2) == RATES.index(0.3)
    assert found.any(axis=1).all()
    # Twelve samples: half as fast as the over-confident Gaussian.
    assert np.median(found.argmax(axis=1)) <= 16.0
