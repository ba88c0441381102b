"""dfcf and compression_full against joint distributions and plain Kalman filters."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from plants import built, distance, interpreted, random_model, system_of
from plants import spec as plain
from scipy.stats import chi2
from soft_plants import PAPER, TIGHT, assert_ports, case, expected, soft, thinned
from toolchain import thorough

import fkgen
from fkgen.oracle.exact.batch import batch_lmmse
from fkgen.oracle.exact.compression import accepted_rows

#: Each is a plant of its own, with windows, hosts and gaps of its own.
SEEDS = range(100)


@pytest.mark.parametrize("seed", thorough(SEEDS, SEEDS[:30]))
def test_every_port_is_that_of_the_joint_distribution(seed):
    spec, y, u, params = case(seed, test=bool(seed % 3))
    assert_ports(interpreted(spec, y, u, params), expected(spec, y, u, params))


@pytest.mark.parametrize("seed", range(8))
def test_the_same_with_an_exactly_singular_transition(seed):
    spec, y, u, params = case(seed, singular=True)
    A = spec.model.A.values({name: float(value[0]) for name, value in params.items()})
    assert seed % 2 or np.linalg.matrix_rank(A) < len(A)
    assert_ports(interpreted(spec, y, u, params), expected(spec, y, u, params))


@pytest.mark.parametrize("seed", range(8))
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


def test_records_are_not_changed_and_options_are_told_apart():
    spec = soft(PAPER, window=150)
    options = dataclasses.replace(spec.filter.options, test=False)
    other = dataclasses.replace(spec, filter=dataclasses.replace(spec.filter, options=options))
    assert spec.canonical() != other.canonical()
