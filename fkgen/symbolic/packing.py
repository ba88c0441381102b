"""How symmetric matrices are stored: the lower triangle by rows. No CasADi here."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fkgen.symbolic.interface import Port


def triangle(n: int) -> list[tuple[int, int]]:
    """Index pairs of the lower triangle of an n x n matrix, by rows: (0,0), (1,0), (1,1), ..."""
    return [(i, j) for i in range(n) for j in range(i + 1)]


def unpacked(port: Port, stored: ArrayLike) -> NDArray[np.floating]:
    """A stored sample in the shape that Python shows."""
    values = np.asarray(stored)
    if not port.symmetric:
        return values.reshape(port.shape)
    n = port.shape[-1]
    index = np.zeros((n, n), int)
    for at, (i, j) in enumerate(triangle(n)):
        index[i, j] = index[j, i] = at
    return values.reshape(-1, n * (n + 1) // 2)[:, index].reshape(port.shape)
