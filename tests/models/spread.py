"""Specs that together use everything that can be generated."""

from __future__ import annotations

from functools import cache

import numpy as np
from plants import (
    MOTOR,
    PARAMETERS,
    SENSED,
    VARYING,
    common,
    independent,
    motor,
    random_model,
    record,
    spec,
)
from soft_plants import soft

TWO = random_model(71, 3, 2, 2, direct=True, correlated=True)
TWO_ALONE = random_model(74, 3, 2, 2, direct=True)
THREE_ALONE = random_model(75, 2, 3, 2)
EXACT = SENSED | {"R": [[5e-6, 0.0], [0.0, 0.0]]}
#: 33 rows of y, two words of valid bits; few of them see a state, which keeps the code short.
WIDE = random_model(72, 2, 33)
WIDE["C"] = [row if i in {0, 31, 32} else [0.0, 0.0] for i, row in enumerate(WIDE["C"])]
PAIR = {"success_rate": [0.7, 0.4], "covariance": [[0.21, 0.1], [0.1, 0.24]]}
CONSTANT_RATE_OF_X = {
    "A": [["1 - dt", "dt"], [0.0, 1.0]],
    "B": [["dt"], ["gain*dt"]],
    "C": [[1.0, 0.0]],
    "Q": [["dt*q", 0.0], [0.0, "dt*q/2"]],
    "R": [["r"]],
    "x0": [0.0, 1.0],
    "P0": [[1.0, 0.0], [0.0, 1.0]],
}


#: A chain of neighbours, each of which pulls at the next, seen at one end.
LADDER = {
    "A": (0.8 * np.eye(6) + 0.1 * np.eye(6, k=1) - 0.1 * np.eye(6, k=-1)).tolist(),
    "C": np.eye(2, 6).tolist(),
    "Q": (0.1 * np.eye(6)).tolist(),
    "R": np.eye(2).tolist(),
    "x0": [1.0, -1.0, 0.5, 0.0, 2.0, 0.0],
    "P0": np.eye(6).tolist(),
}


@cache
def specs(scalar="double"):
    """Specs by name."""
    code = {"scalar": scalar}
    bank = {"actuator": {"dependence": "common"}, "hypotheses": [0.3, 0.7]}
    apart = {"actuator": {"dependence": "independent"}, "hypotheses": [[0.3, 0.9], 0.7]}
    arithmetic = {"dt": 0.1, "gain": 2.0, "q": 0.3, "r": 0.5}
    return {
        "kf": motor("kf", code=code),
        "kf_joseph": motor("kf", code=code | {"update": "joseph"}),
        "kf_correlated": spec(TWO, family="kf", code=code),
        "kf_no_input": spec(random_model(73, 4, 3), family="kf", code=code),
        "kf_functions": spec(VARYING, family="kf", parameters=PARAMETERS, code=code),
        "kf_arithmetic": spec(CONSTANT_RATE_OF_X, family="kf", parameters=arithmetic, code=code),
        "kf_exact": spec(EXACT, family="kf", code=code),
        "kf_wide": spec(WIDE, family="kf", code=code),
        "kf_dense": spec(random_model(75, 16, 4, correlated=True), family="kf", code=code),
        "kf_sparse": spec(LADDER, family="kf", code=code | {"form": "loops"}),
        "dfcf": soft(TWO_ALONE, host=[1], window=2, code=code),
        "dfcf_joseph": soft(TWO_ALONE, window=3, reacquire=1, code=code | {"update": "joseph"}),
        "dfcf_groups": soft(THREE_ALONE, window=3, groups=[[2], [1]], reacquire=2, code=code),
        "dfcf_ud": soft(
            THREE_ALONE, window=3, groups=[[2], [1]], reacquire=1, code=code | {"update": "ud"}
        ),
        "compression_full": soft(TWO, family="compression_full", host=[], window=3, code=code),
        "cpcf": soft(TWO_ALONE, family="cpcf", host=[1], window=2, code=code),
        "cpcf_paper": soft(
            THREE_ALONE, family="cpcf", window=3, maintenance="paper", reacquire=1, code=code
        ),
        "mkf": motor("mkf", code=code),
        "mkf_certain": motor("mkf", actuator=common(1.0), code=code),
        "mkf_sensed": motor("mkf", SENSED, code=code),
        "mkf_exact": motor("mkf", EXACT, code=code),
        "mkf_rate": motor("mkf", SENSED, actuator=common("xi"), parameters={"xi": 0.7}, code=code),
        "mkf_independent": spec(TWO, family="mkf", actuator=independent([0.7, 0.4]), code=code),
        "mkf_correlated": spec(TWO, family="mkf", actuator=PAIR, code=code),
        "mme": motor("mme", code=code),
        "mme_speed": motor("mme", MOTOR, weight_floor=0.0, code=code),
        "mme_gaussian": motor("mme", likelihood="gaussian", prior=[0.0, *[0.25] * 4], code=code),
        "mme_one": motor("mme", hypotheses=[0.7], code=code),
        "mme_certain": motor("mme", hypotheses=[0.0, 0.4, 1.0], code=code),
        "mme_common": spec(TWO, family="mme", code=code, **bank),
        "mme_independent": spec(TWO, family="mme", code=code, **apart),
    }


NAMES = tuple(specs())


def trial(plant, T=8):
    """A record with missing rows, and parameters that change: (y, u, params)."""
    rng = np.random.default_rng(5)
    params = {name: v * rng.uniform(0.9, 1.1, T) for name, v in plant.defaults.items()}
    y, u = record(plant, T, missing=0.2, params=params)
    y[T // 2] = np.nan
    y[T // 2 + 1, 0] = np.nan
    return y, u, params
