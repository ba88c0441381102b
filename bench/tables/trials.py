"""Simulation on all cores, and a comparison from nothing, in processes of their own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile

from harness.report import Table, verdict
from harness.settings import Settings

_SIMULATE, _COMPARE = 8.0, 15.0

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


def trials(settings: Settings) -> Table:
    """Seconds for ten million samples, and for an answer."""
    del settings
    table = Table(
        "Simulation and comparison",
        ["what", "seconds", "limit", "met"],
        "Scalar system with sensor faults, wall time, the least of three processes, on "
        f"{os.cpu_count()} cores. The comparison begins with `import fkgen` and an empty cache.",
    )
    parts = [_measured(_TRIALS) for _ in range(3)]
    simulated, filtered = min(p[0] for p in parts), min(p[1] for p in parts)
    total = min(sum(p) for p in parts)
    table.add("simulate 10000 trials of 1000 samples", f"{simulated:.2f}", "", "")
    table.add("run imm over them", f"{filtered:.2f}", "", "")
    table.add("both", f"{total:.2f}", _SIMULATE, verdict(total, _SIMULATE))
    answer = min(_measured(_FAMILIES)[0] for _ in range(3))
    what = "compare three families, 2000 trials of 200 samples, compilers included"
    table.add(what, f"{answer:.2f}", _COMPARE, verdict(answer, _COMPARE))
    return table


def _measured(code: str) -> list[float]:
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [sys.executable, "-c", _START + code, json.dumps(_SPEC)],
            capture_output=True,
            text=True,
            check=True,
            env={**os.environ, "FKGEN_CACHE": folder},
        )
    return list(json.loads(done.stdout))
