"""Filters for jumping plants that others derive: told the mode, or with losses as modes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fkgen.spec import JumpFaults, Spec
from fkgen.spec.chain import stationary_law
from fkgen.study.simulation import Simulation

#: Parameter that is 1 in a mode and 0 in the others.
INDICATOR = "in_mode_{}"


def informed(truth: Spec, faults: JumpFaults) -> Spec:
    """The spec of a Kalman filter whose matrices are chosen by indicators of the modes.

    What a mode adds to the state is the coefficient of one more input, which is 1.

    Parameters
    ----------
    truth : Spec
    faults : JumpFaults
        Of the truth.
    """
    table: dict[str, Any] = truth.to_dict()
    modes: list[dict[str, Any]] = [mode.plain() for mode in faults.modes]
    n, p, q = truth.model.nx, truth.model.ny, truth.model.nu
    model = table["model"]
    for letter in ("A", "C", "Q", "R"):
        model[letter] = _chosen([mode[letter] for mode in modes])
    added = _chosen([[[entry] for entry in mode["c"]] for mode in modes])
    driven = _chosen([mode["B"] for mode in modes]) if q else [[] for _ in range(n)]
    direct = _chosen([mode["D"] for mode in modes]) if q else [[] for _ in range(p)]
    model["B"] = [[*row, *extra] for row, extra in zip(driven, added, strict=True)]
    model["D"] = [[*row, 0.0] for row in direct]
    model.pop("inputs", None)
    indicators = {INDICATOR.format(i): float(i == 0) for i in range(len(modes))}
    table["parameters"] = dict(table["parameters"]) | indicators
    return Spec.from_dict(table | {"faults": {}, "filter": {"family": "kf"}}, file=truth.file)


def _chosen(matrices: Sequence[Any]) -> list[list[Any]]:
    """Entries that differ as a sum over modes, those that do not as they are."""
    rows, columns = len(matrices[0]), len(matrices[0][0])
    return [[_entry([m[i][j] for m in matrices]) for j in range(columns)] for i in range(rows)]


def _entry(values: Sequence[object]) -> object:
    if all(value == values[0] for value in values):
        return values[0]
    return " + ".join(f"{INDICATOR.format(i)}*({value})" for i, value in enumerate(values))


def indicators(simulation: Simulation) -> dict[str, NDArray[np.float64]]:
    """(M, T) per mode: 1 where it is the one."""
    jump, mode = simulation.spec.faults.jump, simulation.mode
    if jump is None or mode is None:
        return {}
    return {INDICATOR.format(i): (mode == i).astype(float) for i in range(len(jump.modes))}


def with_losses_as_modes(faults: JumpFaults) -> dict[str, object]:
    """The section of the same plant for a family without a channel.

    Every mode comes twice, first all with a signal, then all without: C = 0, D = 0. Samples that
    are known to be lost are missing, and need no modes.

    Parameters
    ----------
    faults : JumpFaults
    """
    table = faults.plain()
    stated = {key: table[key] for key in ("transition", "initial", "modes")}
    channel = faults.channel
    if faults.arrival != "unknown" or channel is None:
        return stated
    modes: Any = stated["modes"]
    lost = [mode | {key: _zeros(mode[key]) for key in ("C", "D") if key in mode} for mode in modes]
    arrived_first = channel[::-1, ::-1]
    law = stationary_law(arrived_first)
    start = arrived_first[0] if law is None else law
    return {
        "transition": np.kron(arrived_first, faults.transition).tolist(),
        "initial": np.kron(start, faults.initial).tolist(),
        "modes": [*modes, *lost],
    }


def _zeros(matrix: list[list[object]]) -> list[list[float]]:
    return [[0.0] * len(row) for row in matrix]
