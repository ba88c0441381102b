"""dfcf and compression_full against joint distributions, plain Kalman filters and the paper."""

from __future__ import annotations

import dataclasses

import mpmath as mp
import numpy as np
import pytest
from plants import built, distance, interpreted, random_model, system_of
from plants import spec as plain
from scipy.stats import chi2
from soft_plants import DELTA, PAPER, TIGHT, assert_ports, case, expected, soft, thinned

import fkgen
from fkgen.oracle import accepted_rows, batch_lmmse

SEEDS = range(100)


@pytest.mark.parametrize("seed", SEEDS)
def test_every_port_is_that_of_the_joint_distribution(seed):
    spec, y, u, params = case(seed, test=bool(seed % 3))
    assert_ports(interpreted(spec, y, u, params), expected(spec, y, u, params))


@pytest.mark.parametrize("seed", range(24))
def test_the_same_with_an_exactly_singular_transition(seed):
    spec, y, u, params = case(seed, singular=True)
    A = spec.model.A.values({name: float(value[0]) for name, value in params.items()})
    assert seed % 2 or np.linalg.matrix_rank(A) < len(A)
    assert_ports(interpreted(spec, y, u, params), expected(spec, y, u, params))


@pytest.mark.parametrize("seed", range(20))
def test_the_same_from_a_prior_without_variance_in_some_direction(seed):
    spec, y, u, params = case(seed)
    table = spec.to_dict()
    root = np.linalg.cholesky(np.array(table["model"]["P0"]))[:, 1:]
    table["model"]["P0"] = (root @ root.T).tolist()
    table["model"]["Q"] = (0.01 * np.ones_like(table["model"]["P0"], dtype=float)).tolist()
    spec = fkgen.Spec.from_dict(table)
    params = {name: value for name, value in params.items() if name in spec.defaults}
    assert_ports(interpreted(spec, y, u, params), expected(spec, y, u, params))


@pytest.mark.parametrize("seed", range(0, 80, 4))
def test_the_host_is_the_kalman_filter_of_all_that_it_accepted(seed):
    spec, y, u, params = case(seed)
    found = interpreted(spec, y, u, params)
    law = spec.faults.soft
    ends = list(range(law.window, len(y), law.window))
    rejected = np.asarray(found["fault_declared"])[ends].astype(bool)
    seen = accepted_rows(law, y, ends, ~rejected[:, None])
    overall = batch_lmmse(system_of(spec, len(y), params), seen, u)
    for name in ("filtered_state", "filtered_covariance", "predicted_state"):
        last = slice(ends[-1], None)
        assert distance(found[name][last], getattr(overall, name)[last]) < TIGHT


def accept_all(spec, y, u=None, params=None):
    table = spec.to_dict()
    table["filter"]["test"] = False
    return interpreted(fkgen.Spec.from_dict(table), y, u, params)


@pytest.mark.parametrize("seed", range(0, 30, 2))
def test_with_acceptance_the_host_is_the_kf_family_at_the_end_of_every_window(seed):
    spec, y, u, _ = case(seed)
    table = spec.to_dict()
    table["filter"], table["faults"] = {"family": "kf"}, {}
    kf = interpreted(fkgen.Spec.from_dict(table), y, u)
    found = accept_all(spec, y, u)
    ends = slice(spec.faults.soft.window, None, spec.faults.soft.window)
    for name in ("filtered_state", "filtered_covariance", "predicted_state"):
        assert distance(found[name][ends], kf[name][ends]) < 1e-9


@pytest.mark.parametrize("seed", range(0, 20, 2))
def test_without_test_the_statistic_is_the_same_until_something_would_be_rejected(seed):
    spec, y, u, _ = case(seed)
    tested, quiet = interpreted(spec, y, u), accept_all(spec, y, u)
    assert not np.any(quiet["fault_declared"])
    first = np.flatnonzero(np.append(tested["fault_declared"], 1.0))[0]
    for name in ("test_statistic", "test_dof"):
        np.testing.assert_array_equal(tested[name][: first + 1], quiet[name][: first + 1])


def test_a_window_of_one_sample_updates_the_host_at_every_sample_but_the_first():
    spec = soft(random_model(3, 3, 2), window=1, test=False)
    y = np.random.default_rng(3).standard_normal((12, 2))
    kf = interpreted(plain(random_model(3, 3, 2), family="kf"), y, np.zeros((12, 0)))
    found = interpreted(spec, y, np.zeros((12, 0)))
    assert distance(found["filtered_state"][1:], kf["filtered_state"][1:]) < TIGHT
    assert np.isnan(found["test_statistic"][0])
    assert np.all(found["test_dof"][1:] > 0)


def test_without_a_compressed_row_there_is_no_test_and_the_host_is_untouched():
    spec = soft(random_model(4, 3, 2), window=3)
    y = np.random.default_rng(4).standard_normal((10, 2))
    y[:, 1] = np.nan
    kf = interpreted(plain(random_model(4, 3, 2), family="kf"), y, np.zeros((10, 0)))
    found = interpreted(spec, y, np.zeros((10, 0)))
    assert np.isnan(found["test_statistic"]).all()
    assert not np.any(found["test_dof"])
    assert not np.any(found["fault_declared"])
    np.testing.assert_array_equal(found["filtered_state"], kf["filtered_state"])
    np.testing.assert_array_equal(found["compression_deviation"], 0.0)


def test_a_compression_filter_without_news_is_used_late_all_the_same():
    spec = soft(random_model(5, 3, 2), window=8, test=False)
    y = np.random.default_rng(5).standard_normal((9, 2))
    y[2:, 1] = np.nan
    y[8] = np.nan
    found = interpreted(spec, y, np.zeros((9, 0)))
    overall = batch_lmmse(system_of(spec, 9), y, None)
    assert found["test_dof"][8] == 2
    assert distance(found["filtered_state"][8], overall.filtered_state[8]) < TIGHT


def test_a_rejected_window_leaves_the_host_as_if_its_rows_had_never_been_measured():
    spec = soft(random_model(6, 3, 2), window=4)
    y = np.random.default_rng(6).standard_normal((14, 2))
    y[:5, 1] += 100.0
    found = interpreted(spec, y, np.zeros((14, 0)))
    assert found["fault_declared"][[4, 8, 12]].tolist() == [1.0, 0.0, 0.0]
    without = y.copy()
    without[:5, 1] = np.nan
    alone = interpreted(spec, without, np.zeros((14, 0)))
    assert_ports(found, {name: alone[name] for name in ("filtered_state", "predicted_covariance")})


def test_what_is_used_at_the_end_of_a_window_is_not_used_again_in_the_next():
    # The last row of a window counts once: from there on both hosts are the same.
    spec = soft(random_model(7, 2, 2), window=3, test=False)
    y = np.random.default_rng(7).standard_normal((7, 2))
    y[4:, 1] = np.nan
    found = interpreted(spec, y, np.zeros((7, 0)))
    overall = batch_lmmse(system_of(spec, 7), y, None)
    assert found["test_dof"].tolist() == [0, 0, 0, 2, 0, 0, 0]
    assert distance(found["filtered_covariance"][6], overall.filtered_covariance[6]) < TIGHT


def test_noise_free_rows_are_redundant_for_one_filter_and_news_for_the_other():
    model = random_model(8, 3, 3)
    model["C"][2] = model["C"][0]
    model["R"] = np.diag([0.0, 1.0, 0.0]).tolist()
    spec = soft(model, host=[2], window=3)
    y = np.random.default_rng(8).standard_normal((10, 3))
    y[:, 2] = y[:, 0]
    y[1, 2] = np.nan
    assert_ports(
        interpreted(spec, y, np.zeros((10, 0))),
        {k: v for k, v in expected(spec, y).items() if k != "log_likelihood"},
        1e-9,
    )


def test_thresholds_of_every_possible_dof_come_from_the_false_alarm_probability():
    for alarm in (0.05, 0.01):
        spec = soft(PAPER, window=150, false_alarm=alarm)
        text = fkgen.generate(fkgen.validate(spec)).files["plant.c"]
        for dof in (1, 2):
            assert f"threshold_0 = {chi2.isf(alarm, dof):.12}"[:24] in text
    assert "7.38" not in text


def test_the_state_of_a_filter_does_not_grow_with_the_window():
    sizes = [
        sum(port.size for port in built(soft(PAPER, window=w)).layout.ports) for w in (1, 100_000)
    ]
    assert sizes[0] == sizes[1]


@pytest.mark.parametrize("seed", range(0, 12, 2))
def test_compression_full_is_dfcf_where_it_is_given_rows_of_the_host(seed):
    spec, y, u, _ = case(seed)
    table = spec.to_dict()
    table["filter"]["family"] = "compression_full"
    full, pair = interpreted(fkgen.Spec.from_dict(table), y, u), interpreted(spec, y, u)
    for name, value in pair.items():
        np.testing.assert_array_equal(full[name], value)


@pytest.mark.parametrize("seed", range(20))
def test_the_host_of_compression_full_only_propagates_between_windows(seed):
    rng = np.random.default_rng(seed)
    n, p, window = int(rng.integers(1, 6)), int(rng.integers(1, 4)), int(rng.integers(2, 7))
    spec = soft(
        random_model(seed, n, p, correlated=True), family="compression_full", host=[], window=window
    )
    y = thinned(rng, 3 * window + 1, p, ())
    found = interpreted(spec, y, np.zeros((len(y), 0)))
    assert_ports(found, expected(spec, y))
    A, Q = spec.model.A.values(), spec.model.Q.values()
    P = A @ spec.model.P0.values() @ A.T + Q
    np.testing.assert_allclose(found["filtered_covariance"][1], P, rtol=1e-12, atol=1e-12)


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


def test_records_are_not_changed_and_options_are_told_apart():
    spec = soft(PAPER, window=150)
    options = dataclasses.replace(spec.filter.options, test=False)
    other = dataclasses.replace(spec, filter=dataclasses.replace(spec.filter, options=options))
    assert spec.canonical() != other.canonical()
