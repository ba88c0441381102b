"""Halve and double every deviation that was chosen: ``python sensitivity.py``.

Prints the second table of the page. One filter serves: what is varied is a parameter.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from prepare import TRIALS, read
from run import MOVES, NOISY, VQF, Score, content, ratio, score

import fkgen

BLOCKS = {"q": (0, 3), "bias": (3, 6), "v": (6, 9), "m": (9, 12)}
NOISES = {"gyro": "q", "drift": "bias", "push": "v", "offset": "m"}
ROWS = {"still": (0, 3), "mag": (3, 6), "rest": (6, 9)}
LABELS = {
    "gyro": "gyroscope",
    "gyro_scale": "gyroscope, scale",
    "drift": "drift of its bias",
    "push": "accelerometer",
    "offset": "drift of the offset",
    "jump": "the offset moves",
    "still": "a hand comes back",
    "rest": "gyroscope at rest",
    "mag": "magnetometer",
    "noisy": "magnetometer, noisy",
}
CHAIN = ("leaves_consistent", "leaves_moves", "leaves_noisy")


def scale(matrix: list[list[Any]], rows: tuple[int, int], parameter: str) -> None:
    """Multiply diagonal entries by the square of a parameter."""
    for i in range(*rows):
        matrix[i][i] = f"k_{parameter}**2*({matrix[i][i]})"


def varied() -> fkgen.Spec:
    """Make the spec with a parameter for every deviation, 1 by default."""
    table = content()
    model, jump = table["model"], table["faults"]["jump"]
    moves, noisy = jump["modes"][MOVES]["Q"], jump["modes"][NOISY]["R"]
    for name, block in NOISES.items():
        for Q in (model["Q"], moves):
            jumps = Q is moves and name == "offset"
            scale(Q, BLOCKS[block], "jump" if jumps else name)
    for name, rows in ROWS.items():
        for R in (model["R"], noisy):
            scale(R, rows, "noisy" if R is noisy and name == "mag" else name)
    for noise in model["noises"]:
        noise["variance"] = f"k_gyro_scale**2*{noise['variance']}"
    for i, name in enumerate(CHAIN):
        row = jump["transition"][i]
        away = [f"k_{name}*{p}" if j != i else "" for j, p in enumerate(row)]
        away[i] = "1" + "".join(f" - {term}" for term in away if term)
        jump["transition"][i] = away
    names = (*LABELS, *CHAIN)
    table["parameters"] |= {f"k_{name}": 1.0 for name in names}
    return fkgen.Spec.from_dict(table, file="spec.toml")


def variations() -> Iterator[tuple[str, float, float]]:
    """Yield parameters, and their values less and more."""
    for name in LABELS:
        yield name, 0.5, 2.0
    for name in CHAIN:
        yield name, 0.5, 1.5


def main() -> None:
    """Print the scores as they stand, and the mean over that of vqf."""
    compiled = fkgen.build(varied())
    records = {trial: read(trial) for trial in TRIALS}

    def scores(params: dict[str, float]) -> dict[int, Score]:
        return {
            trial: score(compiled.run(record.y, record.u, params=params), record)
            for trial, record in records.items()
        }

    print("| scaled | less | more |")
    print("| --- | --- | --- |")
    print(f"| nothing | {cell(scores({}))} | |")
    for name, *values in variations():
        cells = [cell(scores({f"k_{name}": value})) for value in values]
        label = LABELS.get(name, name.replace("_", " "))
        print(f"| {label} | " + " | ".join(cells) + " |")


def cell(found: dict[int, Score]) -> str:
    """Write the four scores, their mean over that of vqf, and the worst with offset removed."""
    each = " ".join(f"{one.total:.2f}" for one in found.values())
    worst = max(one.turned / VQF[trial][1] for trial, one in found.items())
    return f"{each}: {ratio(found):.2f}, {worst:.2f}"


if __name__ == "__main__":
    main()
