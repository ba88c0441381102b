"""Specs of filters for faulty sensors: laws of the modes, plants, records, textbook answers."""

from __future__ import annotations

from functools import cache

import numpy as np
from imm_plants import ALIKE, any_modes, jumping
from plants import PARAMETERS, VARYING, random_model, run

import fkgen
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.plants.sensor import SensorLaw, simulate_sensor
from fkgen.oracle.textbook.switching import textbook_imm, textbook_one_step

#: The plant of sec. VI, without its law.
SCALAR = {
    "A": [[-0.8]],
    "C": [[1.0]],
    "Q": [[1.0]],
    "R": [[1.0]],
    "x0": [0.0],
    "P0": [[0.0]],
}

#: Family and options of every filter that weighs modes.
SWITCHING = {
    "one_step": {"family": "one_step"},
    "weighted": {"family": "one_step", "covariance": "weighted"},
    "paper": {"family": "one_step", "covariance": "paper"},
    "paper_nominal": {"family": "one_step", "covariance": "paper_nominal"},
    "imm": {"family": "imm"},
    "imm3": {"family": "imm", "modes": 3},
}
MATCHED = ("one_step", "imm")

#: Kernels: dense, with zeros, and with zeros so that what comes next is known at times.
DENSE = [
    [0.5, 0.2, 0.2, 0.1],
    [0.1, 0.6, 0.1, 0.2],
    [0.3, 0.1, 0.4, 0.2],
    [0.2, 0.3, 0.1, 0.4],
]
HOLES = [
    [0.7, 0.3, 0.0, 0.0],
    [0.0, 0.4, 0.6, 0.0],
    [0.0, 0.0, 0.5, 0.5],
    [1.0, 0.0, 0.0, 0.0],
]
TURN = np.eye(4)[[2, 0, 3, 1]]

#: gamma chains are ordered (0, 1), delta chains (1, C).
PROBLEMS = {
    "1": {"problem": 1, "gamma_rate": 0.7, "delta_nominal_rate": 0.8},
    "2": {"problem": 2, "joint": [0.5, 0.1, 0.15, 0.25]},
    "3": {
        "problem": 3,
        "gamma_chain": [[0.8, 0.2], [0.3, 0.7]],
        "delta_chain": [[0.9, 0.1], [0.4, 0.6]],
        "initial": [0.1, 0.2, 0.3, 0.4],
    },
    "4": {"problem": 4, "kernel": DENSE, "initial": [0.4, 0.1, 0.2, 0.3]},
    "zeros": {"problem": 4, "kernel": HOLES, "initial": [0.5, 0.0, 0.5, 0.0]},
}

#: Two double computations: roundings of 1e-16 that exponents of some ten multiply.
EXACT = 1e-9


def sensed(model, law, *, family="imm", parameters=None, code=None, **options):
    """A spec; ``law`` is the table faults.sensor, with a noise factor of 10 unless it says so."""
    table = {
        "name": "plant",
        "model": {key: np.asarray(value).tolist() for key, value in model.items()},
        "parameters": parameters or {},
        "code": code or {},
        "faults": {"sensor": {"noise_factor": 10.0, **law}},
        "filter": {"family": family, **options},
    }
    return fkgen.Spec.from_dict(table)


def chain(kernel, initial, **others):
    """The table of problem 4."""
    given = {"kernel": np.asarray(kernel).tolist(), "initial": np.asarray(initial).tolist()}
    return {"problem": 4, **given, **others}


def product(gamma, delta, *, initial=None, **others):
    """The table of problem 3; ``initial`` are Pr(gamma = 1) and Pr(delta = 1) at sample 0."""
    law = {"problem": 3, "gamma_chain": gamma, "delta_chain": delta, **others}
    if initial is not None:
        g, d = initial
        law["initial"] = [g * d, g * (1 - d), (1 - g) * d, (1 - g) * (1 - d)]
    return law


def centred(model):
    """The plant without known inputs and with a prior of mean zero."""
    kept = {key: value for key, value in model.items() if key not in {"B", "D"}}
    return kept | {"x0": np.zeros(len(model["x0"])).tolist()}


#: Laws with all kinds of columns: full, proportional, with one source, with some.
KINDS = {
    "one_step": ("4", {}),
    "one_step_paper": ("3", {"family": "one_step", "covariance": "paper"}),
    "one_step_nominal": ("2", {"family": "one_step", "covariance": "paper_nominal"}),
    "imm": ("4", {}),
    "imm_zeros": ("zeros", {"family": "imm"}),
    "imm_product": ("3", {"family": "imm"}),
    "imm_white": ("2", {"family": "imm"}),
    "imm3": ("3", {"family": "imm", "modes": 3}),
    "linear_optimal": ("1", {}),
    "linear_absorbing": ("absorbing", {"family": "linear_optimal"}),
    "linear_moments": ("moments", {"family": "linear_optimal"}),
    "augmented": ("3", {"family": "linear_optimal", "form": "augmented"}),
    "genie": ("genie", {}),
}
EVERY = (*KINDS, "imm_jump")
#: Those with inputs; for the others (23) has no constant term.
DRIVEN = tuple(name for name in KINDS if name not in {"linear_absorbing", "linear_moments"})


@cache
def every(scalar="double"):
    """One spec of every kind by name: inputs, D, correlated rows of which one fails."""
    model = random_model(71, 2, 2, 1, direct=True, correlated=True)
    laws = PROBLEMS | {
        "absorbing": product([[0.7, 0.3], [0.0, 1.0]], [[0.8, 0.2]] * 2, initial=(0.2, 0.8)),
        "moments": {
            "problem": "moments",
            "gamma_rate": 0.55,
            "gamma_persistence": 0.8,
            "delta_nominal_rate": 0.8,
        },
        "genie": {},
    }
    result = {}
    for name, (law, options) in KINDS.items():
        rows = {"rows": [0]} if name in DRIVEN else {}
        plant = model if name in DRIVEN else centred(model)
        chosen = {"family": name} | options
        result[name] = sensed(plant, laws[law] | rows, code={"scalar": scalar}, **chosen)
    modes = any_modes(71, 2, 2, 1)
    result["imm_jump"] = jumping(model, modes, transition=ALIKE, code={"scalar": scalar})
    return result


def shaken(T, seed=3):
    """Parameters of the plant `VARYING` that change in every sample."""
    rng = np.random.default_rng(seed)
    return {"dt": rng.uniform(0.05, 0.4, T), "angle": rng.uniform(-1.0, 1.0, T)}


def varying(law, **options):
    return sensed(VARYING, law, parameters=PARAMETERS, **options)


def seen(spec, T, *, seed=1, missing=0.0, params=None):
    """What the plant of a spec answers to random inputs: (y, u, modes)."""
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((T, spec.model.nu))
    system = LinearSystem.from_spec(spec, T, params)
    y, modes = simulate_sensor(system, SensorLaw.from_spec(spec), u, rng)
    y[rng.random(y.shape) < missing] = np.nan
    return y, u, modes


def textbook(spec, y, u, params=None):
    """The matrix filter of the same name."""
    system, law = LinearSystem.from_spec(spec, len(y), params), SensorLaw.from_spec(spec)
    if spec.filter.family == "imm":
        return textbook_imm(system, law, y, u, modes=spec.filter.options.modes)
    return textbook_one_step(system, law, y, u, covariance=spec.filter.options.covariance)


def final(spec, y, port, u=None):
    """The last value of a port."""
    return run(spec, y, u)[port][-1]


def plane(seed=31, **changes):
    """Two states seen by two rows with correlated noise, without inputs, from (0, P0)."""
    return centred(random_model(seed, 2, 2, correlated=True)) | changes
