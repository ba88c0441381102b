"""Specs that are right: what they hold, that they are values, that they survive a round trip."""

from __future__ import annotations

import copy
import dataclasses
import json
import pickle
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fkgen.problem import Name, Number, Signal, Spec

MODEL: dict[str, Any] = {
    "A": [[0.98, -0.0002], [0.0094, "exp(-0.01/tau)"]],
    "C": [[0.0, 1.0]],
    "Q": [[1e-6, 0], [0, 1e-6]],
    "R": [[1e-4]],
    "x0": [0, 0],
    "P0": [[1, 0], [0, 1]],
}
KF: dict[str, Any] = {
    "name": "motor",
    "model": MODEL,
    "parameters": {"tau": 0.05},
    "filter": {"family": "kf"},
}
ONE, TWO = [[0.02], [0.0001]], [[1.0, 0.0], [0.0, 1.0]]


def faulty(B: object, family: str, actuator: dict[str, Any], **options: object) -> Spec:
    table = {
        **KF,
        "model": {**MODEL, "B": B},
        "faults": {"actuator": actuator},
        "filter": {"family": family, **options},
    }
    return Spec.from_dict(table)


COV = [[0.21, 0.1], [0.1, 0.24]]
SPECS = {
    "kf": Spec.from_dict(KF),
    "kf with input": Spec.from_dict({**KF, "model": {**MODEL, "B": ONE, "D": [["tau"]]}}),
    "mkf": faulty(ONE, "mkf", {"success_rate": 0.7}),
    "mkf parametric": faulty(ONE, "mkf", {"success_rate": "1 - tau"}),
    "mkf common": faulty(TWO, "mkf", {"success_rate": 0.7, "dependence": "common"}),
    "mkf independent": faulty(
        TWO, "mkf", {"success_rate": [0.7, 0.6], "dependence": "independent"}
    ),
    "mkf covariance": faulty(TWO, "mkf", {"success_rate": [0.7, 0.6], "covariance": COV}),
    "mme": faulty(ONE, "mme", {}, hypotheses=[0.1, 0.5, 0.9]),
    "mme rate": faulty(
        ONE, "mme", {"success_rate": 0.5}, hypotheses=[[0.1]], likelihood="gaussian"
    ),
    "mme independent": faulty(
        TWO,
        "mme",
        {"dependence": "independent"},
        hypotheses=[[0.1, 0.2], 0.5],
        prior=[0.25, 0.75],
        weight_floor=0,
    ),
    "code": Spec.from_dict({**KF, "code": {"scalar": "float", "update": "joseph"}}),
    "clock": Spec.from_dict(
        {
            **KF,
            "model": {**MODEL, "sample_time": "tau"},
            "record": {"columns": {"tau": "Abtastzeit [s]"}, "time": "Zeit"},
        }
    ),
    "named": Spec.from_dict(
        {
            **KF,
            "model": {
                **MODEL,
                "sample_time": 1,
                "states": [{"name": "current", "unit": "A"}, {"name": "speed", "unit": "rad/s"}],
                "outputs": [{"name": "speed"}],
            },
        }
    ),
}
EVERY = pytest.mark.parametrize("spec", SPECS.values(), ids=SPECS)


@EVERY
def test_round_trip(spec: Spec) -> None:
    again = Spec.from_dict(spec.to_dict())
    assert again == spec
    assert hash(again) == hash(spec)
    assert again.canonical() == spec.canonical()
    assert again.to_dict() == spec.to_dict()


@EVERY
def test_a_dict_of_a_spec_is_plain(spec: Spec) -> None:
    assert json.loads(json.dumps(spec.to_dict())) == spec.to_dict()
    assert json.loads(spec.canonical())["name"] == "motor"


@EVERY
def test_specs_can_be_pickled_and_copied(spec: Spec) -> None:
    assert pickle.loads(pickle.dumps(spec)) == spec  # noqa: S301 - our own bytes
    assert copy.deepcopy(spec) == spec


def test_different_specs_have_different_texts() -> None:
    assert len({spec.canonical() for spec in SPECS.values()}) == len(SPECS)
    assert len(set(SPECS.values())) == len(SPECS)


def test_the_text_is_the_same_in_every_process() -> None:
    code = f"from fkgen.problem import Spec; print(Spec.from_dict({KF!r}).canonical())"
    texts = {
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        ).stdout.strip()
        for _ in range(2)
    }
    assert texts == {SPECS["kf"].canonical()}


def test_the_order_of_keys_and_the_file_do_not_count() -> None:
    table = {key: KF[key] for key in reversed(KF)}
    table["model"] = {key: MODEL[key] for key in reversed(MODEL)}
    other = Spec.from_dict(table, file="other.toml")
    assert other == SPECS["kf"]
    assert other.canonical() == SPECS["kf"].canonical()
    assert other.file == "other.toml"


def test_the_order_of_parameters_counts() -> None:
    first = Spec.from_dict({**KF, "parameters": {"tau": 1.0, "k": 2.0}})
    second = Spec.from_dict({**KF, "parameters": {"k": 2.0, "tau": 1.0}})
    assert first != second
    assert first.canonical() != second.canonical()
    assert first.defaults == second.defaults


def test_a_spec_is_frozen() -> None:
    spec = SPECS["kf"]
    for value in (spec, spec.model, spec.faults, spec.filter, spec.code, spec.parameters[0]):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(value, dataclasses.fields(value)[0].name, None)


def test_the_dict_is_neither_changed_nor_kept() -> None:
    table = copy.deepcopy(SPECS["mme independent"].to_dict())
    before = copy.deepcopy(table)
    spec = Spec.from_dict(table)
    assert table == before
    table["model"]["A"][0][0] = 7.0  # type: ignore[index]
    table["filter"]["hypotheses"][0][0] = 0.9  # type: ignore[index]
    assert spec == SPECS["mme independent"]


def test_what_is_left_out() -> None:
    spec = SPECS["kf"]
    assert (spec.model.nx, spec.model.nu, spec.model.ny) == (2, 0, 1)
    assert spec.model.B.shape == (2, 0)
    assert spec.model.D.shape == (1, 0)
    assert spec.model.x0.shape == (2, 1)
    assert spec.model.sample_time is None
    assert spec.model.states == (Signal("x0", ""), Signal("x1", ""))
    assert spec.model.inputs == ()
    assert spec.model.outputs == (Signal("y0", ""),)
    assert spec.faults.actuator is None
    assert (spec.code.scalar, spec.code.update) == ("double", "auto")
    assert spec.file == "<dict>"
    np.testing.assert_array_equal(SPECS["mkf"].model.D.values(), [[0.0]])


def test_names_and_units() -> None:
    model = SPECS["named"].model
    assert model.states == (Signal("current", "A"), Signal("speed", "rad/s"))
    assert model.outputs == (Signal("speed", ""),)
    assert model.sample_time == 1.0
    assert isinstance(model.sample_time, float)


def test_actuator_faults() -> None:
    def actuator(name: str) -> Any:
        return SPECS[name].faults.actuator

    assert actuator("mkf").success_rate == (Number(0.7),)
    assert actuator("mkf").dependence == "common"
    assert actuator("mkf common").success_rate == (Number(0.7),)
    assert actuator("mkf independent").success_rate == (Number(0.7), Number(0.6))
    assert actuator("mkf independent").covariance is None
    assert actuator("mkf covariance").dependence == "covariance"
    np.testing.assert_array_equal(actuator("mkf covariance").covariance.values(), COV)
    assert actuator("mme").success_rate == ()
    assert actuator("mme").dependence == "common"
    assert actuator("mme independent").dependence == "independent"


@pytest.mark.parametrize(
    "actuator",
    [
        {"success_rate": 0.7, "dependence": "independent"},
        {"success_rate": [0.7], "dependence": "common"},
        {"success_rate": [0.7], "covariance": [[0.21]]},
        {"success_rate": "0.7", "dependence": "covariance", "covariance": [[0.21]]},
    ],
)
def test_with_one_input_faults_are_common(actuator: dict[str, Any]) -> None:
    assert faulty(ONE, "mkf", actuator) == SPECS["mkf"]


def test_one_rate_is_a_rate_for_every_input() -> None:
    scalar = faulty(TWO, "mkf", {"success_rate": "tau", "dependence": "independent"})
    listed = faulty(TWO, "mkf", {"success_rate": ["tau", "tau"], "dependence": "independent"})
    assert scalar == listed
    assert scalar.faults.actuator is not None
    assert scalar.faults.actuator.success_rate == (Name("tau"), Name("tau"))
    common = faulty(TWO, "mkf", {"success_rate": [0.7, 0.7], "dependence": "common"})
    assert common == SPECS["mkf common"]


@pytest.mark.parametrize("rate", [0, 1, 0.0, 1.0])
def test_sure_success_and_sure_failure_are_legal(rate: float) -> None:
    faulty(ONE, "mkf", {"success_rate": rate})
    faulty(ONE, "mme", {}, hypotheses=[rate])
    joint = [[rate * (1 - rate)] * 2] * 2
    faulty(TWO, "mkf", {"success_rate": rate, "covariance": joint})


def test_filter_options() -> None:
    default = SPECS["mme"].filter.options
    assert default.hypotheses == ((0.1,), (0.5,), (0.9,))
    assert default.prior == (1 / 3, 1 / 3, 1 / 3)
    assert default.weight_floor == 1e-6
    assert default.likelihood == "mixture"
    stated = SPECS["mme independent"].filter.options
    assert stated.hypotheses == ((0.1, 0.2), (0.5, 0.5))
    assert stated.prior == (0.25, 0.75)
    assert stated.weight_floor == 0.0


def test_ten_thirds_of_a_prior_are_one_within_rounding() -> None:
    faulty(ONE, "mme", {}, hypotheses=[0.1] * 10, prior=[0.1] * 10)
    faulty(ONE, "mme", {}, hypotheses=[0.1, 0.2], prior=np.array([0.5, 0.5 + 5e-10]))
    faulty(ONE, "mme", {}, hypotheses=np.array([[0.1], [0.2]]))
    faulty(TWO, "mme", {"dependence": "independent"}, hypotheses=[np.array([0.1, 0.2])])


def test_noise_may_be_given_by_its_factors() -> None:
    model = {key: value for key, value in MODEL.items() if key not in {"Q", "R"}}
    model |= {"F": [[1.0], ["tau"]], "V": [[4.0]], "G": [[2.0, 1.0]]}
    model = Spec.from_dict({**KF, "model": model}).model
    np.testing.assert_allclose(model.Q.values({"tau": 0.5}), [[4.0, 2.0], [2.0, 1.0]], rtol=1e-15)
    np.testing.assert_allclose(model.R.values(), [[5.0]], rtol=1e-15)
    assert model.Q.rows[0][1] == model.Q.rows[1][0]


@given(n=st.integers(1, 6), m=st.integers(1, 6), seed=st.integers(0, 2**32 - 1))
def test_factors_give_the_covariance(n: int, m: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    F, root = rng.normal(size=(n, m)), rng.normal(size=(m, m))
    V = root @ root.T
    table = {
        "name": "plant",
        "model": {
            "A": np.eye(n),
            "C": np.ones((1, n)),
            "R": [[1]],
            "x0": np.zeros(n),
            "P0": np.eye(n),
            "F": F,
            "V": V,
        },
        "filter": {"family": "kf"},
    }
    spec = Spec.from_dict(table)
    expected = F @ V @ F.T
    np.testing.assert_allclose(
        spec.model.Q.values(), expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max()
    )
    assert Spec.from_dict(spec.to_dict()) == spec


def test_a_large_dense_parametric_factor_survives_the_round_trip() -> None:
    n = 12
    F = [[f"sin({i} + {j}*tau)" for j in range(n)] for i in range(n)]
    model = {"A": np.eye(n), "C": np.ones((1, n)), "R": [[1]], "x0": [0] * n, "P0": np.eye(n)}
    spec = Spec.from_dict({**KF, "model": {**model, "F": F}})
    assert Spec.from_dict(spec.to_dict()) == spec


def test_no_noise_in_the_state_is_fine_beside_a_regular_R() -> None:
    Spec.from_dict({**KF, "model": {**MODEL, "Q": np.zeros((2, 2))}})
    Spec.from_dict({**KF, "model": {**MODEL, "R": [[0.0]]}})


def test_a_bank_over_one_input_needs_no_section_about_its_faults() -> None:
    table = SPECS["mme"].to_dict()
    del table["faults"]
    actuator = Spec.from_dict(table).faults.actuator
    assert actuator is not None
    assert (actuator.success_rate, actuator.dependence) == ((), "common")
