"""Plants whose faults are followed: the four models of Song & Hu, and random time-varying ones."""

from __future__ import annotations

import numpy as np
from plants import covariance

import fkgen
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.sampled import draw_record

T = 40
CLOSE = 1e-12
"""Relative to the largest number in sight: some hundred roundings of double arithmetic."""

CHAIN = [[0.99, 0.1, 0.0], [0.0, 0.99, -0.1], [0.0, 0.0, 0.99]]
BOTH = [[0.9, 0.0, -0.9], [0.0, 0.05, 0.0]]
SECOND = [[0.0, 0.0, 0.0], [0.0, 0.05, 0.0]]
INTO_3, INTO_2 = [[0.0], [0.0], [1.0]], [[0.0], [1.0], [0.0]]
MODELS = {
    "A": (CHAIN, INTO_3, BOTH),
    "B": (CHAIN, INTO_3, SECOND),
    "C": (CHAIN, INTO_2, BOTH),
    "D": ((0.99 * np.eye(3)).tolist(), INTO_2, BOTH),
}


def paper(name, P0=None):
    """A model of the paper, (27)-(30), as a Kalman filter."""
    A, B, C = MODELS[name]
    model = {
        "A": A,
        "B": B,
        "C": C,
        "Q": np.diag([0.25, 0.01, 0.36]),
        "R": np.diag([1e-4, 1e-2]),
        "x0": [0.0, 0.0, 0.0],
        "P0": np.eye(3) if P0 is None else P0,
    }
    table = {"name": f"model_{name.lower()}", "model": model, "filter": {"family": "kf"}}
    return fkgen.Spec.from_dict(table)


def varying(seed, n=3, p=2, q=2, *, direct=False, family="kf", **sections):
    """A plant in which every entry is a parameter; (spec, params) over 40 random samples."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((T, n, n))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max(axis=1)[:, None, None]
    arrays = {
        "A": A,
        "B": rng.standard_normal((T, n, q)),
        "C": rng.standard_normal((T, p, n)),
        "Q": np.array([covariance(rng, n) for _ in range(T)]),
        "R": np.array([covariance(rng, p) for _ in range(T)]),
    }
    if direct:
        arrays["D"] = rng.standard_normal((T, p, q))
    model, params = {"x0": rng.standard_normal(n), "P0": covariance(rng, n)}, {}
    for letter, values in arrays.items():
        _, rows, columns = values.shape
        model[letter] = [[""] * columns for _ in range(rows)]
        for i in range(rows):
            for j in range(columns):
                a, b = (max(i, j), min(i, j)) if letter in "QR" else (i, j)
                model[letter][i][j] = f"{letter.lower()}{a}{b}"
                params[f"{letter.lower()}{a}{b}"] = np.ascontiguousarray(values[:, a, b])
    table = {
        "name": "varying",
        "model": model,
        "parameters": {name: float(value[0]) for name, value in params.items()},
        "filter": {"family": family, **sections.pop("options", {})},
    }
    if sections:
        table["faults"] = sections
    return fkgen.Spec.from_dict(table), params


def difference(spec, faults, mode, params, u, missing):
    """Two runs of the compiled filter with one noise record: (state, error, innovation) change."""
    sensor, anomaly = faults
    T = len(u)
    full = {
        name: np.broadcast_to(value, (T,)) for name, value in {**spec.defaults, **params}.items()
    }
    reached = u if mode == "filter" else u + anomaly
    told = u if mode == "plant" else u + anomaly
    records = []
    for each in (u, reached):
        y, _ = draw_record(spec, full, each, np.random.default_rng(5))
        y[missing] = np.nan
        records.append(y)
    built = fkgen.build(spec)
    q = spec.model.nu
    before = built.run(records[0], u if q else None, params)
    after = built.run(records[1] + sensor, told if q else None, params)
    system = LinearSystem.from_spec(spec, T, full)
    plant = np.zeros((T, spec.model.nx))
    for k in range(T - 1):
        plant[k + 1] = system.A[k] @ plant[k] + system.B[k] @ (reached - u)[k]
    change = after.filtered_state - before.filtered_state
    return change, plant - change, after.innovation - before.innovation


def close(found, expected, *sizes):
    """Equal within `CLOSE` of the largest of 1, what is expected, and the sizes; NaN = NaN."""
    scale = max(1.0, *(float(np.nanmax(np.abs(each))) for each in (expected, *sizes)))
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=CLOSE * scale)


def profiles(spec, seed=3):
    """Random faults in y and in u."""
    rng = np.random.default_rng(seed)
    sensor = rng.standard_normal((T, spec.model.ny))
    return sensor, rng.standard_normal((T, spec.model.nu))


def missing_some(spec, seed=4):
    missing = np.random.default_rng(seed).random((T, spec.model.ny)) < 0.25
    missing[0], missing[9] = False, True
    return missing
