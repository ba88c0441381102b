"""Extended filters that are small and met often, each with the form that is arranged by hand."""

from __future__ import annotations

import equations
import hand_forms
import numpy as np
from hand_forms import Counted

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


def spec_of(name):
    """The spec of one of them."""
    model, parameters, _, _ = CASES[name]
    return equations.read(model, parameters, family="ekf")


def sample_of(spec):
    """Inputs and measurements of one sample."""
    rng = np.random.default_rng(5)
    u = rng.normal(size=(1, spec.model.nu))
    return u, rng.normal(size=(1, spec.model.ny)) + 2.0


def arranged(name):
    """What the form arranged by hand makes of that sample, and its operations."""
    spec, (_, _, by_hand, given) = spec_of(name), CASES[name]
    u, y = sample_of(spec)
    Counted.total = 0
    found = by_hand(spec.model.x0.values().ravel(), spec.model.P0.values(), u[0], y[0], *given)
    return found, Counted.total
