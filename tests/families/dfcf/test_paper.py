"""dfcf on the plant of Lee & Lee, section 6: variances, statistics, false alarms."""

from __future__ import annotations

import mpmath as mp
import numpy as np
import pytest
from plants import built
from scipy.stats import chi2
from soft_plants import DELTA, PAPER, soft


def paper_record(T, shift=0.0):
    """Measurements of the paper's schedule without noise: position every fifth sample."""
    y = np.zeros((T, 2))
    k = np.arange(T)
    y[:, 1] = np.where(k % 5 == 0, shift, np.nan)
    return y


#: Section 6 of the paper, evaluated exactly: [m^2].
ACCEPTED = {300: 0.469836809501, 600: 0.447696469109, 690: 0.446821047466}


def test_the_papers_variances_without_test_to_twelve_digits():
    spec = soft(PAPER, window=150, test=False)
    P = built(spec).run(paper_record(3451)).filtered_covariance[:, 0, 0]
    for seconds, value in ACCEPTED.items():
        assert P[seconds * 5] == pytest.approx(value, abs=6e-13)
    assert P[150] == pytest.approx(0.809845780207, abs=6e-13)


def in_fifty_digits(y):
    """Statistic of the paper's plant at the end of the first window, by mpmath."""
    with mp.workdps(50):
        F, Q, P = (mp.matrix(PAPER[letter]) for letter in ("A", "Q", "P0"))
        x, other = mp.matrix([0, 0]), None
        for k, row in enumerate(y):
            if k:
                x, P = F * x, F * P * F.T + Q
                other = (F * other[0], F * other[1] * F.T + Q)
            if other is not None:
                other = corrected(other, 1, row[0], "0.01")
            x, P = corrected((x, P), 1, row[0], "0.01")
            if np.isfinite(row[1]):
                other = corrected((x, P) if other is None else other, 0, row[1], "100")
        d = other[0] - x
        return float((d.T * mp.lu_solve(P - other[1], d))[0])


def corrected(estimate, component, measured, r):
    x, P = estimate
    K = P[:, component] / (P[component, component] + mp.mpf(r))
    return x + K * (mp.mpf(float(measured)) - x[component]), P - K * P[component, :]


def test_the_papers_statistic_has_ten_digits_though_position_hardly_tells_of_speed():
    rng = np.random.default_rng(0)
    y = np.stack([0.1 * rng.standard_normal(151), 10.0 * rng.standard_normal(151)], axis=1)
    y[np.arange(151) % 5 != 0, 1] = np.nan
    found = built(soft(PAPER, window=150)).run(y).test_statistic[150]
    assert found == pytest.approx(in_fifty_digits(y), rel=1e-10)


def test_the_papers_variance_where_everything_is_rejected_after_700_seconds():
    y = paper_record(4951)
    late = np.arange(4951) > 3500
    y[late, 1] += 1e6
    run = built(soft(PAPER, window=150)).run(y)
    assert run.fault_declared[3600::150].all()
    assert run.filtered_covariance[4950, 0, 0] == pytest.approx(1.046820144940, abs=1e-11)


def test_the_papers_non_centralities_of_a_ramp():
    # Without noise the statistic is the non-centrality itself, if nothing faulty was accepted.
    y = paper_record(4051)
    k = np.arange(4051)
    ramp = np.where(k > 3500, 0.1 * (k - 3500) / 5, 0.0)
    y[:, 1] += ramp
    run = built(soft(PAPER, window=150, test=False)).run(y)
    accepted = run.test_statistic[[3600, 3750, 3900, 4050]]
    np.testing.assert_allclose(accepted, [0.154067, 3.218911, 9.637739, 18.075169], rtol=5e-6)
    assert run.test_dof[3600] == 2
    power = 1 - chi2.cdf(chi2.isf(0.05, 2), 2)
    assert power == pytest.approx(0.05)


def test_without_fault_the_statistic_is_chi_square_and_false_alarms_are_as_asked():
    spec = soft(PAPER, window=150, test=False)
    M, T = 300, 1501
    rng = np.random.default_rng(2024)
    a = rng.normal(0.0, 5.0, (M, T))
    speed = rng.normal(0.0, 0.1, M)[:, None] + np.cumsum(DELTA * a, axis=1) - DELTA * a
    step = DELTA * speed + DELTA**2 / 2 * a
    position = rng.normal(0.0, 1.0, M)[:, None] + np.cumsum(step, axis=1) - step
    y = np.stack([speed + rng.normal(0, 0.1, (M, T)), position + rng.normal(0, 10, (M, T))], -1)
    y[:, np.arange(T) % 5 != 0, 1] = np.nan
    run = built(spec).run_batch(y, keep=["test_statistic", "filtered_state"])
    statistic = run.test_statistic[:, 150::150]
    count = statistic.size
    assert abs(statistic.mean() - 2.0) < 4 * 2.0 / np.sqrt(count)
    alarms = (statistic > chi2.isf(0.05, 2)).mean()
    assert abs(alarms - 0.05) < 4 * np.sqrt(0.05 * 0.95 / count)
    error = run.filtered_state[:, 1500, 0] - position[:, 1500]
    rms = np.sqrt(ACCEPTED[300])
    assert abs(np.sqrt(np.mean(error**2)) / rms - 1.0) < 4 / np.sqrt(2 * M)
