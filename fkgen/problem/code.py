"""How the C code is to look."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from fkgen.problem.table.place import Place
from fkgen.problem.table.section import Section

Scalar = Literal["double", "float"]
Update = Literal["auto", "short", "joseph"]

_SCALARS: tuple[Scalar, ...] = ("double", "float")
_UPDATES: tuple[Update, ...] = ("auto", "short", "joseph")


@dataclass(frozen=True, slots=True)
class Code:
    """Options of the generated code.

    Parameters
    ----------
    scalar : str
        The real type of C: ``"double"`` or ``"float"``.
    update : str
        Form of the covariance update: ``"short"``, ``"joseph"``, or ``"auto"`` to let fkgen
        choose.
    """

    scalar: Scalar = "double"
    update: Update = "auto"

    def plain(self) -> dict[str, object]:
        """Return the table a spec file would hold."""
        return {"scalar": self.scalar, "update": self.update}


def read_code(table: object, place: Place) -> Code:
    """Return the options that a table states; an empty mapping gives the defaults."""
    section = Section(table, place, known=("scalar", "update"))
    return Code(
        scalar=section.choice("scalar", _SCALARS, "double"),
        update=section.choice("update", _UPDATES, "auto"),
    )
