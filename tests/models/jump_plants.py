"""Jumping plants that several tests filter: the examples of the literature, random ones by seed."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import numpy as np
from plants import covariance, interpreted

import fkgen
from fkgen.oracle.claims.jump import loss_test, steady_state, unobserved_chain
from fkgen.oracle.plants.jump import JumpSystem, simulate_jumps
from fkgen.oracle.textbook.jump import composite, textbook_jumps

#: Gilbert-Elliott, states ordered (lost, arrived).
GILBERT = [[0.4, 0.6], [0.1, 0.9]]


def kinematic(damping, drift):
    """Position, velocity and acceleration; three modes of manoeuvring, losses in the channel."""
    noise = np.outer([0.5, 1.0, 1.0], [0.5, 1.0, 1.0])
    modes = [
        {
            "A": [[damping[0], 1, 0.5], [0, damping[1], 1], [0, 0, a]],
            "Q": (g**2 * noise).tolist(),
            "R": [[d**2]],
            "c": [0.0, 0.0, c],
        }
        for a, g, d, c in zip((0.6, 0.8, 0.9), (0.1, 0.3, 0.6), (1, 1, 1.5), drift, strict=True)
    ]
    return {
        "name": "target",
        "model": {
            **{key: modes[0][key] for key in ("A", "Q", "R")},
            "C": [[1.0, 0.0, 0.0]],
            "x0": [10.0, 0.0, 0.0],
            "P0": np.diag([1.0, 1.0, 0.1]).tolist(),
        },
        "faults": {
            "jump": {
                "transition": [[0.95, 0.04, 0.01], [0.06, 0.90, 0.04], [0.02, 0.08, 0.90]],
                "initial": [0.6, 0.3, 0.1],
                "modes": modes,
            }
        },
        "filter": {"family": "mjls_lmmse"},
    }


#: Damped; with a drift of the acceleration; undamped, so not mean-square stable.
EXAMPLE_A = kinematic((0.97, 0.80), (0, 0, 0))
EXAMPLE_B = kinematic((0.97, 0.80), (0, 0.15, -0.10))
EXAMPLE_U = kinematic((1.0, 1.0), (0, 0, 0))

#: Scalar, two levels to which it settles.
EXAMPLE_S = {
    "name": "level",
    "model": {
        "A": [[0.9]],
        "C": [[1.0]],
        "Q": [[0.09]],
        "R": [[0.25]],
        "x0": [10.0],
        "P0": [[1.0]],
    },
    "faults": {
        "jump": {
            "transition": [[0.95, 0.05], [0.10, 0.90]],
            "initial": [0.5, 0.5],
            "modes": [{"c": [1.0]}, {"A": [[0.7]], "Q": [[0.36]], "R": [[0.49]], "c": [3.6]}],
        }
    },
    "filter": {"family": "mjls_lmmse"},
}


def changed(table, *, model=None, modes=None, parameters=None, **options):
    """A copy with other entries; options go to ``faults.jump`` or to ``filter``."""
    result = deepcopy(table)
    result["model"] |= model or {}
    if parameters:
        result["parameters"] = parameters
    jump = result["faults"]["jump"]
    given = modes or [{}] * len(jump["modes"])
    jump["modes"] = [mode | more for mode, more in zip(jump["modes"], given, strict=True)]
    for key, value in options.items():
        of_plant = key.startswith("arrival") or key in {"transition", "initial"}
        section = jump if of_plant else result["filter"]
        section[key] = value
    return result


def spec_of(table, **options):
    return fkgen.Spec.from_dict(changed(table, **options))


def random_table(seed, N, n, p, *, q=0, offsets=False, correlated=False):
    """Modes that differ in everything; D if there are inputs."""
    rng = np.random.default_rng(seed)
    modes = []
    for _ in range(N):
        A = rng.standard_normal((n, n))
        mode = {
            "A": rng.uniform(0.6, 1.02) * A / np.abs(np.linalg.eigvals(A)).max(),
            "C": rng.standard_normal((p, n)),
            "Q": covariance(rng, n),
            "R": covariance(rng, p) if correlated else np.diag(rng.uniform(0.2, 2.0, p)),
        }
        if q:
            mode |= {"B": rng.standard_normal((n, q)), "D": rng.standard_normal((p, q))}
        if offsets:
            mode["c"] = rng.standard_normal(n)
        modes.append({key: value.tolist() for key, value in mode.items()})
    model = {key: value for key, value in modes[0].items() if key != "c"}
    model |= {"x0": rng.standard_normal(n).tolist(), "P0": covariance(rng, n).tolist()}
    jump = {
        "transition": rng.dirichlet(np.ones(N), N).tolist(),
        "initial": rng.dirichlet(np.ones(N)).tolist(),
        "modes": modes,
    }
    return {
        "name": "plant",
        "model": model,
        "faults": {"jump": jump},
        "filter": {"family": "mjls_lmmse"},
    }


def record_of(spec, T, *, seed=1, missing=0.0, params=None):
    """Measurements and inputs; what was lost is NaN where the filter knows it."""
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((T, spec.model.nu))
    drawn = simulate_jumps(JumpSystem.from_spec(spec, T, params), u, rng)
    y = drawn.y
    if spec.faults.jump.arrival == "known":
        y[~drawn.arrived] = np.nan
    y[rng.random(y.shape) < missing] = np.nan
    return y, u


def believed(spec, T, params=None):
    """The plant as the filter takes it."""
    system = JumpSystem.from_spec(spec, T, params)
    known = spec.faults.jump.arrival != "unknown" or spec.filter.options.detector != "none"
    return system.always_arriving() if known else system


def textbook_of(spec, y, u, params=None):
    """What whole matrices say."""
    system, chain = believed(spec, len(y), params), unobserved_chain(spec)
    steady = steady_state(spec, system) if spec.filter.options.gain == "stationary" else None
    plant = composite(system) if chain else system
    result = textbook_jumps(plant, y, u, test=loss_test(spec), steady=steady)
    if not chain:
        return result
    return replace(result, mode_law=result.mode_law.reshape(len(y), 2, -1).sum(axis=1))


def filtered(table, y, u=None, params=None, **options):
    """Ports of the interpreter for a changed table."""
    spec = spec_of(table, **options)
    return interpreted(spec, y, np.zeros((len(y), 0)) if u is None else u, params)
