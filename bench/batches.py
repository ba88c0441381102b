"""Many records at once: processor time of a step, one after the other and in lanes."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import models
import numpy as np
from report import Table, ns
from settings import Settings

import fkgen
from fkgen.runtime import batch

M, T = 4096, 200
KEEP = ["filtered_state"]


def batches(settings: Settings) -> Table:
    """Nanoseconds of a step of each record."""
    table = Table(
        "Many records at once",
        ["filter", "run, ns", "run_batch, ns", "run / run_batch", "compiling the lanes, s"],
        f"Processor time per step and record, all threads together, {M} records of {T} samples, "
        "every row present, `keep` the filtered state, fresh memory for every result. `run`: the "
        "same records one after the other, a call for each. `run_batch`: side by side in the lanes "
        "of vectors, compiled at the first large batch and kept beside the filter.",
    )
    for name, spec in _cases().items():
        table.add(name, *_measured(spec, settings))
    return table


def _cases() -> dict[str, dict[str, Any]]:
    sizes = ((2, 1), (4, 2), (6, 3), (12, 3))
    dense = {f"kf n{n} p{p}, full": models.dense(n, p) for n, p in sizes}
    return dense | {"imm, 3 modes": models.imm_models()["imm, 3 modes"], "mkf": models.mkf()}


def _measured(table: dict[str, Any], settings: Settings) -> tuple[str, str, str, str]:
    spec = fkgen.Spec.from_dict(table)
    built = fkgen.build(spec)
    y = np.random.default_rng(1).standard_normal((M, T, spec.model.ny))
    u = np.ones((T, spec.model.nu)) if spec.model.nu else None
    batch.WORTH = batch.WORTH_A_STATEMENT = 0  # also where one batch would not be worth it
    start = time.perf_counter()
    built.run_batch(y[:2, :2], None if u is None else u[:2], keep=KEEP)
    compiled = time.perf_counter() - start
    few = y[: M // 16]

    def alone() -> None:
        for each in few:
            built.run(each, u, keep=KEEP)

    def together() -> None:
        built.run_batch(y, u, keep=KEEP)

    pairs = [(_spent(alone) * 16, _spent(together)) for _ in range(min(settings.rounds, 10))]
    one, all_ = (min(each) / (M * T) for each in zip(*pairs, strict=True))
    ratio = float(np.median([a / b for a, b in pairs]))
    return ns(one), ns(all_), f"{ratio:.1f}", f"{compiled:.1f}"


def _spent(work: Callable[[], None]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start
