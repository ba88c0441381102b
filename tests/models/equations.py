"""Specs with equations, and a family that takes them but builds nothing."""

from __future__ import annotations

from functools import partial

import numpy as np

import fkgen
from fkgen.families.family import Family, built_by, proved_by
from fkgen.faults.jump import read_jump_faults
from fkgen.faults.sensor import read_sensor_faults
from fkgen.problem.filter import Traits

FAMILY = Family(
    name="reads_only",
    title="takes any plant; to be read, not built",
    build=built_by("lmmse.kalman:linear_filter", source="none"),
    proof=proved_by("gaussian", "BATCH"),
    traits=Traits(nonlinear=True, correlated=True),
    accepts={"sensor": partial(read_sensor_faults, law="optional"), "jump": read_jump_faults},
    optional_faults=True,
)

ROBOT = {
    "states": [
        {"name": "x", "unit": "m"},
        {"name": "y", "unit": "m"},
        {"name": "heading", "unit": "rad", "wrap": True},
    ],
    "inputs": [{"name": "speed"}, {"name": "turn"}],
    "outputs": [{"name": "range", "unit": "m"}, {"name": "bearing", "unit": "rad", "wrap": True}],
    "noises": [{"name": "w_turn", "variance": "0.01**2"}],
    "R": [[0.01, 0.0], [0.0, 0.0004]],
    "x0": [3.0, 4.0, 0.1],
    "P0": np.diag([1.0, 1.0, 0.1]).tolist(),
    "let": {"c": "cos(heading)"},
    "f": {
        "x": "x + speed*c*dt",
        "y": "y + speed*sin(heading)*dt",
        "heading": "heading + (turn + w_turn)*dt",
    },
    "h": {"range": "hypot(x, y)", "bearing": "atan2(y, x) - heading"},
}

ATTITUDE = {
    "states": [{"name": "q", "manifold": "SO3"}, *({"name": f"b{i}"} for i in "xyz")],
    "inputs": [{"name": f"g{i}"} for i in "xyz"],
    "outputs": [{"name": f"a{i}"} for i in "xyz"],
    "Q": np.diag([1e-4] * 3 + [1e-8] * 3).tolist(),
    "R": np.diag([0.01] * 3).tolist(),
    "x0": [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    "P0": np.diag([0.1] * 3 + [0.01] * 3).tolist(),
    "let": {
        "b": "[bx, by, bz]",
        "rate": "([gx, gy, gz] - b)*dt",
        "a": "rotate_back(q, [0, 0, 9.81])",
    },
    "f": {"q": "q * rate"},
    "h": {"ax": "a[0]", "ay": "a[1]", "az": "a[2]"},
}


def table(model, parameters=None, family="equations:FAMILY", **sections):
    parameters = {"dt": 0.1} if parameters is None else parameters
    return {
        "name": "plant",
        "model": model,
        "parameters": parameters,
        "filter": {"family": family},
        **sections,
    }


def read(model, parameters=None, **sections):
    family = sections.pop("family", "equations:FAMILY")
    return fkgen.Spec.from_dict(table(model, parameters, family, **sections))
