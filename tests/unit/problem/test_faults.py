"""Impossible faults and filter options are refused: file, key, what was given and expected."""

from __future__ import annotations

import copy
from typing import Any

import pytest
from refusals import KF, MKF, MME, NAN, REMOVED, Case, changed, check, refusal

TWO: dict[str, Any] = {
    **MKF,
    "model": {**KF["model"], "B": [[1.0, 0.0], [0.0, 1.0]]},
    "faults": {"actuator": {"success_rate": [0.7, 0.6], "dependence": "independent"}},
}
JOINT: dict[str, Any] = {
    **TWO,
    "faults": {"actuator": {"success_rate": [0.7, 0.6], "covariance": [[0.21, 0.1], [0.1, 0.24]]}},
}
MME2: dict[str, Any] = {
    **TWO,
    "faults": {"actuator": {"dependence": "independent"}},
    "filter": {"family": "mme", "hypotheses": [[0.1, 0.2], 0.5]},
}


ACT = "faults.actuator"
RATE, DEP, COV = f"{ACT}.success_rate", f"{ACT}.dependence", f"{ACT}.covariance"
FAULTS: list[Case] = [
    (KF, {ACT: {"success_rate": 0.7}}, ACT, "actuator faults", "none for the family kf"),
    (MKF, {"faults": REMOVED}, ACT, "the section is missing", "faults for the family mkf"),
    (MKF, {"faults": {}}, ACT, "the section is missing", "faults for the family mkf"),
    (MKF, {RATE: REMOVED}, RATE, "the key is missing", "a rate in [0, 1]"),
    (MKF, {RATE: 1.1}, RATE, "1.1", "a probability in [0, 1]"),
    (MKF, {RATE: -0.1}, RATE, "-0.1", "a probability in [0, 1]"),
    (MKF, {RATE: NAN}, RATE, "nan", "a probability in [0, 1]"),
    (MKF, {RATE: True}, RATE, "the boolean True", "a probability in [0, 1]"),
    (MKF, {RATE: "20*tau + 1"}, RATE, "2.0 at the defaults (20.0 * tau + 1.0)", "[0, 1]"),
    (MKF, {RATE: "rate"}, RATE, "'rate'", "only parameters"),
    (MKF, {RATE: [0.7, 0.6]}, RATE, "2 rates", "a list of 1"),
    (TWO, {RATE: [0.7]}, RATE, "1 rates", "a list of 2: one per input"),
    (TWO, {RATE: [0.7, 1.6]}, f"{RATE}[1]", "1.6", "a probability in [0, 1]"),
    (TWO, {DEP: "common"}, RATE, "different rates with dependence 'common'", "one rate"),
    (TWO, {DEP: REMOVED}, DEP, "missing) with 2 inputs", "common or independent, or a covariance"),
    (TWO, {DEP: "dependent"}, DEP, "'dependent'", "did you mean 'independent'?"),
    (TWO, {DEP: "covariance"}, COV, "the key is missing", "a (2, 2) covariance of gamma"),
    (MME2, {DEP: REMOVED}, DEP, "missing) with 2 inputs", "common or independent"),
    (JOINT, {DEP: "common"}, DEP, "'common' beside a covariance", "only one of the two"),
    (JOINT, {COV: [[0.21]]}, COV, "shape (1, 1)", "(2, 2): it is the covariance of gamma"),
    (JOINT, {COV: [[0.21, 0.1], [0.0, 0.24]]}, COV, "[1][0] = 0.0 and", "a symmetric matrix"),
    (JOINT, {COV: [[0.3, 0], [0, 0.24]]}, f"{COV}[0][0]", "0.3", "= 0.21 on the diagonal"),
    (
        JOINT,
        {COV: [[0.21, 0.2], [0.2, 0.24]]},
        f"{COV}[1][0]",
        "Pr(both work) = 0.62",
        "[-0.12, 0.18]",
    ),
    (JOINT, {COV: [[0.21, -0.13], [-0.13, 0.24]]}, f"{COV}[1][0]", "= 0.29", "[-0.12, 0.18]"),
    (JOINT, {RATE: ["tau + 0.65", 0.6]}, f"{COV}[0][0]", "0.21 for success_rate = 0.70", "= 0.2"),
    (JOINT, {COV: [[0.21, 0.3], [0.3, 0.24]]}, COV, "smallest eigenvalue -0.07", "semidefinite"),
    (MME, {COV: [[0.21]]}, COV, "a covariance", "none for the family mme"),
    (MME2, {DEP: "covariance"}, DEP, "'covariance'", "common or independent for the family mme"),
    (MME, {RATE: 2.0}, RATE, "2.0", "a probability in [0, 1]"),
]


@pytest.mark.parametrize("case", FAULTS, ids=lambda case: f"{case[2]}: {case[3]}")
def test_faults(case: Case) -> None:
    check(*case)


HYP, PRIOR, FLOOR = "filter.hypotheses", "filter.prior", "filter.weight_floor"
FILTERS: list[Case] = [
    (KF, {HYP: [0.5]}, HYP, "hypotheses for the family kf", "only for the family mme"),
    (MKF, {FLOOR: 0.0}, FLOOR, "weight_floor for the family mkf", "only for the family mme"),
    (MKF, {"filter.likelihood": "gaussian"}, "filter.likelihood", "for the family mkf", "only for"),
    (KF, {PRIOR: [1.0]}, PRIOR, "prior for the family kf", "only for the family mme"),
    (MME, {HYP: []}, HYP, "an empty list", "at least one hypothesis"),
    (MME, {HYP: 0.5}, HYP, "the float 0.5", "a list of hypotheses"),
    (MME, {HYP: [0.5, 1.5]}, f"{HYP}[1]", "1.5", "a probability in [0, 1]"),
    (MME, {HYP: [0.5, -1e-9]}, f"{HYP}[1]", "-1e-09", "a probability in [0, 1]"),
    (MME, {HYP: [0.5, NAN]}, f"{HYP}[1]", "nan", "a probability in [0, 1]"),
    (MME, {HYP: [0.5, "tau"]}, f"{HYP}[1]", "the text 'tau'", "a probability in [0, 1]"),
    (MME, {HYP: [True]}, f"{HYP}[0]", "the boolean True", "a probability in [0, 1]"),
    (MME, {HYP: [[0.5, 0.6]]}, f"{HYP}[0]", "2 rates", "1: the faults are common"),
    (MME2, {HYP: [[0.5]]}, f"{HYP}[0]", "1 rates", "2: one per input"),
    (MME2, {HYP: [[0.5, 2.0]]}, f"{HYP}[0][1]", "2.0", "a probability in [0, 1]"),
    (MME, {PRIOR: [0.5, 0.5]}, PRIOR, "2 entries", "a list of 3 probabilities"),
    (MME, {PRIOR: [0.5, 0.5, 0.1]}, PRIOR, "sum to 1.1", "a sum of 1"),
    (MME, {PRIOR: [0.5, 0.5, 2e-9]}, PRIOR, "sum to 1.000000002", "a sum of 1"),
    (MME, {PRIOR: [1.0, 0.5, -0.5]}, f"{PRIOR}[2]", "-0.5", "a probability in [0, 1]"),
    (MME, {PRIOR: 1.0}, PRIOR, "the float 1.0", "a list of 3 probabilities"),
    (MME, {FLOOR: -1e-9}, FLOOR, "-1e-09", "in [0, 1/3)"),
    (MME, {FLOOR: 1 / 3}, FLOOR, "0.3333", "in [0, 1/3)"),
    (MME, {FLOOR: "0"}, FLOOR, "the text '0'", "in [0, 1/3)"),
    (MME, {"filter.likelihood": "mix"}, "filter.likelihood", "'mix'", "mixture, gaussian"),
]


@pytest.mark.parametrize("case", FILTERS, ids=lambda case: f"{case[2]}: {case[3]}")
def test_filters(case: Case) -> None:
    check(*case)


def test_a_refused_dict_is_not_changed() -> None:
    table = changed(MME, {"filter.weight_floor": 2.0})
    before = copy.deepcopy(table)
    refusal(table)
    assert table == before
