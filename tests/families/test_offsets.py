"""Known offsets c and d do in every family what an input does that is always 1 and never fails."""

from __future__ import annotations

from copy import deepcopy

import numpy as np
import pytest
from plants import distance

import fkgen
from fkgen.families import NAMES

MODEL = {
    "A": [[0.9, "0.3*g"], [-0.2, 0.8]],
    "B": [[0.5], [1.0]],
    "C": [[1.0, 0.5], [0.0, 1.0]],
    "D": [[0.3], [0.0]],
    "Q": [[0.2, 0.05], [0.05, 0.1]],
    "R": [[0.5, 0.0], [0.0, 0.8]],
    "x0": [1.0, -1.0],
    "P0": [[2.0, 0.3], [0.3, 1.0]],
    "c": ["0.4*g", -0.3],
    "d": [0.7, "g"],
}
LAW = {"problem": 3, "gamma_chain": [[0.6, 0.4], [0.2, 0.8]], "delta_chain": [[0.9, 0.1]] * 2}
SENSOR = {"noise_factor": 4.0, "rows": [0]}
#: One mode as the model, one with offsets of its own, one that states that it has none.
MODES = [{}, {"c": [2.0, "0.1*g"], "d": [-1.0, 0.2], "Q": [[0.5, 0.0], [0.0, 0.3]]}, {"c": [0, 0]}]
JUMP = {
    "transition": [[0.8, 0.1, 0.1], [0.3, 0.7, 0.0], [0.2, 0.2, 0.6]],
    "initial": [0.5, 0.3, 0.2],
    "modes": MODES,
}
SOFT = {"host": [0], "window": 4}
WHITE = {"problem": 1, "gamma_rate": 0.7, "delta_nominal_rate": 0.8}

#: Faults and options of every family, in every form in which offsets are written anew.
CASES = {
    "kf": ("kf", {}, {}),
    "ekf": ("ekf", {}, {}),
    "iekf": ("iekf", {}, {}),
    "ukf": ("ukf", {}, {}),
    "mkf": ("mkf", {"actuator": {"success_rate": 0.7}}, {}),
    "mme": ("mme", {"actuator": {}}, {"hypotheses": [0.3, 0.8]}),
    "genie": ("genie", {"sensor": SENSOR}, {}),
    "one_step": ("one_step", {"sensor": SENSOR | LAW}, {}),
    "imm": ("imm", {"sensor": SENSOR | LAW}, {}),
    "imm of 3": ("imm", {"sensor": SENSOR | LAW}, {"modes": 3}),
    "imm of plants": ("imm", {"jump": JUMP}, {}),
    "linear_optimal": ("linear_optimal", {"sensor": SENSOR | WHITE}, {}),
    "augmented": ("linear_optimal", {"sensor": SENSOR | LAW}, {"form": "augmented"}),
    "mjls_lmmse": ("mjls_lmmse", {"jump": JUMP}, {}),
    "lost": ("mjls_lmmse", {"jump": JUMP | {"arrival_rate": 0.8}}, {}),
    "lost in bursts": (
        "mjls_lmmse",
        {"jump": JUMP | {"arrival_chain": [[0.5, 0.5], [0.1, 0.9]]}},
        {},
    ),
    "compression_full": ("compression_full", {"soft": {"window": 4}}, {}),
    "dfcf": ("dfcf", {"soft": SOFT}, {}),
    "cpcf": ("cpcf", {"soft": SOFT}, {}),
}
T = 24


def spec(case, *, model=MODEL, faults=None):
    family, own, options = CASES[case]
    table = {"name": "plant", "model": model, "parameters": {"g": 0.6}}
    table["faults"] = own if faults is None else faults
    return fkgen.Spec.from_dict(table | {"filter": {"family": family, **options}})


def driven(table):
    """The same matrices, offsets as one more column of B and D."""
    table = deepcopy(MODEL | table)
    for key, offset in (("B", table.pop("c")), ("D", table.pop("d"))):
        table[key] = [[*row, entry] for row, entry in zip(table[key], offset, strict=True)]
    return table


def reference(case):
    """The same filter, told of an input that is always 1."""
    faults, options = deepcopy(CASES[case][1]), deepcopy(CASES[case][2])
    if "actuator" in faults:
        faults["actuator"]["dependence"] = "independent"
        if "success_rate" in faults["actuator"]:
            faults["actuator"]["success_rate"] = [0.7, 1.0]
        options["hypotheses"] = [[rate, 1.0] for rate in options.pop("hypotheses", ())]
    if "jump" in faults:
        faults["jump"]["modes"] = [driven(mode) for mode in MODES]
        for mode in faults["jump"]["modes"]:
            del mode["x0"], mode["P0"]
    filtering = {"family": CASES[case][0], **{k: v for k, v in options.items() if v}}
    table = {"name": "plant", "model": driven({}), "parameters": {"g": 0.6}}
    return fkgen.Spec.from_dict(table | {"faults": faults, "filter": filtering})


def test_every_family_is_here():
    assert {family for family, *_ in CASES.values()} == set(NAMES)


@pytest.mark.parametrize("case", CASES)
def test_offsets_are_an_input_that_is_always_one(case):
    rng = np.random.default_rng(5)
    y, u = 2.0 * rng.standard_normal((T, 2)), rng.standard_normal((T, 1))
    y[rng.random(y.shape) < 0.2] = np.nan
    params = {"g": rng.uniform(0.4, 0.8, T)}
    if case == "genie":
        params |= {"gamma": (rng.random(T) < 0.6) * 1.0, "delta": rng.choice([1.0, 4.0], T)}
    found = fkgen.build(spec(case)).run(y, u, params)
    expected = fkgen.build(reference(case)).run(y, np.hstack([u, np.ones((T, 1))]), params)
    assert (found.status >= 0).all()
    same = {p for p in found.ports if found[p].shape == expected[p].shape}
    assert {"filtered_state", "predicted_covariance", "innovation", "log_likelihood"} <= same
    errors = {port: distance(found[port], expected[port]) for port in same}
    assert max(errors.values()) <= 1e-9, errors  # the same numbers, added in another order


@pytest.mark.parametrize("case", CASES)
def test_trials_have_the_offsets_too(case):
    law = {"faults": {"sensor": SENSOR | LAW}} if case == "genie" else {}
    stated, other = (each.to_dict() | law for each in (spec(case), reference(case)))
    found = fkgen.simulate(fkgen.Spec.from_dict(stated), 3, T, u=0.5)
    expected = fkgen.simulate(fkgen.Spec.from_dict(other), 3, T, u=[0.5, 1.0])
    assert distance(found.y, expected.y) <= 1e-12


def test_a_stationary_gain_with_offsets_is_where_the_gain_goes():
    model = {key: entry for key, entry in MODEL.items() if key not in "BD"}
    table = {"name": "plant", "model": model | {"A": [[0.5, 0.1], [-0.2, 0.4]]}}
    table["model"] |= {"c": [0.24, -0.3], "d": [0.7, 0.6]}
    modes = [{}, {"c": [2.0, 0.06], "d": [-1.0, 0.2]}, {"c": [0, 0]}]
    table["faults"] = {"jump": JUMP | {"modes": modes, "arrival_rate": 0.8}}
    runs = []
    y = 2.0 * np.random.default_rng(6).standard_normal((200, 2))
    for gain in ("stationary", "time_varying"):
        table["filter"] = {"family": "mjls_lmmse", "gain": gain}
        runs.append(fkgen.build(fkgen.Spec.from_dict(table)).run(y))
    constant, varying = runs
    assert distance(constant.filtered_state[150:], varying.filtered_state[150:]) <= 1e-9


@pytest.mark.parametrize(
    ("key", "given", "expected"),
    [
        ("c", [1.0], "model.c: expected a list of 2 numbers or expressions"),
        ("d", [1.0, "h"], "model.d[1]"),
        ("d", [1.0, float("inf")], "model.d[1]"),
        ("c", 3.0, "model.c"),
    ],
)
def test_what_is_no_offset_is_refused_where_it_stands(key, given, expected):
    with pytest.raises(fkgen.SpecError) as fault:
        spec("kf", model=MODEL | {key: given})
    assert fault.value.key.startswith(f"model.{key}")
    assert "\n" not in str(fault.value)


def test_a_filter_without_a_constant_term_says_so():
    model = {key: entry for key, entry in MODEL.items() if key not in "BDc"}
    model["x0"] = [0.0, 0.0]
    with pytest.raises(fkgen.SpecError, match="the filter has no constant term") as fault:
        spec("linear_optimal", model=model, faults={"sensor": SENSOR | LAW})
    assert fault.value.key == "model.d"


def test_offsets_survive_a_round_trip_and_zeros_are_not_written():
    stated = spec("imm of plants")
    assert fkgen.Spec.from_dict(stated.to_dict()) == stated
    table = spec("kf", model=MODEL | {"c": [0, 0]}).to_dict()
    assert "c" not in table["model"]
    assert table["model"]["d"] == [0.7, "g"]
