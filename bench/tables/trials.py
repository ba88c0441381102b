"""What takes all cores, in processes of its own: simulation, a comparison from nothing, a fit."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile

import numpy as np
from harness import models
from harness.report import Table, verdict
from harness.settings import Settings

_SIMULATE, _COMPARE, _FIT = 8.0, 15.0, 3.0
_FIT_SAMPLES = 100_000

#: The scalar system of Sigalov & Oshman, section VI, with the faults of example 1.
_SPEC = {
    "name": "scalar",
    "model": {
        "A": [[-0.8]],
        "C": [[1.0]],
        "Q": [[1.0]],
        "R": [[1.0]],
        "x0": [0.0],
        "P0": [[0.0]],
    },
    "faults": {
        "sensor": {
            "noise_factor": 10.0,
            "problem": 3,
            "gamma_chain": [[0.1, 0.9], [0.9, 0.1]],
            "delta_chain": [[0.8, 0.2], [0.8, 0.2]],
        }
    },
    "filter": {"family": "imm"},
}

_START = """
import json, os, sys, time
os.sched_setaffinity(0, range(os.cpu_count()))
start = time.perf_counter()
import fkgen
spec = fkgen.Spec.from_dict(json.loads(sys.argv[1]))
"""
_TRIALS = """
imm = fkgen.build(spec)
fkgen.simulate(spec, 1, 1)
ready = time.perf_counter()
drawn = fkgen.simulate(spec, 10_000, 1000, 1)
simulated = time.perf_counter()
imm.run_batch(drawn.y, keep=["filtered_state"])
print(json.dumps([simulated - ready, time.perf_counter() - simulated]))
"""
_FAMILIES = """
fkgen.compare(spec, ("imm", "one_step", "linear_optimal"), runs=2000, steps=200)
print(json.dumps([time.perf_counter() - start]))
"""
_FITTED = f"""
names = tuple(spec.defaults)
true = dict(zip(names, (0.02, 0.005, 0.2, 0.1)))
y = fkgen.simulate(spec, 1, {_FIT_SAMPLES}, 1, params=true).y[0]
fkgen.fit(spec, y[:100], estimate=names)
ready = time.perf_counter()
fit = fkgen.fit(spec, y, estimate=names)
fitted = time.perf_counter()
fit.interval()
assert fit.converged, fit.message
off = max(abs(fit.estimates[name] - true[name]) / fit.standard_errors[name] for name in names)
print(json.dumps([fitted - ready, time.perf_counter() - fitted, off]))
"""


def trials(settings: Settings) -> Table:
    """Seconds for ten million samples, and for an answer."""
    del settings
    table = Table(
        "Simulation and comparison",
        ["what", "seconds", "limit", "met"],
        "Scalar system with sensor faults, wall time, the least of three processes, on "
        f"{os.cpu_count()} cores. The comparison begins with `import fkgen` and an empty cache.",
    )
    parts = [_measured(_TRIALS, _SPEC) for _ in range(3)]
    simulated, filtered = min(p[0] for p in parts), min(p[1] for p in parts)
    total = min(sum(p) for p in parts)
    table.add("simulate 10000 trials of 1000 samples", f"{simulated:.2f}", "", "")
    table.add("run imm over them", f"{filtered:.2f}", "", "")
    table.add("both", f"{total:.2f}", _SIMULATE, verdict(total, _SIMULATE))
    answer = min(_measured(_FAMILIES, _SPEC)[0] for _ in range(3))
    what = "compare three families, 2000 trials of 200 samples, compilers included"
    table.add(what, f"{answer:.2f}", _COMPARE, verdict(answer, _COMPARE))
    return table


def fits(settings: Settings) -> Table:
    """Seconds for four variances from a long record."""
    del settings
    spec = models.dense(4, 2)
    spec["parameters"] = {"q0": 0.05, "q1": 0.05, "r0": 0.05, "r1": 0.5}
    spec["model"]["Q"] = [
        [entry if i != j or i > 1 else f"q{i}" for j, entry in enumerate(row)]
        for i, row in enumerate((0.01 * np.eye(4)).tolist())
    ]
    spec["model"]["R"] = [["r0", 0.0], [0.0, "r1"]]
    table = Table(
        "Parameters from a record",
        ["what", "seconds", "limit", "met"],
        f"kf n4 p2, four variances from {_FIT_SAMPLES} samples, defaults 2.5 to 10 times off; "
        f"wall time once it is built, the least of three processes, on {os.cpu_count()} cores.",
    )
    parts = [_measured(_FITTED, spec) for _ in range(3)]
    fitted, intervals = (min(part[i] for part in parts) for i in range(2))
    table.add("estimates and standard errors", f"{fitted:.2f}", _FIT, verdict(fitted, _FIT))
    table.add("intervals by profile likelihood", f"{intervals:.2f}", "", "")
    off = f"{parts[0][2]:.1f}"
    table.add("farthest estimate from the truth, in standard errors", off, "", "")
    return table


def _measured(code: str, spec: models.Spec) -> list[float]:
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [sys.executable, "-c", _START + code, json.dumps(spec)],
            capture_output=True,
            text=True,
            check=True,
            env={**os.environ, "FKGEN_CACHE": folder},
        )
    return list(json.loads(done.stdout))
