"""Steps of extended filters take no more operations than those that are arranged by hand."""

from __future__ import annotations

import equations
import hand_forms
import numpy as np
import pytest
from hand_forms import Counted

import fkgen
from fkgen.backend.lower import lower
from fkgen.families import family

#: Attitude and gyro bias, with three noises of the gyro, gravity and a magnetic field.
SENSORS = equations.ATTITUDE | {
    "inputs": [{"name": f"g{i}"} for i in "xyz"],
    "outputs": [{"name": f"{of}{i}"} for of in "am" for i in "xyz"],
    "noises": [{"name": f"n{i}", "variance": "1e-4"} for i in "xyz"],
    "Q": np.diag([0.0] * 3 + [1e-8] * 3).tolist(),
    "R": np.diag([0.01] * 3 + [0.02] * 3).tolist(),
    "let": {
        "rate": "([gx + nx, gy + ny, gz + nz] - [bx, by, bz])*dt",
        "a": "rotate_back(q, [0, 0, 9.81])",
        "m": "rotate_back(q, [0.4, 0, -0.9])",
    },
    "h": {f"{of}{i}": f"{of}[{k}]" for of in "am" for k, i in enumerate("xyz")},
}
BATTERY = {
    "states": [{"name": "soc"}, {"name": "v1"}, {"name": "r0"}],
    "inputs": [{"name": "i"}],
    "outputs": [{"name": "v"}],
    "Q": np.diag([1e-8, 1e-6, 1e-9]).tolist(),
    "R": [[1e-4]],
    "x0": [0.7, 0.0, 0.01],
    "P0": np.diag([0.05, 1e-3, 1e-5]).tolist(),
    "f": {
        "soc": "soc - i*dt/capacity",
        "v1": "exp(-dt/tau)*v1 + r1*(1 - exp(-dt/tau))*i",
    },
    "h": {"v": "3 + 1.2*soc - 0.7*soc**2 + 0.5*soc**3 - v1 - r0*i"},
}
CELL = {"dt": 1.0, "capacity": 3600.0, "tau": 30.0, "r1": 0.02}
CASES = {
    "robot": (equations.ROBOT, {"dt": 0.1}, hand_forms.robot, (0.1, 1e-4, (0.01, 0.0004))),
    "attitude": (SENSORS, {"dt": 0.1}, hand_forms.attitude,
                 (0.1, (1e-4, 1e-8), np.diag(SENSORS["R"]))),
    "battery": (BATTERY, CELL, hand_forms.battery, (CELL, (1e-8, 1e-6, 1e-9), 1e-4)),
}  # fmt: skip
FACTOR = 1.10


def plain(value, p):
    if isinstance(value, dict):
        return np.array([[value[max(i, j), min(i, j)].value for j in range(p)] for i in range(p)])
    if isinstance(value, list):
        return np.array([each.value for each in value])
    return value.value if isinstance(value, Counted) else value


@pytest.mark.parametrize("name", CASES)
def test_a_step_takes_at_most_a_tenth_more_operations_than_by_hand(name):
    model, parameters, by_hand, given = CASES[name]
    spec = equations.read(model, parameters, family="ekf")
    rng = np.random.default_rng(5)
    u = rng.normal(size=(1, spec.model.nu))
    y = rng.normal(size=(1, spec.model.ny)) + 2.0
    run = fkgen.build(spec).run(y, u)
    Counted.total = 0
    found = by_hand(spec.model.x0.values().ravel(), spec.model.P0.values(), u[0], y[0], *given)
    operations = Counted.total
    found["innovation_covariance"] = found.pop("S")
    for port, value in found.items():
        expected = plain(value, spec.model.ny)
        np.testing.assert_allclose(run[port][0], expected, rtol=1e-11, atol=1e-13, err_msg=port)
    assert set(found) == set(run.ports)
    program = lower(family("ekf").build(spec))
    assert sum(program.operations.values()) <= FACTOR * operations
