"""What a campaign costs: processor time of a sample, and how two workers share it.

    .venv/bin/python bench/campaigns.py

Processor time of the thread that works, the least of several goes, so that whatever else runs on
the machine counts as little as can be. Workers take turns, for the same reason.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import fkgen
from fkgen.study.campaigns.campaign import work_of
from fkgen.trials.simulation import Request

ROOT = Path(__file__).resolve().parent.parent
STEPS, GOES = 200, 5
EXAMPLES = {
    "imm, scalar, 4 modes": ("sensor_faults/example1.toml", {"family": "imm"}, None),
    "kf, n = 2": ("dc_motor/known_rate.toml", {"family": "kf"}, 5.0),
    "mkf, n = 2": ("dc_motor/known_rate.toml", None, 5.0),
    "ekf, range and bearing": ("range_bearing/spec.toml", None, (1.0, 0.1)),
}


def spec_of(file: str, filter_: dict[str, str] | None) -> fkgen.Spec:
    """An example, or another filter for its plant."""
    table = fkgen.load(ROOT / "examples" / file).to_dict()
    if filter_ is not None:
        table["filter"] = filter_
        table["faults"] = {} if filter_["family"] == "kf" else table["faults"]
    return fkgen.Spec.from_dict(table)


def cost(spec: fkgen.Spec, u: float | tuple[float, ...] | None) -> float:
    """Nanoseconds of a processor for a sample: drawn, filtered and summed up."""
    work = work_of(spec.whole, Request(spec, 10**6, STEPS, 0, 0), u)
    blocks = max(1, 2_000_000 // (work.size * STEPS))
    least = float("inf")
    for go in range(GOES + 1):
        start = time.thread_time()
        work.sums(range(go * blocks, (go + 1) * blocks))
        spent = time.thread_time() - start
        if go:  # the first one compiles the lanes
            least = min(least, spent / (blocks * work.size * STEPS))
    return 1e9 * least


def shared(spec: fkgen.Spec, trials: int) -> tuple[float, float]:
    """Least seconds of one worker and of two, in turns."""
    least = [float("inf")] * 2
    for _ in range(2):
        for i in (0, 1):
            start = time.perf_counter()
            fkgen.montecarlo(spec, trials, STEPS, workers=i + 1)
            least[i] = min(least[i], time.perf_counter() - start)
    return least[0], least[1]


def main() -> int:
    """Print a line for each filter, then the gain of a second worker."""
    for name, (file, filter_, u) in EXAMPLES.items():
        spent = cost(spec_of(file, filter_), u)
        print(f"{name:24} {spent:8.1f} ns a sample, {spent / 3600:6.3f} core hours for 1e9")
    spec = spec_of(*EXAMPLES["imm, scalar, 4 modes"][:2])
    one, two = shared(spec, 750_000)
    print(f"1 worker {one:.2f} s, 2 workers {two:.2f} s: {one / two:.2f} times as fast")
    return 0


if __name__ == "__main__":
    sys.exit(main())
