"""Soft faults: what a spec says is read as it is meant, and what is impossible is refused."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
from refusals import INF, KF, NAN, REMOVED, Case, changed, check

from fkgen.problem import Spec

MODEL: dict[str, Any] = {
    "A": [[1.0, "dt"], [0.0, 1.0]],
    "C": [[0.0, 1.0], [1.0, 0.0], [1.0, 0.1]],
    "Q": [[0.01, 0.0], [0.0, 1.0]],
    "R": [[0.01, 0.0, 0.0], [0.0, 100.0, 0.0], [0.0, 0.0, 4.0]],
    "x0": [0.0, 0.0],
    "P0": [[1.0, 0.0], [0.0, 1.0]],
    "outputs": [{"name": "speed"}, {"name": "gnss"}, {"name": "beacon"}],
}


def soft(family: str, options: dict[str, object] | None = None, **faults: object) -> dict[str, Any]:
    return {
        "name": "motor",
        "model": copy.deepcopy(MODEL),
        "parameters": {"dt": 0.2},
        "faults": {"soft": {"host": [0], "window": 150, **faults}},
        "filter": {"family": family, **(options or {})},
    }


DFCF, CPCF, FULL = (soft(family) for family in ("dfcf", "cpcf", "compression_full"))


def faults_of(table: dict[str, Any]):
    return Spec.from_dict(table).faults.soft


def test_all_rows_that_are_not_the_hosts_are_one_group_unless_groups_say_otherwise():
    found = faults_of(DFCF)
    assert (found.host, found.groups, found.window, found.false_alarm) == (
        (0,),
        ((1, 2),),
        150,
        0.05,
    )
    assert found.compressed == (1, 2)
    assert faults_of(soft("dfcf", groups=[[2], [1]])).groups == ((2,), (1,))


def test_rows_may_be_named_and_come_sorted():
    found = faults_of(soft("dfcf", host=["beacon", "speed"], groups=[["gnss"]]))
    assert (found.host, found.groups) == ((0, 2), ((1,),))


def test_the_host_of_compression_full_only_propagates_unless_it_is_given_rows():
    table = soft("compression_full")
    assert faults_of(table).host == (0,)
    del table["faults"]["soft"]["host"]
    assert faults_of(table).host == ()
    assert faults_of(table).groups == ((0, 1, 2),)


def test_a_compression_filter_is_tested_and_never_reacquired_by_default():
    options = Spec.from_dict(DFCF).filter.options
    assert options.test is True
    assert options.reacquire is None
    assert Spec.from_dict(CPCF).filter.options.maintenance == "optimal"


@pytest.mark.parametrize(
    "table",
    [
        DFCF,
        FULL,
        CPCF,
        soft("dfcf", {"test": False}),
        soft("dfcf", {"reacquire": 3}, groups=[[1], [2]], false_alarm=0.01),
        soft("cpcf", {"maintenance": "paper"}),
    ],
)
def test_a_spec_comes_back_from_its_own_table(table):
    spec = Spec.from_dict(table)
    again = Spec.from_dict(spec.to_dict())
    assert again == spec
    assert again.canonical() == spec.canonical()


def test_noise_may_be_correlated_inside_host_and_inside_a_group():
    table = soft("dfcf")
    table["model"]["R"] = [[1.0, 0.0, 0.0], [0.0, 2.0, 0.5], [0.0, 0.5, 4.0]]
    assert np.asarray(Spec.from_dict(table).model.R.values())[1, 2] == 0.5


H, W, FA, G = (f"faults.soft.{key}" for key in ("host", "window", "false_alarm", "groups"))
R = "model.R"
CORRELATED = [[0.01, 0.0, 0.0], [0.0, 100.0, 3.0], [0.0, 3.0, 4.0]]
HOST_CORRELATED = [[0.01, 0.5, 0.0], [0.5, 100.0, 0.0], [0.0, 0.0, 4.0]]
VARYING = [["1.0", "dt", 0.0], ["dt", 100.0, 0.0], [0.0, 0.0, 4.0]]
SINGULAR = [[0.01, 0.0, 0.0], [0.0, 4.0, 4.0], [0.0, 4.0, 4.0]]
TEST, AGAIN, CARE = "filter.test", "filter.reacquire", "filter.maintenance"

CASES: list[Case] = [
    (DFCF, {"faults.soft": REMOVED}, "faults.soft", "the section is missing", "soft faults for"),
    (DFCF, {"faults.soft": 3}, "faults.soft", "the int 3", "a table with host, window"),
    (KF, {"faults.soft": {}}, "faults.soft", "soft faults", "compression_full, dfcf, cpcf handle"),
    (DFCF, {"faults.soft.hots": [0]}, "faults.soft.hots", "an unknown key", "did you mean 'host'?"),
    (DFCF, {H: REMOVED}, H, "missing", "rows of y, out of 0..2 (speed, gnss, beacon)"),
    (DFCF, {H: 0}, H, "the int 0", "a list of rows of y"),
    (DFCF, {H: [3]}, f"{H}[0]", "3", "a row of y, 0..2"),
    (DFCF, {H: [0, -1]}, f"{H}[1]", "-1", "a row of y, 0..2"),
    (DFCF, {H: [0.5]}, f"{H}[0]", "0.5", "a row of y, 0..2"),
    (DFCF, {H: ["sped"]}, f"{H}[0]", "'sped'", "did you mean 'speed'?"),
    (DFCF, {H: [0, 0]}, f"{H}[1]", "row 0 a second time", "every row once"),
    (DFCF, {H: []}, H, "an empty list", "a host that only propagates is compression_full"),
    (DFCF, {H: [0, 1, 2]}, H, "every row of y", "at least one row left for the compression"),
    (FULL, {H: [2, 1, 0]}, H, "every row of y", "at least one row left for the compression"),
    (DFCF, {W: REMOVED}, W, "missing", "a whole number of samples"),
    (DFCF, {W: 0}, W, "0", "a whole number of samples, 1 to"),
    (DFCF, {W: -3}, W, "-3", "a whole number of samples, 1 to"),
    (DFCF, {W: 2.5}, W, "2.5", "a whole number of samples"),
    (DFCF, {W: 1e9}, W, "1000000000.0", "1 to 10000000"),
    (DFCF, {W: "30 s"}, W, "the text '30 s'", "a whole number of samples"),
    (DFCF, {W: True}, W, "the boolean True", "a whole number of samples"),
    (DFCF, {FA: 0.0}, FA, "0.0", "a probability between 0 and 1, both excluded"),
    (DFCF, {FA: 1.0}, FA, "1.0", "a probability between 0 and 1, both excluded"),
    (DFCF, {FA: NAN}, FA, "nan", "a probability between 0 and 1"),
    (DFCF, {FA: INF}, FA, "inf", "a probability between 0 and 1"),
    (DFCF, {G: []}, G, "an empty list", "leave the key out for one group"),
    (DFCF, {G: [1, 2]}, f"{G}[0]", "the int 1", "a list of rows of y"),
    (DFCF, {G: [[1, 2], []]}, f"{G}[1]", "an empty group", "at least one row"),
    (DFCF, {G: [[1], [2, 3]]}, f"{G}[1][1]", "3", "a row of y, 0..2"),
    (DFCF, {G: [[0, 1], [2]]}, f"{G}[0]", "row 0, a row of the host", "every row once"),
    (DFCF, {G: [[1], [2, 1]]}, f"{G}[1]", "row 1, in another group too", "every row once"),
    (DFCF, {G: [[1]]}, G, "groups without row 2 (beacon)", "every row in host or a group"),
    (DFCF, {G: [[1]] * 5}, G, "5 groups", "at most 4: each of the 31 sets of accepted groups"),
    (CPCF, {G: [[1], [2]]}, G, "2 groups", "at most 1: cpcf has one compression filter"),
    (DFCF, {R: HOST_CORRELATED}, R, "entry [1][0] = 0.5", "would be counted twice"),
    (DFCF, {R: CORRELATED, G: [[1], [2]]}, R, "entry [2][1] = 3", "put such rows into one group"),
    (DFCF, {R: VARYING}, R, "entry [1][0] = 0.2", "would be counted twice"),
    (CPCF, {R: SINGULAR}, R, "a singular block", "eq. (46); dfcf does not need it"),
    (DFCF, {TEST: 1}, TEST, "the int 1", "true or false"),
    (DFCF, {TEST: "no"}, TEST, "the text 'no'", "true or false"),
    (KF, {TEST: True}, TEST, "test for the family kf", "only for compression_full, dfcf, cpcf"),
    (DFCF, {AGAIN: 0}, AGAIN, "0", "leave it out for never"),
    (DFCF, {AGAIN: 1.5}, AGAIN, "1.5", "a whole number in 1.."),
    (DFCF, {AGAIN: 2, TEST: False}, AGAIN, "reacquire with test = false", "nothing is rejected"),
    (DFCF, {CARE: "paper"}, CARE, "maintenance for the family dfcf", "only for the family cpcf"),
    (CPCF, {CARE: "papre"}, CARE, "'papre'", "did you mean 'paper'?"),
]


@pytest.mark.parametrize("case", CASES)
def test_what_is_impossible_is_refused_with_a_reason(case):
    check(*case)


def test_the_tables_that_are_changed_are_right():
    for table in (DFCF, CPCF, FULL, changed(DFCF, {})):
        Spec.from_dict(table)
