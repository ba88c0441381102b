"""Laws of the sensor's modes: order of states, stationary laws, lumping, what is read and written.

Modes are (1,1) (1,C) (0,1) (0,C) as (gamma, delta); chains of gamma are ordered (0, 1).
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from fkgen.faults import SensorFaults
from fkgen.faults.chain import lump
from fkgen.problem import Spec
from fkgen.problem.probability import stationary_law, visited

PAIRS = ((1, 1), (1, 0), (0, 1), (0, 0))
"""(gamma, delta is nominal) of the four modes."""

LOST, NOISY = [[0.6, 0.4], [0.1, 0.9]], [[0.8, 0.2], [0.3, 0.7]]
ABSORBING = [[1.0, 0.0], [0.25, 0.75]]
ALTERNATING = [[0.0, 1.0], [1.0, 0.0]]
KERNEL = [[0.7, 0.1, 0.1, 0.1], [0.2, 0.6, 0.1, 0.1], [0.1, 0.1, 0.7, 0.1], [0.1, 0.2, 0.3, 0.4]]


def table(family: str = "imm", **faults: object) -> dict[str, Any]:
    one = [[1.0, 0.0], [0.0, 1.0]]
    return {
        "name": "s",
        "model": {"A": one, "C": one, "Q": one, "R": one, "x0": [0.0, 0.0], "P0": one},
        "faults": {"sensor": faults},
        "filter": {"family": family},
    }


def read(**faults: object) -> SensorFaults:
    result = Spec.from_dict(table(**{"noise_factor": 10.0, **faults})).faults.sensor
    assert result is not None
    return result


def chain(rng: np.random.Generator, n: int, zeros: float = 0.0) -> np.ndarray:
    P = rng.random((n, n)) * (rng.random((n, n)) >= zeros)
    P[np.arange(n), rng.integers(0, n, n)] += 0.1
    return P / P.sum(axis=1, keepdims=True)


# Which entry is which


def test_two_chains_become_one_of_four_modes() -> None:
    found = np.array(read(problem=3, gamma_chain=LOST, delta_chain=NOISY).kernel)
    for i, (gamma, nominal) in enumerate(PAIRS):
        for j, (gamma_next, nominal_next) in enumerate(PAIRS):
            product = LOST[gamma][gamma_next] * NOISY[1 - nominal][1 - nominal_next]
            assert found[i, j] == product


def test_entries_of_the_product_by_hand() -> None:
    """From (1,1): the signal stays with 0.9, the noise stays with 0.8, and so on."""
    found = np.array(read(problem=3, gamma_chain=LOST, delta_chain=NOISY).kernel)
    np.testing.assert_allclose(found[0], [0.72, 0.18, 0.08, 0.02], rtol=1e-15)
    np.testing.assert_allclose(found[3], [0.12, 0.28, 0.18, 0.42], rtol=1e-15)


def test_a_signal_that_is_lost_for_good_ends_in_gamma_0() -> None:
    law = read(problem=3, gamma_chain=ABSORBING, delta_chain=NOISY).initial
    assert law[:2] == (0.0, 0.0)
    assert law[2:] == pytest.approx((0.6, 0.4), rel=1e-15)


def test_rates_become_the_law_of_independent_modes() -> None:
    found = read(problem=1, gamma_rate=0.9, delta_nominal_rate=0.8)
    assert found.initial == pytest.approx((0.72, 0.18, 0.08, 0.02), rel=1e-15)
    assert found.kernel == (found.initial,) * 4


def test_a_joint_law_keeps_its_order() -> None:
    found = read(problem=2, joint=[0.4, 0.3, 0.2, 0.1])
    assert found.initial == (0.4, 0.3, 0.2, 0.1)
    assert found.kernel == ((0.4, 0.3, 0.2, 0.1),) * 4


def test_a_kernel_is_taken_as_it_is() -> None:
    assert read(problem=4, kernel=KERNEL).kernel == tuple(tuple(row) for row in KERNEL)


def test_a_start_replaces_the_stationary_law() -> None:
    start = (0.1, 0.2, 0.3, 0.4)
    for law in (
        {"problem": 1, "gamma_rate": 0.9, "delta_nominal_rate": 0.8},
        {"problem": 2, "joint": [0.4, 0.3, 0.2, 0.1]},
        {"problem": 3, "gamma_chain": LOST, "delta_chain": NOISY},
        {"problem": 4, "kernel": KERNEL},
    ):
        assert read(**law, initial=list(start)).initial == start


def test_without_a_noise_factor_nothing_need_be_said_of_delta() -> None:
    rate = read(noise_factor=1.0, problem=1, gamma_rate=0.9)
    assert rate.initial == pytest.approx((0.9, 0.0, 0.1, 0.0), rel=1e-15)
    two = read(noise_factor=1.0, problem=3, gamma_chain=LOST)
    assert two.initial == pytest.approx((0.8, 0.0, 0.2, 0.0), rel=1e-15)
    assert {row[1] for row in two.kernel} == {row[3] for row in two.kernel} == {0.0}


def test_rows_are_sorted_and_may_be_names() -> None:
    law = {"problem": 1, "gamma_rate": 0.9, "delta_nominal_rate": 0.8}
    assert read(**law).rows == (0, 1)
    assert read(**law, rows=[1, 0]).rows == (0, 1)
    assert read(**law, rows=["y1"]).rows == read(**law, rows=np.array([1])).rows == (1,)


# Written and read again

SAME: dict[str, tuple[dict[str, object], dict[str, object]]] = {
    "1 as 2": (
        {"problem": 1, "gamma_rate": 0.5, "delta_nominal_rate": 0.25},
        {"problem": 2, "joint": [0.125, 0.375, 0.125, 0.375]},
    ),
    "1 as 3": (
        {"problem": 1, "gamma_rate": 0.5, "delta_nominal_rate": 0.25},
        {"problem": 3, "gamma_chain": [[0.5, 0.5]] * 2, "delta_chain": [[0.25, 0.75]] * 2},
    ),
    "2 as 4": (
        {"problem": 2, "joint": [0.4, 0.3, 0.2, 0.1]},
        {"problem": 4, "kernel": [[0.4, 0.3, 0.2, 0.1]] * 4, "initial": [0.4, 0.3, 0.2, 0.1]},
    ),
    "3 as 4": (
        {"problem": 3, "gamma_chain": [[0.5, 0.5], [0.0, 1.0]], "delta_chain": [[1.0, 0.0]] * 2},
        {
            "problem": 4,
            "kernel": [[1, 0, 0, 0], [1, 0, 0, 0], [0.5, 0, 0.5, 0], [0.5, 0, 0.5, 0]],
        },
    ),
    "all rows": (
        {"problem": 2, "joint": [0.4, 0.3, 0.2, 0.1]},
        {"problem": 2, "joint": [0.4, 0.3, 0.2, 0.1], "rows": ["y1", 0]},
    ),
}


@pytest.mark.parametrize("pair", SAME.values(), ids=SAME)
def test_the_same_law_said_differently_is_the_same_spec(pair) -> None:
    one, other = (Spec.from_dict(table(noise_factor=4.0, **law)) for law in pair)
    assert one == other
    assert hash(one) == hash(other)
    assert one.canonical() == other.canonical()


LAWS: dict[str, dict[str, object]] = {
    "1": {"problem": 1, "gamma_rate": 0.9, "delta_nominal_rate": 0.7, "rows": [1]},
    "2": {"problem": 2, "joint": [1 / 3, 1 / 3, 1 / 3, 0.0]},
    "3": {"problem": 3, "gamma_chain": LOST, "delta_chain": NOISY},
    "alternating": {"problem": 3, "gamma_chain": ALTERNATING, "delta_chain": ALTERNATING},
    "absorbing": {"problem": 3, "gamma_chain": ABSORBING, "delta_chain": NOISY},
    "start": {"problem": 4, "kernel": KERNEL, "initial": [0.0, 0.0, 1.0, 0.0]},
    "rounded": {"problem": 2, "joint": [0.3333333333, 0.3333333333, 0.3333333333, 0.0]},
}


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
@pytest.mark.parametrize("family", ["imm", "one_step", "genie", "linear_optimal"])
def test_a_spec_that_is_written_reads_the_same(law, family) -> None:
    spec = Spec.from_dict(table(family, noise_factor=2.5, **law))
    again = Spec.from_dict(spec.to_dict())
    assert again == spec
    assert again.canonical() == spec.canonical()


def test_moments_and_a_genie_without_a_law_are_written_and_read() -> None:
    moments = {"gamma_rate": 0.93, "gamma_persistence": 0.94, "delta_nominal_rate": 0.8}
    for one in (
        table("linear_optimal", problem="moments", noise_factor=10.0, **moments),
        table("genie", noise_factor=10.0, rows=[0]),
    ):
        spec = Spec.from_dict(one)
        assert Spec.from_dict(spec.to_dict()) == spec
        assert spec.faults.sensor is not None
        assert spec.faults.sensor.kernel == spec.faults.sensor.initial == ()


def test_the_parameters_of_a_genie_are_its_own() -> None:
    spec = Spec.from_dict(table("genie", noise_factor=10.0))
    assert spec.defaults == {"gamma": 1.0, "delta": 1.0}
    assert spec.to_dict()["parameters"] == {}


# Stationary laws


@pytest.mark.parametrize("zeros", [0.0, 0.4])
@pytest.mark.parametrize("n", [2, 3, 4])
def test_a_stationary_law_does_not_change(n, zeros) -> None:
    rng = np.random.default_rng(n)
    found = 0
    for _ in range(50):
        P = chain(rng, n, zeros)
        law = stationary_law(P)
        if law is not None:
            found += 1
            assert law.sum() == pytest.approx(1.0, rel=1e-15)
            np.testing.assert_allclose(law @ P, law, atol=1e-15)
    assert found > 25


def test_the_stationary_law_does_not_depend_on_the_order_of_states() -> None:
    P = chain(np.random.default_rng(1), 4)
    law = stationary_law(P)
    for order in itertools.permutations(range(4)):
        np.testing.assert_allclose(stationary_law(P[np.ix_(order, order)]), law[list(order)])


@pytest.mark.parametrize(
    ("transition", "law"),
    [
        (ALTERNATING, (0.5, 0.5)),
        (ABSORBING, (1.0, 0.0)),
        ([[1.0, 0.0], [1.0, 0.0]], (1.0, 0.0)),
        ([[0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.1, 0.1, 0.8]], (0.5, 0.5, 0.0)),
        ([[1 - 1e-12, 1e-12], [3e-12, 1 - 3e-12]], (0.75, 0.25)),
        (np.eye(1), (1.0,)),
    ],
)
def test_stationary_laws_by_hand_with_exact_zeros(transition, law) -> None:
    found = stationary_law(transition)
    assert found == pytest.approx(law, rel=1e-12)
    assert [p == 0.0 for p in found] == [p == 0.0 for p in law]


@pytest.mark.parametrize(
    "transition", [np.eye(2), np.eye(4), [[1, 0, 0], [0, 1, 0], [0.3, 0.3, 0.4]]]
)
def test_several_stationary_laws_are_none(transition) -> None:
    assert stationary_law(transition) is None


def test_states_that_are_never_visited() -> None:
    P = [[0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.1, 0.1, 0.8]]
    assert visited(P, [1.0, 0.0, 0.0]).tolist() == [True, True, False]
    assert visited(P, [0.0, 0.0, 1.0]).tolist() == [True, True, True]
    assert visited(ALTERNATING, [1.0, 0.0]).tolist() == [True, True]
    assert visited(np.eye(3), [0.0, 0.5, 0.5]).tolist() == [False, True, True]


# Three modes in place of four


def merged(kernel, initial):
    return lump(kernel, initial, ((0,), (1,), (2, 3)))


LUMPABLE: dict[str, dict[str, object]] = {
    "rates": {"problem": 1, "gamma_rate": 0.9, "delta_nominal_rate": 0.7},
    "joint": {"problem": 2, "joint": [0.4, 0.3, 0.2, 0.1]},
    "white noise": {"problem": 3, "gamma_chain": LOST, "delta_chain": [[0.7, 0.3]] * 2},
    "never lost": {"problem": 3, "gamma_chain": [[0.0, 1.0]] * 2, "delta_chain": NOISY},
}


@pytest.mark.parametrize("law", LUMPABLE.values(), ids=LUMPABLE)
def test_three_modes_have_the_law_of_four_where_lumping_is_exact(law) -> None:
    faults = read(**law)
    lumped = merged(faults.kernel, faults.initial)
    assert lumped.defect < 1e-15
    four, three = np.array(faults.initial), np.array(lumped.initial)
    for _ in range(5):
        np.testing.assert_allclose(three, [four[0], four[1], four[2] + four[3]], atol=1e-15)
        np.testing.assert_allclose(four[2:], np.array(lumped.shares[2]) * three[2], atol=1e-15)
        four, three = four @ np.array(faults.kernel), three @ np.array(lumped.transition)


def test_shares_of_the_noises_without_signal() -> None:
    joint = read(problem=2, joint=[0.4, 0.3, 0.2, 0.1])
    assert merged(joint.kernel, joint.initial).shares[2] == pytest.approx((2 / 3, 1 / 3), rel=1e-15)
    never = read(**LUMPABLE["never lost"])
    assert merged(never.kernel, never.initial).shares[2] == (1.0, 0.0)


@pytest.mark.parametrize(
    "law",
    [
        {"problem": 3, "gamma_chain": LOST, "delta_chain": NOISY},
        {"problem": 4, "kernel": KERNEL},
        {**LUMPABLE["rates"], "initial": [0.25, 0.25, 0.1, 0.4]},
    ],
    ids=["noise that lasts", "kernel", "start"],
)
def test_a_law_that_cannot_be_lumped_has_a_defect(law) -> None:
    faults = read(**law)
    lumped = merged(faults.kernel, faults.initial)
    assert lumped.defect > 0.01
    np.testing.assert_allclose(np.sum(lumped.transition, axis=1), 1.0, rtol=1e-15)
