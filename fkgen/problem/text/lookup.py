"""Tables that expressions look up, as piecewise polynomials that are held at their ends."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field
from itertools import chain, pairwise
from typing import Literal

Kind = Literal["linear", "pchip"]


@dataclass(frozen=True, slots=True)
class Table:
    """y over x, which increases: straight lines or cubics between the points."""

    name: str
    x: tuple[float, ...]
    y: tuple[float, ...]
    kind: Kind = "linear"
    #: (c1, c2, c3) of each interval: y[i] + t (c1 + t (c2 + t c3)) with t = x - x[i]
    pieces: tuple[tuple[float, ...], ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Compute the polynomials."""
        steps = [b - a for a, b in pairwise(self.x)]
        slopes = [(b - a) / h for (a, b), h in zip(pairwise(self.y), steps, strict=True)]
        pieces: list[tuple[float, ...]] = [(slope,) for slope in slopes]
        if self.kind == "pchip" and len(steps) > 1:
            ends = pairwise(_derivatives(steps, slopes))
            pieces = [
                (a, (3.0 * s - 2.0 * a - b) / h, (a + b - 2.0 * s) / h / h)
                for (a, b), s, h in zip(ends, slopes, steps, strict=True)
            ]
        object.__setattr__(self, "pieces", tuple(pieces))

    @property
    def numbers(self) -> tuple[float, ...]:
        """What the code has to hold."""
        return (*self.x, *self.y, *chain(*self.pieces))

    def value(self, at: float) -> float:
        """Return y at a place; at a point the interval to its right counts."""
        if at < self.x[0] or at >= self.x[-1]:
            return self.y[0] if at < self.x[0] else self.y[-1]
        i = bisect_right(self.x, at) - 1
        result = 0.0
        for coefficient in reversed(self.pieces[i]):
            result = (result + coefficient) * (at - self.x[i])
        return self.y[i] + result

    def plain(self) -> dict[str, object]:
        """Return the table a spec file would hold."""
        return {"x": list(self.x), "y": list(self.y), "kind": self.kind}


def _derivatives(steps: list[float], slopes: list[float]) -> list[float]:
    """Return dy/dx at the points: Fritsch & Butland 1984, eq. (5), as weighted by SciPy and MATLAB.

    A harmonic mean where both slopes have one sign, else 0; three points at the ends.
    """
    inner = [
        3.0 * (h + g) / ((2.0 * h + g) / a + (h + 2.0 * g) / b) if _agree(a, b) else 0.0
        for (g, h), (a, b) in zip(pairwise(steps), pairwise(slopes), strict=True)
    ]
    ends = ((steps[:2], slopes[:2]), (steps[:-3:-1], slopes[:-3:-1]))
    first, last = (_end(*h, *s) for h, s in ends)
    return [first, *inner, last]


def _end(near: float, far: float, slope: float, beyond: float) -> float:
    found = ((2.0 * near + far) * slope - near * beyond) / (near + far)
    if not _agree(found, slope):
        return 0.0
    return 3.0 * slope if not _agree(slope, beyond) and abs(found) > 3.0 * abs(slope) else found


def _agree(a: float, b: float) -> bool:
    """Whether two numbers are both positive or both negative."""
    return (a > 0.0 and b > 0.0) or (a < 0.0 and b < 0.0)
