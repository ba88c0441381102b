"""Count how often intervals hold the truth: ``python coverage.py [FAMILY ...]``, else kf, mkf, imm.

Prints the last table of the page: 500 records of 400 samples for each family and seed, one small
plant.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

import fkgen

RECORDS, SAMPLES, SEEDS, LEVEL = 500, 400, (1, 2, 3), 0.95
PLANT: dict[str, Any] = {
    "A": [[0.9]],
    "C": [[1.0]],
    "Q": [["q"]],
    "R": [["r"]],
    "x0": [0.0],
    "P0": [[0.5]],
}
FAMILIES: dict[str, tuple[dict[str, Any], dict[str, Any], dict[str, float]]] = {
    "kf": (PLANT, {}, {"q": 0.1, "r": 0.1}),
    "mkf": (
        PLANT | {"B": [[0.5]]},
        {"actuator": {"success_rate": "rate"}},
        {"q": 0.05, "r": 0.02, "rate": 0.7},
    ),
    "imm": (
        PLANT,
        {
            "jump": {
                "transition": [["stay", "1 - stay"], ["back", "1 - back"]],
                "modes": [{}, {"R": [["100*r"]]}],
            }
        },
        {"q": 0.1, "r": 0.04, "stay": 0.95, "back": 0.2},
    ),
}
"""Model, faults, and true parameters, which are the defaults too, by family."""


def covered(name: str, seed: int, records: int = RECORDS) -> dict[str, float]:
    """Share of the intervals of 95 % that hold the truth, by parameter."""
    model, faults, true = FAMILIES[name]
    table = {"name": f"coverage_{name}", "parameters": true, "model": model, "faults": faults}
    spec = fkgen.Spec.from_dict(table | {"filter": {"family": name}})
    u: NDArray[np.float64] | None = None
    if spec.model.nu:
        u = np.where(np.arange(SAMPLES) // 20 % 2, 1.0, -1.0)[:, np.newaxis]
    y = fkgen.simulate(spec, records, SAMPLES, seed, u).y
    held = dict.fromkeys(true, 0)
    for record in y:
        intervals = fkgen.fit(spec, record, u, estimate=tuple(true)).interval(LEVEL)
        for parameter, (low, high) in intervals.items():
            held[parameter] += low <= true[parameter] <= high
    return {parameter: count / records for parameter, count in held.items()}


def main() -> None:
    """Print the table."""
    print("| family | seed | records | intervals that hold the truth |")
    print("| --- | ---: | ---: | --- |")
    for name in sys.argv[1:] or FAMILIES:
        for seed in SEEDS:
            held = covered(name, seed)
            shares = ", ".join(f"{key} {share:.1%}" for key, share in held.items())
            print(f"| `{name}` | {seed} | {RECORDS} | {shares} |", flush=True)


if __name__ == "__main__":
    main()
