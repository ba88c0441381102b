"""A plant sampled from a spec is the plant of the spec, with the right moments of its faults."""

from __future__ import annotations

import numpy as np
import pytest

from fkgen.errors import DataError
from fkgen.oracle.exact.batch import batch_lmmse
from fkgen.oracle.plants.actuator import LinearSystem, simulate
from fkgen.problem import Spec

MODEL = {
    "A": [["exp(-0.1/tau)", 0.0], [0.1, 0.9]],
    "B": [[1.0, 0.0], ["2*gain", 1.0]],
    "C": [[0.0, 1.0]],
    "D": [[0.5, 0.0]],
    "Q": [[1e-2, 0.0], [0.0, 1e-2]],
    "R": [[1e-1]],
    "x0": [1.0, -1.0],
    "P0": [[1.0, 0.2], [0.2, 2.0]],
}
PARAMETERS = {"tau": 0.5, "gain": 1.5}


def spec(actuator, *, family="mkf", **options):
    faults = {} if actuator is None else {"faults": {"actuator": actuator}}
    return Spec.from_dict(
        {
            "name": "plant",
            "model": MODEL,
            "parameters": PARAMETERS,
            **faults,
            "filter": {"family": family, **options},
        }
    )


def test_defaults_hold_where_nothing_is_given():
    system = LinearSystem.from_spec(spec(None, family="kf"), 3)
    assert system.A.shape == (3, 2, 2)
    np.testing.assert_allclose(system.A[2], [[np.exp(-0.2), 0.0], [0.1, 0.9]], rtol=1e-15)
    np.testing.assert_array_equal(system.B[0], [[1.0, 0.0], [3.0, 1.0]])
    np.testing.assert_array_equal(system.x0, [1.0, -1.0])
    np.testing.assert_array_equal(system.rate, 1.0)
    np.testing.assert_array_equal(system.fault_covariance, 0.0)


def test_parameters_may_be_numbers_or_records():
    tau = np.array([0.5, 1.0, 0.5, 2.0])
    system = LinearSystem.from_spec(spec(None, family="kf"), 4, {"tau": tau, "gain": 2.0})
    np.testing.assert_allclose(system.A[:, 0, 0], np.exp(-0.1 / tau), rtol=1e-15)
    np.testing.assert_array_equal(system.B[:, 1, 0], 4.0)


@pytest.mark.parametrize(
    ("actuator", "rate", "covariance"),
    [
        ({"success_rate": 0.7, "dependence": "common"}, [0.7, 0.7], [[0.21, 0.21], [0.21, 0.21]]),
        (
            {"success_rate": 0.7, "dependence": "independent"},
            [0.7, 0.7],
            [[0.21, 0.0], [0.0, 0.21]],
        ),
        (
            {"success_rate": [0.7, 0.4], "dependence": "independent"},
            [0.7, 0.4],
            [[0.21, 0.0], [0.0, 0.24]],
        ),
        (
            {"success_rate": [0.7, 0.4], "covariance": [[0.21, 0.1], [0.1, 0.24]]},
            [0.7, 0.4],
            [[0.21, 0.1], [0.1, 0.24]],
        ),
    ],
)
def test_the_dependence_decides_the_covariance_of_the_faults(actuator, rate, covariance):
    system = LinearSystem.from_spec(spec(actuator), 2)
    # xi (1 - xi) rounds in the last digit.
    np.testing.assert_allclose(system.rate, [rate, rate], rtol=1e-15)
    np.testing.assert_allclose(system.fault_covariance, [covariance, covariance], rtol=1e-14)


def test_the_success_rate_may_change_with_a_parameter():
    actuator = {"success_rate": "gain/10", "dependence": "common"}
    system = LinearSystem.from_spec(spec(actuator), 2, {"gain": np.array([5.0, 10.0])})
    np.testing.assert_array_equal(system.rate, [[0.5, 0.5], [1.0, 1.0]])
    np.testing.assert_array_equal(system.fault_covariance[:, 0, 1], [0.25, 0.0])


@pytest.mark.parametrize(
    ("dependence", "hypothesis", "off_diagonal"),
    [("common", (0.3,), 0.21), ("independent", (0.3, 0.3), 0.0)],
)
def test_a_hypothesis_takes_the_place_of_the_rate(dependence, hypothesis, off_diagonal):
    unknown = spec({"dependence": dependence}, family="mme", hypotheses=[0.3, 0.6])
    system = LinearSystem.from_spec(unknown, 2, rates=hypothesis)
    np.testing.assert_allclose(system.rate, 0.3, rtol=1e-15)
    np.testing.assert_allclose(system.fault_covariance[0, 0], [0.21, off_diagonal], rtol=1e-14)
    with pytest.raises(DataError, match="success rate"):
        LinearSystem.from_spec(unknown, 2)


def test_a_plant_without_inputs_needs_no_u():
    model = {name: MODEL[name] for name in ("A", "C", "Q", "R", "x0", "P0")}
    kalman = Spec.from_dict(
        {"name": "plant", "model": model, "parameters": PARAMETERS, "filter": {"family": "kf"}}
    )
    system = LinearSystem.from_spec(kalman, 4)
    assert system.nu == 0
    y = simulate(system, None, np.random.default_rng(1))
    assert batch_lmmse(system, y, None).filtered_state.shape == (4, 2)
