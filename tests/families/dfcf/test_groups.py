"""Groups: the faulty one is isolated, the others are taken over. And the way out of a lock-out."""

from __future__ import annotations

import numpy as np
import pytest
from plants import built, distance, interpreted, random_model, system_of
from soft_plants import PAPER, assert_ports, expected, soft, thinned

from fkgen.oracle.exact.batch import batch_lmmse
from fkgen.oracle.exact.compression import accepted_rows

GROUPS = [[1, 3], [2]]


def grouped(seed, groups=GROUPS, **options):
    p = 1 + sum(len(group) for group in groups)
    return soft(random_model(seed, 3, p), host=[0], window=5, groups=groups, **options)


def record(seed, p=4, T=17):
    return thinned(np.random.default_rng(seed), T, p, (0,))


@pytest.mark.parametrize("seed", range(20))
def test_every_port_is_that_of_the_joint_distribution(seed):
    spec, y = grouped(seed, test=bool(seed % 3)), record(seed)
    assert_ports(interpreted(spec, y, np.zeros((len(y), 0))), expected(spec, y))


@pytest.mark.parametrize("faulty", [0, 1])
def test_the_faulty_group_is_rejected_and_the_host_is_the_filter_of_all_other_rows(faulty):
    spec, y = grouped(3), record(3) * 0.3
    y[:6, list(GROUPS[faulty])] += 60.0
    found = interpreted(spec, y, np.zeros((len(y), 0)))
    verdicts = [float(g == faulty) for g in range(2)]
    assert found["fault_declared"][5].tolist() == verdicts
    assert found["fault_declared"][10].tolist() == [0.0, 0.0]
    accepted = np.array([[not v for v in verdicts], [True, True], [True, True]])
    seen = accepted_rows(spec.faults.soft, y, [5, 10, 15], accepted)
    overall = batch_lmmse(system_of(spec, len(y)), seen, None)
    for name in ("filtered_state", "filtered_covariance"):
        assert distance(found[name][15:], getattr(overall, name)[15:]) < 1e-11


def test_no_order_of_the_groups_matters():
    y = record(4)
    one = interpreted(grouped(4, [[1, 3], [2]]), y, np.zeros((len(y), 0)))
    other = interpreted(grouped(4, [[2], [1, 3]]), y, np.zeros((len(y), 0)))
    assert distance(one["filtered_state"], other["filtered_state"]) < 1e-12
    np.testing.assert_array_equal(one["fault_declared"], other["fault_declared"][:, ::-1])


def test_three_groups_have_a_filter_for_every_set_of_them():
    spec, y = grouped(5, [[1], [2], [3]]), record(5)
    found = interpreted(spec, y, np.zeros((len(y), 0)))
    assert found["compression_deviation"].shape == (len(y), 7, 3)
    assert_ports(found, expected(spec, y))


def test_a_group_without_measurement_neither_passes_nor_fails():
    spec, y = grouped(6), record(6)
    y[:, 2] = np.nan
    found = interpreted(spec, y, np.zeros((len(y), 0)))
    assert np.isnan(found["test_statistic"][:, 1]).all()
    assert not np.any(found["test_dof"][:, 1])
    assert not np.any(found["fault_declared"][:, 1])
    assert_ports(found, expected(spec, y))


@pytest.mark.parametrize("groups", [None, GROUPS])
@pytest.mark.parametrize("seed", range(6))
def test_reacquisition_is_that_of_the_joint_distribution(seed, groups):
    options = {} if groups is None else {"groups": groups}
    model = random_model(seed, 3, 4)
    spec = soft(model, host=[0], window=3, reacquire=2, false_alarm=0.3, **options)
    y = record(seed, T=31)
    y[:, 1:] += 8.0
    found = interpreted(spec, y, np.zeros((len(y), 0)))
    assert np.any(found["fault_declared"])
    assert_ports(found, expected(spec, y))


def locked(seed, **options):
    """The paper's plant without fault, the host 12 standard deviations off: all is rejected."""
    rng = np.random.default_rng(seed)
    y = np.full((1351, 2), np.nan)
    y[:, 0] = 0.1 * rng.standard_normal(1351)
    y[::5, 1] = 12.0 + 10.0 * rng.standard_normal(271)
    return built(soft(PAPER, window=150, **options)).run(y)


def test_a_host_that_is_off_stays_off_and_comes_back_where_it_may_reacquire():
    for seed in range(5):
        stuck, back = locked(seed), locked(seed, reacquire=3)
        assert stuck.fault_declared[150::150].all()
        assert abs(stuck.filtered_state[-1, 0] - 12.0) > 5.0
        declared = back.fault_declared[150::150]
        assert declared[:3].all()
        assert not declared[-2:].any()
        assert back.rejections[[150, 300, 450]].tolist() == [1.0, 2.0, 3.0]
        assert back.rejections[-1] == 0.0
        assert abs(back.filtered_state[-1, 0] - 12.0) < 4.0


def test_rejections_are_counted_only_while_nothing_passes():
    spec, y = grouped(3, reacquire=2), record(3, T=36) * 0.3
    y[:, 2] += 60.0
    found = interpreted(spec, y, np.zeros((len(y), 0)))
    assert found["fault_declared"][5::5, 1].all()
    assert not np.any(found["rejections"])
    assert_ports(found, expected(spec, y))
