"""Correlated partial error-state compression filter beside a host filter: Lee & Lee, Theorem 4.

Like ``dfcf``, but what waits for the end of a window is one compressed measurement of the states
that the waiting rows measure, and not an estimate of the whole state: less work and memory, and
some information lost.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal, Self, get_args

import numpy as np

from fkgen.families.family import Family, built_by, proved_by
from fkgen.faults.partial_state import SAME, measured_states, typical_deviation
from fkgen.faults.soft import CompressionOptions, read_soft_faults
from fkgen.problem import Model, Spec
from fkgen.problem.covariance import is_singular, nearby
from fkgen.problem.filter import Traits
from fkgen.problem.table.place import Place
from fkgen.problem.table.section import Section

Maintenance = Literal["optimal", "paper"]

_WAY_OUT = "for the family cpcf; the family dfcf takes any rows"


@dataclass(frozen=True, slots=True)
class CpcfOptions(CompressionOptions):
    """The same, and how the compressed measurement is kept: ``"optimal"`` or ``"paper"`` (44)."""

    maintenance: Maintenance = "optimal"

    @classmethod
    def read(cls, section: Section, faults: object, model: Model) -> Self:
        """What every compression filter has, and the maintenance."""
        common = CompressionOptions.read(section, faults, model)
        how: Maintenance = section.choice("maintenance", get_args(Maintenance), "optimal")
        return cls(common.test, common.reacquire, how)


def check(spec: Spec) -> None:
    """Refuse waiting rows that are not phi [I 0] T x with det phi != 0, or whose R is singular."""
    if spec.faults.soft is None:
        return
    model, defaults, rows = spec.model, spec.defaults, list(spec.faults.soft.compressed)
    place = Place(spec.file).entry("model")
    if is_singular(model.R.values(defaults)[rows][:, rows]):
        raise place.entry("R").error(
            "a singular block for the rows of the compression filter",
            "a regular one: cpcf weighs by its inverse, eq. (46); dfcf does not need it",
        )
    which = ", ".join(f"{row} ({model.outputs[row].name})" for row in rows)
    C1 = model.C.values(defaults)[rows]
    measured = measured_states(C1, typical_deviation(model, defaults))
    if len(measured) < len(rows):
        raise place.entry("C").error(
            f"linearly dependent rows {which}: rank {len(measured)} of {len(rows)}",
            f"a compression group phi [I 0] T with det(phi) != 0, (37), {_WAY_OUT}",
        )
    T1 = np.linalg.solve(C1[:, measured], C1)
    for point in [] if model.C.is_constant else nearby(defaults):
        try:
            now = model.C.values(point)[rows]
        except ArithmeticError:  # outside the domain of an entry: this point says nothing
            continue
        apart = np.abs(now - now[:, measured] @ T1)
        if (apart > SAME * np.abs(now).max(axis=1, keepdims=True)).any():
            moving = ", ".join(sorted(model.C.names))
            raise place.entry("C").error(
                f"rows {which} that measure other combinations of states as {moving} change",
                f"a compression group phi T1 x with a constant T1, (37), {_WAY_OUT}",
            )


FAMILY = Family(
    name="cpcf",
    title="sensors that drift slowly, at less cost: host filter and partial compression filter",
    build=built_by(
        "windows.partial:partial_compression_filter",
        source="Lee & Lee, Theorem 4, eqs. (28), (29), (37)-(47), (50), (51)",
    ),
    proof=proved_by(
        "compression",
        "PRIMITIVE_NOISES",
        "CONTRADICTED",
        "HOST_ALONE",
        theorems="compression:PARTIAL_IDENTITIES",
    ),
    traits=Traits(windows="partial"),
    options=CpcfOptions,
    accepts={"soft": partial(read_soft_faults, single=True)},
    check=check,
    starter="starter_cpcf.toml",
)
