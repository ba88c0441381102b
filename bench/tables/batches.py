"""Many records: `run_batch` beside four records in the lanes of a vector."""

from __future__ import annotations

import os
import time

import numpy as np
from harness import models
from harness.report import Table, ns, times, verdict
from harness.settings import Settings
from rivals import anchors

_MODELS = ((2, 1), (4, 2), (6, 3), (12, 3))
_RECORDS, _SAMPLES, _LIMIT = 1024, 200, 1.15


def lanes(settings: Settings) -> Table:
    """CPU per step and record."""
    table = Table(
        "Batches",
        ["model", "run_batch, ns", "lanes, ns", "run_batch / lanes", "steps a second, wall"],
        f"{_RECORDS} records of {_SAMPLES} samples, x(k|k) kept; seconds of CPU of all threads "
        "per step and record, least of interleaved rounds. Lanes: the hand-written form of four "
        f"records side by side, one thread. Throughput on {os.cpu_count()} cores. Target: at most "
        f"{_LIMIT} of lanes.",
    )
    steps = _RECORDS * _SAMPLES
    for n, p in _MODELS:
        spec = models.dense(n, p)
        y = 0.1 * np.random.default_rng(0).normal(size=(_RECORDS, _SAMPLES, p))
        y[3, 5, 0] = np.nan
        calls = {
            "lanes": anchors.compiled_lanes(spec, y, settings.folder),
            "fkgen": anchors.of_fkgen(spec, y),
        }
        cpu, wall = {"lanes": np.inf, "fkgen": np.inf}, np.inf
        for _ in range(max(5, settings.rounds // 6)):
            for name, call in calls.items():
                begin, start = time.perf_counter(), time.process_time()
                call()
                cpu[name] = min(cpu[name], time.process_time() - start)
                wall = min(wall, time.perf_counter() - begin) if name == "fkgen" else wall
        ratio = cpu["fkgen"] / cpu["lanes"]
        cells = [ns(cpu[name] / steps) for name in ("fkgen", "lanes")]
        judged = f"{times(ratio)} ({verdict(ratio, _LIMIT)})"
        table.add(f"n{n} p{p}", *cells, judged, f"{steps / wall * 1e-6:.2f} million")
    return table
