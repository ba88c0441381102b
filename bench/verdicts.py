"""How often a campaign accepts a filter that is right, and finds out one that is not.

    .venv/bin/python bench/verdicts.py [SEEDS]

A Kalman filter of two states, 1000 trials of 200 samples a seed. The plant has its covariances, or
those of the filter are 1.05 times, or one over 1.05 times, as large. Nothing here depends on the
machine: the same seeds give the same counts.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable

import fkgen

TRIALS, STEPS = 1000, 200
#: Seeds of the table in docs/montecarlo.md.
SEEDS = 1000
MODEL = {
    "A": [[1.0, 0.1], [0.0, 0.95]],
    "C": [[1.0, 0.0]],
    "Q": [[0.001, 0.0], [0.0, 0.01]],
    "R": [[0.04]],
    "x0": [0.0, 1.0],
    "P0": [[1.0, 0.0], [0.0, 0.5]],
}


def filter_of(factor: float, letters: Iterable[str]) -> fkgen.Spec:
    """The filter, with some covariances scaled."""
    scaled = {x: [[factor * each for each in row] for row in MODEL[x]] for x in letters}
    table = {"name": "cart", "model": MODEL | scaled, "filter": {"family": "kf"}}
    return fkgen.Spec.from_dict(table)


def found_out(factor: float, letters: str, seeds: int) -> int:
    """Seeds whose campaign calls the filter something else than consistent."""
    truth, design = filter_of(1.0, ""), filter_of(factor, letters)
    campaigns = (
        fkgen.montecarlo(design, TRIALS, STEPS, seed, truth=truth) for seed in range(seeds)
    )
    return sum(not each.consistent for each in campaigns)


def main() -> int:
    """Print a row for each filter."""
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else SEEDS
    print("| covariances of the filter over those of the plant | seeds | found out |")
    print("| --- | ---: | ---: |")
    for factor, letters, said in (
        (1.0, "", "the same"),
        (1.05, "Q", "Q 1.05"),
        (1.05, "R", "R 1.05"),
        (1.05, "QR", "Q and R 1.05"),
        (1.0 / 1.05, "Q", "Q 1/1.05"),
        (1.0 / 1.05, "R", "R 1/1.05"),
        (1.0 / 1.05, "QR", "Q and R 1/1.05"),
    ):
        print(f"| {said} | {seeds} | {found_out(factor, letters, seeds)} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
