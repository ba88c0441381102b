"""Impossible sensor faults are refused: file, key, what was given, what was expected, and why."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
from refusals import INF, KF, MKF, NAN, REMOVED, Case, changed, check, refusal

from fkgen.problem import Spec

#: The identity where tau is 1.
STAYING = [[1, 0, 0, 0], ["1 - tau", "tau", 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
KERNEL = [[0.7, 0.1, 0.1, 0.1], [0.2, 0.6, 0.1, 0.1], [0.1, 0.1, 0.7, 0.1], [0.1, 0.2, 0.3, 0.4]]
IDENTITY = np.eye(4).tolist()
MODEL: dict[str, Any] = {
    "A": [[0.9, "tau"], [0.0, 0.8]],
    "C": [[1.0, 0.0], [0.0, 1.0]],
    "Q": [[1.0, 0.0], [0.0, 1.0]],
    "R": [[1.0, 0.0], [0.0, 2.0]],
    "x0": [0.0, 0.0],
    "P0": [[1.0, 0.0], [0.0, 1.0]],
    "outputs": [{"name": "gnss"}, {"name": "odometer"}],
}


def sensor(family: str, **faults: object) -> dict[str, Any]:
    return {
        "name": "motor",
        "model": MODEL,
        "parameters": {"tau": 0.05},
        "faults": {"sensor": {"noise_factor": 10, **faults}},
        "filter": {"family": family},
    }


ONE = sensor("one_step", problem=1, gamma_rate=0.9, delta_nominal_rate=0.8)
TWO = sensor("one_step", problem=2, joint=[0.7, 0.1, 0.15, 0.05])
THREE = sensor(
    "imm", problem=3, gamma_chain=[[0.6, 0.4], [0.1, 0.9]], delta_chain=[[0.8, 0.2], [0.3, 0.7]]
)
FOUR = sensor("imm", problem=4, kernel=KERNEL)
MOMENTS = sensor(
    "linear_optimal",
    problem="moments",
    gamma_rate=0.93,
    gamma_persistence=0.94,
    delta_nominal_rate=0.8,
)
GENIE = sensor("genie")
CHAIN = changed(THREE, {"filter.family": "linear_optimal"})
BASES = {
    "1": ONE,
    "2": TWO,
    "3": THREE,
    "4": FOUR,
    "moments": MOMENTS,
    "genie": GENIE,
    "chain": CHAIN,
}

S, TAU = "faults.sensor", "parameters.tau"
FACTOR, ROWS, PROBLEM, INITIAL = f"{S}.noise_factor", f"{S}.rows", f"{S}.problem", f"{S}.initial"
RATE, PERSISTENCE, NOMINAL = f"{S}.gamma_rate", f"{S}.gamma_persistence", f"{S}.delta_nominal_rate"
JOINT, GAMMA, DELTA, K = f"{S}.joint", f"{S}.gamma_chain", f"{S}.delta_chain", f"{S}.kernel"
ORDER = "ordered (1,1) (1,C) (0,1) (0,C) as (gamma, delta)"
FAMILY, FORM, MODES, READING = "filter.family", "filter.form", "filter.modes", "filter.covariance"
KEYS_OF = "1 (gamma_rate, delta_nominal_rate), 2 (joint), 3 (gamma_chain, delta_chain), 4 (kernel)"


@pytest.mark.parametrize("base", BASES.values(), ids=BASES)
def test_what_the_cases_start_from_is_right(base: dict[str, Any]) -> None:
    Spec.from_dict(base)


SECTION: list[Case] = [
    (KF, {S: {}}, S, "sensor faults", "none for the family kf; linear_optimal, one_step, imm, gen"),
    (MKF, {S: {"problem": 1}}, S, "sensor faults", "none for the family mkf; linear_optimal"),
    (
        ONE,
        {"faults": REMOVED},
        S,
        "the section is missing",
        "sensor faults for the family one_step",
    ),
    (GENIE, {"faults": {}}, S, "the section is missing", "sensor faults for the family genie"),
    (FOUR, {"faults.actuator": {}}, "faults.actuator", "actuator", "for the family imm; mkf, mme"),
    (ONE, {S: 3}, S, "the int 3", "a table with noise_factor, rows, problem"),
    (ONE, {f"{S}.problm": 1}, f"{S}.problm", "an unknown key", "did you mean 'problem'?"),
    (ONE, {f"{S}.gamma": 1}, f"{S}.gamma", "an unknown key", "did you mean 'gamma_rate'?"),
    (ONE, {FACTOR: 0}, FACTOR, "0.0", "a positive number up to 1e+12: noise variance of a fault"),
    (ONE, {FACTOR: -2.0}, FACTOR, "-2.0", "a positive number"),
    (ONE, {FACTOR: 1e13}, FACTOR, "10000000000000.0", "up to 1e+12"),
    (ONE, {FACTOR: NAN}, FACTOR, "nan", "a positive number"),
    (ONE, {FACTOR: INF}, FACTOR, "inf", "a positive number"),
    (ONE, {FACTOR: "taw"}, FACTOR, "'taw'", "not the name 'taw'"),
    (ONE, {FACTOR: "tau", TAU: -0.5}, FACTOR, "-0.5 at the defaults (tau)", "a positive number"),
    (ONE, {FACTOR: True}, FACTOR, "the boolean True", "a positive number"),
    (ONE, {FACTOR: [10, 2]}, FACTOR, "the list [10, 2]", "a positive number"),
    (GENIE, {FACTOR: 0.0}, FACTOR, "0.0", "a positive number"),
    (ONE, {ROWS: []}, ROWS, "an empty list", "0..1 (gnss, odometer); leave the key out if all"),
    (ONE, {ROWS: 0}, ROWS, "the int 0", "a list of rows of y, out of 0..1 (gnss, odometer)"),
    (ONE, {ROWS: "gnss"}, ROWS, "the text 'gnss'", "a list of rows of y"),
    (ONE, {ROWS: [0, 2]}, f"{ROWS}[1]", "2", "0..1, or its name (gnss, odometer)"),
    (ONE, {ROWS: [-1]}, f"{ROWS}[0]", "-1", "a row of y, 0..1"),
    (ONE, {ROWS: [0.5]}, f"{ROWS}[0]", "0.5", "a row of y, 0..1"),
    (ONE, {ROWS: [True]}, f"{ROWS}[0]", "the boolean True", "a row of y, 0..1"),
    (ONE, {ROWS: [None]}, f"{ROWS}[0]", "the NoneType None", "a row of y, 0..1"),
    (ONE, {ROWS: [1, 1]}, f"{ROWS}[1]", "row 1 a second time", "every row once"),
    (ONE, {ROWS: [1, 0, "odometer"]}, f"{ROWS}[2]", "row 1 a second time", "every row once"),
    (ONE, {ROWS: ["gns"]}, f"{ROWS}[0]", "'gns'", "(gnss, odometer); did you mean 'gnss'?"),
    (ONE, {ROWS: ["lidar"]}, f"{ROWS}[0]", "'lidar'", "or its name (gnss, odometer)"),
    (ONE, {PROBLEM: REMOVED}, PROBLEM, "the key is missing", KEYS_OF),
    (ONE, {PROBLEM: 5}, PROBLEM, "5", 'or "moments" (gamma_rate, gamma_persistence, delta_nom'),
    (ONE, {PROBLEM: 0}, PROBLEM, "0", KEYS_OF),
    (ONE, {PROBLEM: 1.5}, PROBLEM, "1.5", KEYS_OF),
    (ONE, {PROBLEM: "1"}, PROBLEM, "'1'", KEYS_OF),
    (ONE, {PROBLEM: True}, PROBLEM, "True", KEYS_OF),
    (ONE, {PROBLEM: [1]}, PROBLEM, "[1]", KEYS_OF),
    (ONE, {PROBLEM: "moment"}, PROBLEM, "'moment'", '"moments"'),
    (MOMENTS, {FAMILY: "one_step"}, PROBLEM, '"moments" for the family one_step', "1, 2, 3 or 4:"),
    (MOMENTS, {FAMILY: "imm"}, PROBLEM, '"moments" for the family imm', "only linear_optimal"),
    (MOMENTS, {FAMILY: "genie"}, PROBLEM, '"moments" for the family genie', "or no law at all"),
    (ONE, {JOINT: [1, 0, 0, 0]}, JOINT, "joint with problem 1", "gamma_rate, delta_nominal_rate,"),
    (ONE, {PERSISTENCE: 0.95}, PERSISTENCE, "with problem 1", "delta_nominal_rate, initial for"),
    (TWO, {RATE: 0.9}, RATE, "gamma_rate with problem 2", "joint, initial for this problem"),
    (THREE, {K: KERNEL}, K, "kernel with problem 3", "gamma_chain, delta_chain, initial for this"),
    (FOUR, {GAMMA: IDENTITY}, GAMMA, "gamma_chain with problem 4", "kernel, initial for this"),
    (MOMENTS, {INITIAL: [1, 0, 0, 0]}, INITIAL, "initial with problem 'moments'", "persistence, d"),
    (GENIE, {K: KERNEL}, PROBLEM, "missing) beside kernel", "the problem that it belongs to"),
    (GENIE, {INITIAL: [1, 0, 0, 0]}, PROBLEM, "missing) beside initial", "the problem that it"),
    (GENIE, {PROBLEM: 4}, K, "the key is missing", f"a 4 x 4 matrix, modes {ORDER}"),
]

PROBABILITIES: list[Case] = [
    (ONE, {RATE: REMOVED}, RATE, "the key is missing", "a probability in [0, 1]: Pr(gamma = 1)"),
    (ONE, {RATE: 1.1}, RATE, "1.1", "a probability in [0, 1]"),
    (ONE, {RATE: -0.1}, RATE, "-0.1", "a probability in [0, 1]"),
    (ONE, {RATE: NAN}, RATE, "nan", "a probability in [0, 1]"),
    (ONE, {RATE: "taw"}, RATE, "'taw'", "not the name 'taw'"),
    (ONE, {RATE: "tau", TAU: 1.5}, RATE, "1.5 at the defaults (tau)", "a probability in [0, 1]"),
    (ONE, {RATE: "tau", TAU: 0.5, INITIAL: [1, 0, 0, 0]}, INITIAL, "with parameters", "its own"),
    (ONE, {RATE: [0.9]}, RATE, "the list [0.9]", "a probability in [0, 1]"),
    (ONE, {NOMINAL: REMOVED}, NOMINAL, "the key is missing", "[0, 1]: Pr(delta = 1)"),
    (ONE, {NOMINAL: 2}, NOMINAL, "2.0", "a probability in [0, 1]"),
    (TWO, {JOINT: REMOVED}, JOINT, "the key is missing", f"4 probabilities, {ORDER}"),
    (TWO, {JOINT: [0.5, 0.5]}, JOINT, "2 entries", f"a list of 4 probabilities, {ORDER}"),
    (TWO, {JOINT: [[0.5, 0.5], [0.0, 0.0]]}, JOINT, "2 entries", "a list of 4 probabilities"),
    (TWO, {JOINT: 0.5}, JOINT, "the float 0.5", f"a list of 4 probabilities, {ORDER}"),
    (TWO, {JOINT: [0.7, 0.1, 0.1, 0.2]}, JOINT, "sum to 1.1", "a sum of 1"),
    (TWO, {JOINT: [0.7, 0.1, 0.1, 0.1 + 2e-9]}, JOINT, "sum to 1.000000002", "a sum of 1"),
    (TWO, {JOINT: [0.0, 0.0, 0.0, 0.0]}, JOINT, "sum to 0", "a sum of 1"),
    (TWO, {JOINT: [0.8, 0.3, -0.1, 0.0]}, f"{JOINT}[2]", "-0.1", "a probability in [0, 1]"),
    (TWO, {JOINT: [1.0, [0], 0, 0]}, f"{JOINT}[1]", "the list [0]", "a probability in [0, 1]"),
    (TWO, {JOINT: ["tau", 0.3, 0, 0], TAU: 0.5}, JOINT, "sum to 0.8 at the", "a sum of 1"),
    (FOUR, {K: STAYING, TAU: 1.0}, INITIAL, "several stationary laws at the", "4 probabilities"),
    (ONE, {INITIAL: ["tau", 0.3, 0, 0], TAU: 0.5}, INITIAL, "sum to 0.8 at the", "a sum of 1"),
    (THREE, {GAMMA: REMOVED}, GAMMA, "missing", "a 2 x 2 matrix, states ordered (0, 1)"),
    (THREE, {DELTA: REMOVED}, DELTA, "missing", "a 2 x 2 matrix, states ordered (1, C)"),
    (THREE, {GAMMA: 0.9}, GAMMA, "the float 0.9", "states ordered (0, 1), rows that sum to 1"),
    (THREE, {GAMMA: [[0.6, 0.4]]}, GAMMA, "1 rows", "a 2 x 2 matrix, states ordered (0, 1)"),
    (THREE, {GAMMA: [0.6, 0.4]}, f"{GAMMA}[0]", "the float 0.6", "a list of 2 probabilities, the"),
    (THREE, {GAMMA: KERNEL}, GAMMA, "4 rows", "a 2 x 2 matrix"),
    (THREE, {GAMMA: [[1.0], [0.0]]}, f"{GAMMA}[0]", "1 entries", "the law of the next state, ord"),
    (THREE, {GAMMA: [[0.6, 0.5], [0.1, 0.9]]}, f"{GAMMA}[0]", "sum to 1.1", "a sum of 1"),
    (THREE, {DELTA: [[0.8, 0.2], [0.3, 0.6]]}, f"{DELTA}[1]", "sum to 0.9", "a sum of 1"),
    (THREE, {GAMMA: [[0.6, 0.4], [-0.1, 1.1]]}, f"{GAMMA}[1][0]", "-0.1", "a probability in"),
    (FOUR, {K: REMOVED}, K, "the key is missing", f"a 4 x 4 matrix, modes {ORDER}"),
    (FOUR, {K: KERNEL[:3]}, K, "3 rows", f"a 4 x 4 matrix, states {ORDER}, rows that sum to 1"),
    (FOUR, {K: [row[:3] for row in KERNEL]}, f"{K}[0]", "3 entries", "a list of 4 probabilities"),
    (FOUR, {K: [*KERNEL[:3], [0.1, 0.1, 0.3, 0.4]]}, f"{K}[3]", "sum to 0.9", "a sum of 1"),
    (FOUR, {K: [*KERNEL[:3], [1.2, 0.0, 0.0, -0.2]]}, f"{K}[3][0]", "1.2", "a probability in [0"),
    (FOUR, {K: np.full((2, 2), 0.5)}, K, "2 rows", "a 4 x 4 matrix"),
    (FOUR, {K: np.eye(4)[..., None]}, f"{K}[0][0]", "the list [1.0]", "a probability in [0, 1]"),
    (FOUR, {INITIAL: [1, 0, 0]}, INITIAL, "3 entries", f"a list of 4 probabilities, {ORDER}"),
    (FOUR, {INITIAL: [1, 0, 0, 0.1]}, INITIAL, "sum to 1.1", "a sum of 1"),
    (FOUR, {INITIAL: [1.5, -0.5, 0, 0]}, f"{INITIAL}[0]", "1.5", "a probability in [0, 1]"),
    (FOUR, {INITIAL: "stationary"}, INITIAL, "the text 'stationary'", "a list of 4"),
    (FOUR, {K: IDENTITY}, INITIAL, "missing), and several stationary laws", "where the chain st"),
    (THREE, {GAMMA: np.eye(2)}, INITIAL, "several stationary laws", f"4 probabilities, {ORDER}"),
    (THREE, {DELTA: np.eye(2)}, INITIAL, "several stationary laws", "decides where it stays"),
    (MOMENTS, {RATE: REMOVED}, RATE, "the key is missing", "Pr(gamma = 1)"),
    (MOMENTS, {PERSISTENCE: REMOVED}, PERSISTENCE, "missing", "1, given that it was 1 in an ear"),
    (MOMENTS, {NOMINAL: REMOVED}, NOMINAL, "the key is missing", "Pr(delta = 1)"),
    (MOMENTS, {PERSISTENCE: 1.5}, PERSISTENCE, "1.5", "a probability in [0, 1]"),
    (MOMENTS, {PERSISTENCE: 0.92}, PERSISTENCE, "0.92", "at least gamma_rate = 0.93: were"),
    (MOMENTS, {RATE: 0.5, PERSISTENCE: 0.1}, PERSISTENCE, "0.1", "that alternates needs problem 3"),
    (MOMENTS, {RATE: 1, PERSISTENCE: 0.99}, PERSISTENCE, "0.99", "at least gamma_rate = 1:"),
]

SINGULAR = [[1.0, 1.0], [1.0, 1.0]]
OPTIONS: list[Case] = [
    (FOUR, {MODES: 5}, MODES, "5", "4, or 3: the modes without signal are one, with the mixture"),
    (FOUR, {MODES: 3.5}, MODES, "3.5", "4, or 3"),
    (FOUR, {MODES: "4"}, MODES, "the text '4'", "4, or 3"),
    (FOUR, {MODES: True}, MODES, "the boolean True", "4, or 3"),
    (FOUR, {MODES: [4]}, MODES, "the list [4]", "4, or 3"),
    (ONE, {MODES: 4}, MODES, "modes for the family one_step", "modes only for the family imm"),
    (ONE, {READING: "papper"}, READING, "'papper'", "weighted, paper, paper_nominal; did you mean"),
    (ONE, {READING: "joseph"}, READING, "'joseph'", "one of moment_matched, weighted, paper, pap"),
    (ONE, {READING: 3}, READING, "3", "one of moment_matched, weighted, paper, paper_nominal"),
    (FOUR, {READING: "paper"}, READING, "covariance for the family imm", "only for the family one"),
    (MOMENTS, {FORM: "lemma"}, FORM, "'lemma'", "lemma2, augmented; did you mean 'lemma2'?"),
    (MOMENTS, {FORM: 2}, FORM, "2", "one of lemma2, augmented"),
    (ONE, {FORM: "lemma2"}, FORM, "form for the family one_step", "only for the family linear_op"),
    (GENIE, {MODES: 4}, MODES, "modes for the family genie", "modes only for the family imm"),
    (GENIE, {"filter.hypotheses": [0.5]}, "filter.hypotheses", "the family genie", "only for the"),
    (MOMENTS, {FORM: "augmented"}, FORM, '"augmented" with problem "moments"', "a law: problem 1,"),
    (ONE, {"model.R": SINGULAR}, "model.R", "a singular matrix", "for the family one_step: it"),
    (FOUR, {"model.R": np.diag([1, 0])}, "model.R", "a singular matrix", "family imm: it compares"),
    (CHAIN, {"model.x0": [0, 1]}, "model.x0", "a start that is not zero", "form = 'augmented' has"),
    (CHAIN, {"model.B": [[1], [0]]}, "model.B", "known inputs", "none where gamma depends on its"),
    (MOMENTS, {"model.x0": [0, 1]}, "model.x0", "not zero", "constant term; with problem 3 or 4,"),
    (MOMENTS, {"model.B": [[1], [0]]}, "model.B", "known inputs", "with problem 3 or 4, filter.f"),
]

GAMMA_PARAMETER = "another name: the family genie has a parameter gamma of its own"
PARAMETERS: list[Case] = [
    (GENIE, {"parameters.gamma": 1.0}, "parameters.gamma", "a parameter gamma", GAMMA_PARAMETER),
    (GENIE, {"parameters.delta": 2.0}, "parameters.delta", "a parameter delta", "another name"),
    (GENIE, {"parameters.Gamma": 1.0}, "parameters", "'Gamma' and 'gamma'", "distinct names"),
]


@pytest.mark.parametrize(
    "case", SECTION + PROBABILITIES + OPTIONS + PARAMETERS, ids=lambda case: f"{case[2]}: {case[3]}"
)
def test_what_is_refused(case: Case) -> None:
    check(*case)


def test_a_refused_dict_is_not_changed() -> None:
    table = changed(FOUR, {MODES: 5, ROWS: ["odometer", 0]})
    before = copy.deepcopy(table)
    refusal(table)
    assert table == before


@pytest.mark.parametrize(
    ("base", "changes"),
    [
        (CHAIN, {FORM: "augmented", "model.x0": [0.0, 1.0], "model.B": [[1.0], [0.0]]}),
        (ONE, {FAMILY: "linear_optimal", "model.x0": [0.0, 1.0], "model.B": [[1.0], [0.0]]}),
        (MOMENTS, {PERSISTENCE: 0.93, "model.x0": [0.0, 1.0]}),
        (MOMENTS, {"model.R": SINGULAR}),
        (GENIE, {"model.R": SINGULAR}),
        (GENIE, {PROBLEM: 4, K: KERNEL}),
        (FOUR, {K: IDENTITY, INITIAL: [0, 0, 1, 0]}),
        (FOUR, {"parameters.gamma": 0.5}),
        (ONE, {FACTOR: 0.1}),
        (MOMENTS, {RATE: 0.0, PERSISTENCE: 0.0}),
    ],
    ids=str,
)
def test_what_is_near_a_refusal_and_right(base: dict[str, Any], changes: dict[str, Any]) -> None:
    Spec.from_dict(changed(base, changes))
