"""Plants for the partial compression filter, and what the primitive noises say of them."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
from plants import random_model, system_of, table

import fkgen
from fkgen.oracle.claims.compression import design_of
from fkgen.oracle.exact.partial_compression import partial_compression
from fkgen.oracle.plants.actuator import simulate

#: Lee & Lee, (48): position at every fifth sample, velocity at every one.
DELTA = 0.2
PAPER = {
    "A": [[1.0, DELTA], [0.0, 1.0]],
    "C": [[1.0, 0.0], [0.0, 1.0]],
    "F": [[DELTA**2 / 2], [DELTA]],
    "V": [[25.0]],
    "R": [[100.0, 0.0], [0.0, 0.01]],
    "x0": [0.0, 0.0],
    "P0": [[1.0, 0.0], [0.0, 0.01]],
}


def cpcf(model, *, host=(1,), window=150, false_alarm=0.05, **options):
    """A spec of the family; filter options, parameters and code by keyword."""
    given = table(model, **{"family": "cpcf", **options})
    given["faults"] = {"soft": {"host": list(host), "window": window, "false_alarm": false_alarm}}
    return fkgen.Spec.from_dict(given)


def dense(seed, n, m, hosts, *, direct=False, varying=False, singular=False):
    """Model, parameters and host rows: no zeros, correlated noise on both sides, G with n rows.

    F11 is neither 1 nor so small that a compressed measurement decays within a window.
    """
    rng = np.random.default_rng(seed)
    model = random_model(seed, n, m + hosts, int(direct), direct=direct, correlated=True)
    model["A"] = (0.9 * np.eye(n) + 0.25 * rng.standard_normal((n, n))).tolist()
    rows = [int(row) for row in rng.permutation(m + hosts)]
    host, others = sorted(rows[:hosts]), sorted(rows[hosts:])
    for i in host:
        for j in others:
            model["R"][i][j] = model["R"][j][i] = 0.0
    if singular:
        model["A"] = (np.array(model["A"]) @ np.diag(np.arange(n) > 0)).tolist()
    if not varying:
        return model, {}, host
    model["A"] = [[f"{entry!r}*(1 + 0.5*bend)" for entry in row] for row in model["A"]]
    for i in others:
        model["C"][i] = [f"{entry!r}*scale" for entry in model["C"][i]]
        model["R"][i] = [entry if j in host else f"{entry!r}*noise" for j, entry in
                         enumerate(model["R"][i])]  # fmt: skip
    return model, {"bend": 0.1, "scale": 1.3, "noise": 1.0}, host


def record(spec, T, *, seed=1, missing=0.3):
    """(y, u, params): parameters change from sample to sample, rows are missing."""
    rng = np.random.default_rng(seed)
    params = {p.name: p.default * rng.uniform(0.5, 1.5, T) for p in spec.parameters}
    u = rng.standard_normal((T, spec.model.nu))
    return simulate(system_of(spec, T, params), u, rng, missing=missing), u, params


def expected(spec, y, u=None, params=None):
    """Ports by name, from errors written out in the primitive noises."""
    design = design_of(spec, spec.faults.soft.window)
    result = partial_compression(system_of(spec, len(y), params), design, y, u)
    return {field.name: getattr(result, field.name) for field in fields(result)}


def sparse_positions(T, every=5):
    """A record of zeros for (48): it makes covariances and nothing else."""
    y = np.zeros((T, 2))
    y[np.arange(T) % every != 0, 0] = np.nan
    return y
