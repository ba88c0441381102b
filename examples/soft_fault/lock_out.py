"""What a host that starts far off costs, and what ``filter.reacquire`` mends: see dfcf.md.

The plant of Lee & Lee without any fault, started with a standard deviation of 10 m and 1 m/s. A
compression filter that is rejected in the first window leaves the host as wrong as it was.
"""

from __future__ import annotations

import sys

import numpy as np

import fkgen

DELTA, WINDOW, WINDOWS = 0.2, 150, 23
SAMPLES = WINDOW * WINDOWS + 1
NOISE = np.array([DELTA**2 / 2, DELTA])
SPEC = {
    "name": "lock_out",
    "model": {
        "A": [[1.0, DELTA], [0.0, 1.0]],
        "C": [[0.0, 1.0], [1.0, 0.0]],
        "Q": (25.0 * np.outer(NOISE, NOISE)).tolist(),
        "R": [[0.01, 0.0], [0.0, 100.0]],
        "x0": [0.0, 0.0],
        "P0": [[100.0, 0.0], [0.0, 1.0]],
    },
    "faults": {"soft": {"host": [0], "window": WINDOW}},
    "filter": {"family": "dfcf"},
}


def records(runs: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Measurements (runs, samples, 2) and the position at the end of every window."""
    a = 5.0 * rng.standard_normal((runs, SAMPLES - 1))
    zero = np.zeros((runs, 1))
    speed = rng.standard_normal((runs, 1)) + np.hstack([zero, np.cumsum(DELTA * a, axis=1)])
    step = DELTA * speed[:, :-1] + DELTA**2 / 2 * a
    position = 10.0 * rng.standard_normal((runs, 1)) + np.hstack([zero, np.cumsum(step, axis=1)])
    y = np.stack([speed, position], axis=-1)
    y += rng.standard_normal(y.shape) * [0.1, 10.0]
    y[:, np.arange(SAMPLES) % 5 != 0, 1] = np.nan
    return y, position[:, WINDOW::WINDOW]


def main() -> None:
    """Print the table."""
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 4000
    variants = {"never": {}, "2": {"reacquire": 2}, "3": {"reacquire": 3}, "5": {"reacquire": 5}}
    filters = {
        name: fkgen.build(fkgen.Spec.from_dict(SPEC | {"filter": SPEC["filter"] | options}))
        for name, options in variants.items()
    }
    keep = ["filtered_state", "filtered_covariance", "fault_declared"]
    errors: dict[str, list[np.ndarray]] = {name: [] for name in filters}
    rejected: dict[str, list[np.ndarray]] = {name: [] for name in filters}
    sigma = dict.fromkeys(filters, 0.0)
    rng = np.random.default_rng(2024)
    for start in range(0, runs, 200):
        y, position = records(min(200, runs - start), rng)
        for name, each in filters.items():
            run = each.run_batch(y, keep=keep)
            errors[name].append(run.filtered_state[:, WINDOW::WINDOW, 0] - position)
            rejected[name].append(run.fault_declared[:, WINDOW::WINDOW] > 0)
            sigma[name] += float(run.filtered_covariance[:, -1, 0, 0].sum())
    print(f"{runs} runs, {WINDOWS} windows of {WINDOW} samples, no fault")
    print("reacquire   rms error   filter sigma   first rejected   of these all rejected")
    for name in filters:
        error, flag = np.concatenate(errors[name]), np.concatenate(rejected[name])
        rms, first = np.sqrt(np.mean(error[:, -1] ** 2)), flag[:, 0]
        share = flag[first].all(axis=1).mean()
        deviation = np.sqrt(sigma[name] / runs)
        print(f"{name:9} {rms:9.3f} m {deviation:12.3f} m {first.mean():15.1%} {share:20.1%}")


if __name__ == "__main__":
    main()
