"""Three modes in place of four: can (0, 1) and (0, C) be one? Sigalov & Oshman, sec. III and IV."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fkgen.problem.probability import Distribution, stationary_law, visited

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Lumped:
    """The chain of the modes (1, 1), (1, C) and gamma = 0.

    Attributes
    ----------
    kernel : 3 tuples of 3 floats
    initial : tuple of 3 floats
    shares : tuple of 2 floats
        r0 = Pr(delta = 1 | gamma = 0), and 1 - r0.
    defect : float
        Largest error of a probability that lumping makes; 0 if the three modes are Markov with a
        constant r0.
    """

    kernel: tuple[Distribution, ...]
    initial: Distribution
    shares: tuple[float, float]
    defect: float


def merged(kernel: tuple[Distribution, ...], initial: Distribution) -> Lumped:
    """Lump the two modes without signal of a chain of four.

    Where that is not exact, r0 is that of the stationary law, or of the start if there are several.
    """
    P, start = np.array(kernel), np.array(initial)
    share = _share(P, start)
    source = np.vstack([P[:2], np.array([share, 1.0 - share]) @ P[2:]])
    three = np.column_stack([source[:, :2], source[:, 2:].sum(axis=1)])
    return Lumped(
        kernel=tuple(tuple(row) for row in three.tolist()),
        initial=(*initial[:2], initial[2] + initial[3]),
        shares=(share, 1.0 - share),
        defect=_defect(P, start, share),
    )


def _share(P: Array, start: Array) -> float:
    """r0 = Pr(delta = 1 | gamma = 0) of the law that stays, else of all ways into gamma = 0."""
    law = stationary_law(P)
    for candidate in (start if law is None else law, start, P[visited(P, start)].sum(axis=0)):
        silent = candidate[2:].sum()
        if silent > 0.0:
            return float(candidate[2] / silent)
    return 1.0


def _defect(P: Array, start: Array, share: float) -> float:
    reached = visited(P, start)
    laws = [start, *P[reached]]
    errors = [abs(law[2] - share * law[2:].sum()) for law in laws]
    if reached[2:].all():
        apart = P[2] - P[3]
        errors += [float(np.abs([apart[0], apart[1], apart[2:].sum()]).max())]
    return float(max(errors))
