"""One sample that no model expects: the filter goes on, and is what it was some samples later."""

from __future__ import annotations

import numpy as np
import pytest
from plants import built

import fkgen

AXIS = [[1.0, 0.1], [0.0, 1.0]]
NOISE = np.kron(np.eye(2), [[1e-4, 2e-3], [2e-3, 5e-2]])
MANOEUVRES = {
    "model": {
        "A": np.kron(np.eye(2), AXIS).tolist(),
        "C": np.eye(4)[::2].tolist(),
        "Q": NOISE.tolist(),
        "R": np.eye(2).tolist(),
        "x0": [0.0] * 4,
        "P0": np.eye(4).tolist(),
    },
    "faults": {
        "jump": {
            "transition": [[0.95, 0.03, 0.02], [0.05, 0.9, 0.05], [0.1, 0.1, 0.8]],
            "initial": [0.8, 0.1, 0.1],
            "modes": [{}, {"Q": (30.0 * NOISE).tolist()}, {"R": (50.0 * np.eye(2)).tolist()}],
        }
    },
    "filter": {"family": "imm"},
}
LOSSES = {
    "model": {
        "A": [[0.9, 0.1, 0.0], [0.0, 0.8, 0.1], [0.1, 0.0, 0.7]],
        "C": np.eye(3).tolist(),
        "Q": (0.1 * np.eye(3)).tolist(),
        "R": np.eye(3).tolist(),
        "x0": [0.0] * 3,
        "P0": np.eye(3).tolist(),
    },
    "faults": {
        "sensor": {
            "noise_factor": 10.0,
            "problem": 3,
            "gamma_chain": [[0.9, 0.1], [0.1, 0.9]],
            "delta_chain": [[0.8, 0.2], [0.8, 0.2]],
        }
    },
    "filter": {"family": "one_step"},
}
CASES = {
    "imm": MANOEUVRES,
    "imm, sensor": LOSSES | {"filter": {"family": "imm"}},
    "one_step": LOSSES,
}


@pytest.mark.parametrize("scalar", ["double", "float"])
@pytest.mark.parametrize("name", list(CASES))
def test_one_absurd_sample_locks_no_filter(name, scalar):
    spec = fkgen.Spec.from_dict({"name": "far", **CASES[name], "code": {"scalar": scalar}})
    filter_ = built(spec)
    records = np.array(fkgen.simulate(spec, 2, 1500, 5).y)
    for size in (1e8, 1e12, 1e15):
        for k, y in enumerate(records):
            spoilt = y.copy()
            spoilt[50 * (k % 2), 0] = size
            run, clean = filter_.run(spoilt), filter_.run(y)
            refused = np.flatnonzero(run.refused)
            # float has no likelihood for what lies 1e15 sd off: that sample alone is refused
            assert refused.size == 0 or (scalar == "float" and refused.tolist() == [50 * (k % 2)])
            variances = np.diagonal(run.filtered_covariance, axis1=1, axis2=2)
            assert (variances > 0.0).all()
            sd = np.sqrt(variances[-1])
            assert (np.abs(run.filtered_state[-1] - clean.filtered_state[-1]) < 0.05 * sd).all()


@pytest.mark.parametrize("name", list(CASES))
def test_factors_are_what_covariances_are(name):
    of = {}
    for update in ("short", "joseph", "ud"):
        code = {"update": update}
        spec = fkgen.Spec.from_dict({"name": "near", **CASES[name], "code": code})
        y = np.array(fkgen.simulate(spec, 1, 80, 3).y)[0]
        y[np.random.default_rng(2).random(y.shape) < 0.2] = np.nan
        of[update] = built(spec).run(y)
    for update in ("short", "joseph"):
        for port in ("filtered_state", "filtered_covariance", "predicted_covariance", "nis"):
            scale = np.nanmax(np.abs(of["ud"][port]))
            np.testing.assert_allclose(of[update][port], of["ud"][port], rtol=0, atol=1e-12 * scale)
