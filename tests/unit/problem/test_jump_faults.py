"""Jumping plants in a spec: what is read, what is left to the model, and what is refused."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
from refusals import KF, NAN, REMOVED, Case, changed, check, refusal

from fkgen.faults import JumpFaults
from fkgen.faults.chain import is_ergodic, mean_square_radius
from fkgen.problem import Spec
from fkgen.problem.probability import period

P = [[0.95, 0.05], [0.1, 0.9]]
JUMP: dict[str, Any] = {
    **KF,
    "faults": {
        "jump": {"transition": P, "initial": [0.5, 0.5], "modes": [{}, {"A": [[0.9, 0], [0, 0.8]]}]}
    },
    "filter": {"family": "mjls_lmmse"},
}
LOSSY = changed(JUMP, {"faults.jump.arrival_rate": 0.85})
LLR = changed(LOSSY, {"filter.detector": "llr"})
CHAIN = changed(JUMP, {"faults.jump.arrival_chain": [[0.4, 0.6], [0.1, 0.9]]})
STEADY = changed(
    LOSSY, {"filter.gain": "stationary", "parameters": {}, "model.A": [[0.98, 0.1], [0, 0.9]]}
)
DRIVEN = changed(JUMP, {"model.B": [[1.0], [0.0]]})
IMM = changed(JUMP, {"filter.family": "imm"})
BASES = {"always": JUMP, "lossy": LOSSY, "llr": LLR, "chain": CHAIN, "steady": STEADY, "imm": IMM}


def jump_of(table: dict[str, Any]) -> JumpFaults:
    found = Spec.from_dict(table).faults.jump
    assert found is not None
    return found


@pytest.mark.parametrize("base", BASES.values(), ids=BASES)
def test_a_spec_survives_the_way_through_a_dict(base: dict[str, Any]) -> None:
    spec = Spec.from_dict(base)
    again = Spec.from_dict(spec.to_dict())
    assert again == spec
    assert again.canonical() == spec.canonical()


def test_what_a_mode_leaves_out_is_the_models() -> None:
    spec = Spec.from_dict(DRIVEN)
    assert spec.faults.jump is not None
    first, second = spec.faults.jump.modes
    assert all(getattr(first, key) == getattr(spec.model, key) for key in "ABCDQR")
    assert second.A.values().tolist() == [[0.9, 0], [0, 0.8]]
    assert second.B == spec.model.B
    assert second.c.values().tolist() == [[0.0], [0.0]]


def test_stating_what_the_model_says_changes_nothing() -> None:
    stated = changed(JUMP, {"faults.jump.modes": [{"A": KF["model"]["A"], "c": [0, 0]}, {}]})
    silent = changed(JUMP, {"faults.jump.modes": [{}, {}]})
    assert Spec.from_dict(stated) == Spec.from_dict(silent)


def test_a_mode_may_depend_on_parameters() -> None:
    modes = [{"A": [["exp(-tau)", 0], [0, 1]], "c": ["tau**2", 0]}, {"Q": [["tau", 0], [0, 1]]}]
    faults = jump_of(changed(JUMP, {"faults.jump.modes": modes}))
    assert not faults.modes[0].is_constant
    assert faults.modes[0].c.values({"tau": 3.0}).tolist() == [[9.0], [0.0]]
    assert faults.modes[1].Q.values({"tau": 2.0})[0, 0] == 2.0


def test_the_first_law_is_the_stationary_one_unless_it_is_said() -> None:
    faults = jump_of(changed(JUMP, {"faults.jump.initial": REMOVED}))
    assert faults.initial == pytest.approx([2 / 3, 1 / 3], abs=1e-15)
    assert jump_of(JUMP).initial == (0.5, 0.5)


@pytest.mark.parametrize(
    ("base", "arrival"), [(JUMP, "always"), (LOSSY, "unknown"), (CHAIN, "unknown")]
)
def test_what_was_lost_is_unknown_where_samples_are_lost(
    base: dict[str, Any], arrival: str
) -> None:
    assert jump_of(base).arrival == arrival


@pytest.mark.parametrize("arrival", ["always", "known"])
def test_a_rate_may_stand_where_the_filter_does_not_use_it(arrival: str) -> None:
    faults = jump_of(changed(LOSSY, {"faults.jump.arrival": arrival}))
    assert (faults.arrival, faults.arrival_rate) == (arrival, 0.85)


@pytest.mark.parametrize(("given", "detector"), [(True, "llr"), (False, "none"), ("nis", "nis")])
def test_a_detector_without_a_name_is_the_likelihood_ratio(given: object, detector: str) -> None:
    assert (
        Spec.from_dict(changed(LOSSY, {"filter.detector": given})).filter.options.detector
        == detector
    )


def test_an_offset_may_be_a_column() -> None:
    flat, column = ([{"c": c}, {}] for c in ([0.5, 1.0], np.array([[0.5], [1.0]])))
    specs = [
        Spec.from_dict(changed(JUMP, {"faults.jump.modes": modes})) for modes in (flat, column)
    ]
    assert specs[0] == specs[1]


def test_alpha_may_stand_beside_every_detector() -> None:
    spec = Spec.from_dict(changed(LLR, {"filter.alpha": 0.3}))
    assert spec.filter.options.alpha == 0.3


J = "faults.jump"
T, LAW, MODES, RATE = f"{J}.transition", f"{J}.initial", f"{J}.modes", f"{J}.arrival_rate"
ARRIVAL, LINK = f"{J}.arrival", f"{J}.arrival_chain"
FAMILY, DETECTOR, ALPHA, GAIN = "filter.family", "filter.detector", "filter.alpha", "filter.gain"

SECTION: list[Case] = [
    (KF, {J: {}}, J, "jump faults", "none for the family kf; imm, mjls_lmmse handle jump"),
    (JUMP, {"faults": REMOVED}, J, "the section is missing", "jump faults for the family mjls"),
    (IMM, {"faults": {}}, "faults.sensor", "the section is missing", "sensor or jump faults for"),
    (IMM, {"faults.sensor": {}}, J, "jump faults beside sensor faults", "one of them for the fam"),
    (JUMP, {f"{J}.transitions": P}, f"{J}.transitions", "an unknown key", "did you mean 'trans"),
    (JUMP, {T: REMOVED}, T, "the key is missing", "a 2 x 2 matrix, one row per mode"),
    (JUMP, {T: [[1.0]]}, T, "1 rows", "a 2 x 2 matrix"),
    (JUMP, {T: [[0.9, 0.2], [0.1, 0.9]]}, f"{T}[0]", "sum to 1.1", "a sum of 1"),
    (JUMP, {T: [[1.1, -0.1], [0.1, 0.9]]}, f"{T}[0][0]", "1.1", "a probability in [0, 1]"),
    (
        JUMP,
        {T: np.eye(2), LAW: REMOVED},
        LAW,
        "several stationary laws",
        "2 probabilities, one per",
    ),
    (JUMP, {LAW: [0.5, 0.6]}, LAW, "sum to 1.1", "a sum of 1"),
    (JUMP, {LAW: [1.0]}, LAW, "1 entries", "a list of 2 probabilities"),
    (JUMP, {MODES: REMOVED}, MODES, "the key is missing", "a list of modes, each a table of the"),
    (JUMP, {MODES: []}, MODES, "an empty list", "a list of modes"),
    (JUMP, {MODES: {}}, MODES, "the table {}", "a list of modes"),
    (JUMP, {MODES: [{}, 3]}, f"{MODES}[1]", "the int 3", "a table with A, B, C, D, Q, R, c"),
    (JUMP, {MODES: [{}, {"a": 1}]}, f"{MODES}[1].a", "an unknown key", "did you mean 'A'?"),
    (JUMP, {MODES: [{"A": [[1.0]]}, {}]}, f"{MODES}[0].A", "(1, 1)", "shape (2, 2): all modes"),
    (JUMP, {MODES: [{"C": [[1.0]]}, {}]}, f"{MODES}[0].C", "(1, 1)", "shape (1, 2): all modes"),
    (JUMP, {MODES: [{}, {"Q": [[1, 2], [0, 1]]}]}, f"{MODES}[1].Q", "[1][0]", "a symmetric matrix"),
    (JUMP, {MODES: [{}, {"R": [[-1.0]]}]}, f"{MODES}[1].R", "-1", "a positive semidefinite matrix"),
    (JUMP, {MODES: [{}, {"c": [1.0]}]}, f"{MODES}[1].c", "1 entries", "a list of 2 numbers or exp"),
    (JUMP, {MODES: [{}, {"c": ["ta", 0]}]}, f"{MODES}[1].c[0]", "'ta'", "did you mean 'tau'?"),
    (JUMP, {MODES: [{"B": [[1], [0]]}, {}]}, f"{MODES}[0].B", "model.B is missing", "it says how"),
    (DRIVEN, {MODES: [{"B": np.eye(2)}, {}]}, f"{MODES}[0].B", "(2, 2)", "shape (2, 1): all modes"),
    (JUMP, {MODES: [{}, {"A": [[1e101, 0], [0, 1]]}]}, f"{MODES}[1].A[0][0]", "1e+101", "at most"),
    (JUMP, {MODES: [{}, {"c": [0, 1e101]}]}, f"{MODES}[1].c[1]", "1e+101", "at most 1e+100"),
    (JUMP, {MODES: [{}, {"R": [[1e-101]]}]}, f"{MODES}[1].R[0][0]", "1e-101", "at least 1e-100"),
]

CHANNEL: list[Case] = [
    (LOSSY, {RATE: 1.1}, RATE, "1.1", "a probability in [0, 1]"),
    (LOSSY, {RATE: -0.1}, RATE, "-0.1", "a probability in [0, 1]"),
    (LOSSY, {RATE: NAN}, RATE, "nan", "a probability in [0, 1]"),
    (LOSSY, {LINK: P}, LINK, "arrival_chain beside arrival_rate", "one of the two"),
    (CHAIN, {LINK: [[0.5, 0.6], [0, 1]]}, f"{LINK}[0]", "sum to 1.1", "a sum of 1"),
    (CHAIN, {LINK: np.eye(2)}, LINK, "several stationary laws", "ordered (lost, arrived), is"),
    (JUMP, {ARRIVAL: "unknown"}, RATE, "missing) with arrival = 'unknown'", "or arrival_chain"),
    (LOSSY, {ARRIVAL: "know"}, ARRIVAL, "'know'", "always, known, unknown; did you mean"),
    (IMM, {RATE: 0.5}, RATE, "arrival_rate for the family imm", "they are for mjls_lmmse; write"),
]

NO_SIGMA = [{}, {"R": [[0.0]]}]
OPTIONS: list[Case] = [
    (KF, {DETECTOR: "llr"}, DETECTOR, "detector for the family kf", "only for the family mjls_lm"),
    (LLR, {DETECTOR: "lrt"}, DETECTOR, "'lrt'", "none, llr, nis, energy; did you mean 'llr'?"),
    (JUMP, {DETECTOR: "llr"}, ARRIVAL, "nothing about arrivals with the detector llr", "arrival_r"),
    (JUMP, {DETECTOR: "nis"}, ARRIVAL, "nothing about arrivals with the detector nis", "arrival_r"),
    (LLR, {ARRIVAL: "always"}, ARRIVAL, "'always' with the detector llr", "samples that may be"),
    (CHAIN, {DETECTOR: "llr"}, RATE, "missing) with the detector llr", "the prior of the likelih"),
    (LLR, {MODES: NO_SIGMA}, f"{MODES}[1].R", "a singular matrix", "for the detector llr: it com"),
    (IMM, {MODES: NO_SIGMA}, f"{MODES}[1].R", "a singular matrix", "the family imm: it compares"),
    (
        JUMP,
        {MODES: [{}, {"R": [[0.0]], "Q": np.zeros((2, 2))}]},
        f"{MODES}[1].R",
        "a singular matrix, and Q = 0",
        "or some process noise",
    ),
    (LLR, {ALPHA: 0.0}, ALPHA, "0.0", "a number in (0, 1)"),
    (LLR, {ALPHA: 1.0}, ALPHA, "1.0", "a number in (0, 1)"),
    (LLR, {ALPHA: "x"}, ALPHA, "the text 'x'", "a number in (0, 1)"),
    (LLR, {"filter.kappa": 1.0}, "filter.kappa", "with detector = 'llr'", "only with energy"),
    (LLR, {"filter.window": 5}, "filter.window", "with detector = 'llr'", "only with energy"),
    (LOSSY, {"filter.lock_out": 5}, "filter.lock_out", "with detector = 'none'", "llr or nis or"),
    (LLR, {"filter.lock_out": 0}, "filter.lock_out", "0", "a whole number in 1..1000000"),
    (LLR, {"filter.reinitialise": 1}, "filter.reinitialise", "1", "true or false"),
    (LOSSY, {DETECTOR: "energy", "filter.kappa": 0}, "filter.kappa", "0.0", "a positive number"),
    (LOSSY, {DETECTOR: "energy", "filter.window": 1.5}, "filter.window", "1.5", "in 1..100"),
    (LOSSY, {DETECTOR: "energy", "filter.window": 101}, "filter.window", "101", "in 1..100"),
    (IMM, {"filter.modes": 3}, "filter.modes", "3", "2, the number of faults.jump.modes, or no su"),
    (STEADY, {GAIN: "stationry"}, GAIN, "'stationry'", "did you mean 'stationary'?"),
    (LOSSY, {GAIN: "stationary"}, GAIN, "matrices that depend on parameters", "constants; use 'ti"),
    (STEADY, {"model.B": [[1], [0]]}, GAIN, "'stationary' with inputs", "a plant without B"),
    (STEADY, {T: np.eye(2)}, GAIN, "a chain that has no limit", "an ergodic chain"),
    (STEADY, {T: [[0, 1], [1, 0]]}, GAIN, "a chain that has no limit", "no cycle that it is bou"),
    (
        STEADY,
        {RATE: REMOVED, LINK: [[0, 1], [1, 0]]},
        GAIN,
        "an arrival_chain that alternates",
        "a chain with a limit",
    ),
    (
        STEADY,
        {MODES: [{}, {"A": [[1.1, 0], [0, 1]]}]},
        GAIN,
        "radius is 1.1",
        "radius below 1, or modes that differ in Q and R only",
    ),
    (
        STEADY,
        {RATE: REMOVED, MODES: [{}], T: [[1.0]], "faults.jump.initial": [1.0]}
        | {"model.A": [[1.0, 0.1], [0.0, 1.0]], "model.Q": np.zeros((2, 2))},
        GAIN,
        "without a stabilising solution",
        "to be moved by Q; use gain = 'time_varying'",
    ),
]


@pytest.mark.parametrize(
    "case", SECTION + CHANNEL + OPTIONS, ids=lambda case: f"{case[2]}: {case[3]}"
)
def test_what_is_refused(case: Case) -> None:
    check(*case)


def test_a_refused_dict_is_not_changed() -> None:
    table = changed(LLR, {DETECTOR: True, ALPHA: 2.0})
    before = copy.deepcopy(table)
    refusal(table)
    assert table == before


@pytest.mark.parametrize(
    ("transition", "cycle"),
    [
        ([[0, 1], [1, 0]], 2),
        ([[0, 1, 0], [0, 0, 1], [1, 0, 0]], 3),
        ([[0, 1, 0], [0.5, 0, 0.5], [1, 0, 0]], 1),
        ([[0.5, 0.5, 0], [0, 0, 1], [0, 1, 0]], 2),
        ([[0.5, 0.5], [0, 1]], 1),
        ([[1.0]], 1),
    ],
)
def test_the_period_of_a_chain_is_the_number_of_eigenvalues_on_the_circle(
    transition: list[list[float]], cycle: int
) -> None:
    assert period(transition) == cycle
    on_the_circle = np.isclose(np.abs(np.linalg.eigvals(np.array(transition, float))), 1.0)
    assert np.count_nonzero(on_the_circle) == cycle
    assert is_ergodic(transition) == (cycle == 1)


def test_the_radius_of_a_scalar_chain_is_that_of_its_weighted_squares() -> None:
    transition, a = np.array(P), np.array([0.9, 1.05])
    weighted = np.diag(a**2) @ transition
    expected = np.abs(np.linalg.eigvals(weighted)).max()
    found = mean_square_radius(P, [np.array([[each]]) for each in a])
    assert found == pytest.approx(expected, rel=1e-14)
