"""A host filter and its compression filters: sizes, symbols, and which rows each of them takes."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from fkgen.spec import SoftFaults, Spec
from fkgen.symbolic.plant import Plant
from fkgen.symbolic.sequential import Form

Groups = tuple[int, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair:
    """The pair of filters: sizes, symbols, and which groups each compression filter takes."""

    spec: Spec
    soft: SoftFaults
    plant: Plant
    symbols: dict[str, ca.SX]
    form: Form
    subsets: tuple[Groups, ...]

    def rows(self, subset: Groups) -> tuple[int, ...]:
        """The rows of y of the host and of these groups."""
        return tuple(sorted((*self.soft.host, *(r for g in subset for r in self.soft.groups[g]))))

    def filters(self, prefix: str = "") -> list[tuple[ca.SX, ca.SX]]:
        """(d, packed P*) of every compression filter."""
        n = self.plant.nx
        deviation = ca.vertsplit(self.symbols[f"{prefix}compression_deviation"], n)
        covariance = self.symbols[f"{prefix}compression_covariance"]
        return list(zip(deviation, ca.vertsplit(covariance, n * (n + 1) // 2), strict=True))
