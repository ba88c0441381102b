"""Measure on a machine that others use too: contenders take turns, ratios count within a round."""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Times:
    """Seconds of CPU per call of every contender in every round.

    Attributes
    ----------
    rounds : mapping of str to (R,) array
    """

    rounds: Mapping[str, NDArray[np.float64]]

    def best(self, name: str) -> float:
        """The shortest: what the code costs when nothing disturbs it."""
        return float(self.rounds[name].min())

    def ratio(self, name: str, reference: str) -> float:
        """Median over the quietest tenth of the rounds of the ratio within a round.

        A busy neighbour on the same core slows code with much work in flight more than code that
        waits for itself: the noisy rounds would compare the neighbours.
        """
        both = self.rounds[name], self.rounds[reference]
        quiet = np.argsort(both[0] + both[1])[: max(3, len(both[0]) // 10)]
        return float(np.median(both[0][quiet] / both[1][quiet]))


def pin() -> None:
    """Stay on one core."""
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


@contextlib.contextmanager
def unpinned() -> Iterator[None]:
    """All cores, for what is not measured."""
    held = os.sched_getaffinity(0)
    os.sched_setaffinity(0, range(os.cpu_count() or 1))
    try:
        yield
    finally:
        os.sched_setaffinity(0, held)


def take_turns(
    contenders: Mapping[str, Callable[[], object]], rounds: int, seconds: float = 0.0
) -> Times:
    """Call all in turn, in an order that changes, for so many rounds and at least so long."""
    names = list(contenders)
    for name in names:
        contenders[name]()
    taken: dict[str, list[float]] = {name: [] for name in names}
    rng = np.random.default_rng(0)
    begin = time.perf_counter()
    while len(taken[names[0]]) < rounds or time.perf_counter() - begin < seconds:
        for i in rng.permutation(len(names)):
            call = contenders[names[i]]
            start = time.thread_time()  # who else runs on this core does not count
            call()
            taken[names[i]].append(time.thread_time() - start)
    return Times({name: np.array(times) for name, times in taken.items()})


def instructions(program: Path, steps: int = 2000) -> float:
    """Instructions of one step under callgrind, from two runs: what starting costs cancels."""
    counts = [_instructions(program, n) for n in (steps, 2 * steps)]
    return (counts[1] - counts[0]) / steps


def _instructions(program: Path, steps: int) -> int:
    done = subprocess.run(
        [
            "valgrind",
            "--tool=callgrind",
            "--callgrind-out-file=/dev/null",
            str(program),
            str(steps),
        ],
        capture_output=True,
        text=True,
        check=True,
    )
    found = re.search(r"Collected\s*:\s*(\d+)", done.stderr)
    if found is None:
        raise RuntimeError(done.stderr)
    return int(found[1])
