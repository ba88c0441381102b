"""How the C code is to look."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from fkgen.problem.table.place import Place
from fkgen.problem.table.section import Section

Scalar = Literal["double", "float"]
Update = Literal["auto", "short", "joseph"]
Copies = Literal["static", "shared"]


@dataclass(frozen=True, slots=True)
class Code:
    """Options of the generated code."""

    scalar: Scalar = "double"  # The real type of C: "double" or "float"
    #: Form of the covariance update: "short", "joseph", or "auto" to let fkgen choose
    update: Update = "auto"
    #: Where exp, log and their like are: "static" in the file of the filter, or "shared" in
    #: files beside it, the same for all filters of one program
    elementary: Copies = "static"

    def plain(self) -> dict[str, object]:
        """Return the table a spec file would hold."""
        table: dict[str, object] = {"scalar": self.scalar, "update": self.update}
        return table if self.elementary == "static" else table | {"elementary": self.elementary}


def read_code(table: object, place: Place) -> Code:
    """Return the options that a table states; an empty mapping gives the defaults."""
    section = Section(table, place, known=("scalar", "update", "elementary"))
    return Code(
        scalar=section.choice("scalar", get_args(Scalar), "double"),
        update=section.choice("update", get_args(Update), "auto"),
        elementary=section.choice("elementary", get_args(Copies), "static"),
    )
