"""Laws of faults with parameters p and q, and the same with numbers in their place."""

from __future__ import annotations

import numpy as np

import fkgen

MODEL = {
    "A": [[1.0, 0.1], [0.0, 0.95]],
    "C": [[1.0, 0.0], [0.0, 1.0]],
    "Q": [[0.1, 0.0], [0.0, 0.1]],
    "R": [[0.5, 0.1], [0.1, 0.3]],
    "x0": [0.0, 0.0],
    "P0": [[1.0, 0.0], [0.0, 1.0]],
}
START = [0.7, 0.1, 0.1, 0.1]
LAST = [[0.2, 0.6, 0.1, 0.1], [0.3, 0.1, 0.5, 0.1], [0.2, 0.2, 0.2, 0.4]]

#: Laws of a sensor with parameters p = 0.8, q = 0.1, and with these numbers in their place.
SENSOR = {
    "1": (
        {"problem": 1, "gamma_rate": "p", "delta_nominal_rate": "1 - q"},
        {"problem": 1, "gamma_rate": 0.8, "delta_nominal_rate": 0.9},
    ),
    "2": (
        {"problem": 2, "joint": ["p - q", "q", 0.15, "0.85 - p"]},
        {"problem": 2, "joint": [0.7, 0.1, 0.15, 0.05]},
    ),
    "3": (
        {
            "problem": 3,
            "gamma_chain": [["p", "1 - p"], ["q", "1 - q"]],
            "delta_chain": [[0.9, 0.1], ["p/2", "1 - p/2"]],
            "initial": START,
        },
        {
            "problem": 3,
            "gamma_chain": [[0.8, 0.2], [0.1, 0.9]],
            "delta_chain": [[0.9, 0.1], [0.4, 0.6]],
            "initial": START,
        },
    ),
    "4": (
        {"problem": 4, "kernel": [["p", "q", "0.9 - p", "0.1 - q"], *LAST], "initial": START},
        {"problem": 4, "kernel": [[0.8, 0.1, 0.1, 0.0], *LAST], "initial": START},
    ),
}
MODES = [{}, {"Q": [[1.0, 0.0], [0.0, 2.0]]}, {"A": [[0.9, 0.1], [0.0, 0.8]]}]
JUMP = (
    {"transition": [["p", "1 - p", 0.0], ["q", 0.7, "0.3 - q"], [0.3, 0.3, 0.4]]},
    {"transition": [[0.8, 0.2, 0.0], [0.1, 0.7, 0.2], [0.3, 0.3, 0.4]]},
)
ARRIVALS = (
    {"arrival_chain": [["1 - p", "p"], ["q", "1 - q"]]},
    {"arrival_chain": [[0.2, 0.8], [0.1, 0.9]]},
)
RATE = {"arrival_rate": "p"}, {"arrival_rate": 0.8}


def spec(family, faults, options=None, scalar="double", model=MODEL, **parameters):
    return fkgen.Spec.from_dict(
        {
            "name": "plant",
            "model": model,
            "parameters": parameters,
            "faults": faults,
            "filter": {"family": family, **(options or {})},
            "code": {"scalar": scalar},
        }
    )


def record(T=14):
    rng = np.random.default_rng(4)
    y = rng.normal(size=(T, 2))
    y[4], y[6, 1] = np.nan, np.nan
    return y


def ports_of(result):
    """Every port but logarithms, which hold another large number for log 0."""
    return [port for port in result.ports if "log_weight" not in port and "evidence" not in port]
