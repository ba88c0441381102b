"""How the C code is to look."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from fkgen.problem.table.place import Place, describe
from fkgen.problem.table.section import Section, as_list

Scalar = Literal["double", "float"]
Update = Literal["auto", "short", "joseph", "ud"]
Copies = Literal["static", "shared"]
CodeForm = Literal["auto", "straight", "loops"]
Optimise = Literal["speed", "size"]


@dataclass(frozen=True, slots=True)
class Code:
    """Options of the generated code."""

    scalar: Scalar = "double"  # The real type of C: "double" or "float"
    #: How covariances are updated: "short", "joseph", "ud" (they are carried as factors U D U'), or
    #: "auto" to let fkgen choose
    update: Update = "auto"
    #: Where exp, log and their like are: "static" in the file of the filter, or "shared" in
    #: files beside it, the same for all filters of one program
    elementary: Copies = "static"
    #: Whether products are rounded together with the sum they go into, by fma() of C
    fma: bool = False
    #: Whether covariances between parts of the state that nothing couples are left out, and priors
    #: refused that have some
    decoupled: bool = False
    #: Straight lines, loops over whole matrices, or "auto": whichever is better at each place
    form: CodeForm = "auto"
    optimise: Optimise = (
        "speed"  # Or "size": loops for small plants too, whatever the compiler does
    )
    #: The ports that C shows besides those that the recursion needs; all of them if None
    ports: tuple[str, ...] | None = None

    def plain(self) -> dict[str, object]:
        """Return the table a spec file would hold."""
        table: dict[str, object] = {"scalar": self.scalar, "update": self.update}
        table |= {} if self.elementary == "static" else {"elementary": self.elementary}
        table |= {"fma": True} if self.fma else {}
        table |= {"decoupled": True} if self.decoupled else {}
        table |= {} if self.optimise == "speed" else {"optimise": self.optimise}
        table |= {} if self.form == "auto" else {"form": self.form}
        return table if self.ports is None else table | {"ports": list(self.ports)}

    def shows(self, port: str) -> bool:
        """Whether a port is asked for."""
        return self.ports is None or port in self.ports


def read_code(table: object, place: Place) -> Code:
    """Return the options that a table states; an empty mapping gives the defaults."""
    known = "scalar", "update", "elementary", "form", "optimise", "fma", "decoupled", "ports"
    section = Section(table, place, known=known)
    return Code(
        scalar=section.choice("scalar", get_args(Scalar), "double"),
        update=section.choice("update", get_args(Update), "auto"),
        elementary=section.choice("elementary", get_args(Copies), "static"),
        fma=section.flag("fma", default=False),
        decoupled=section.flag("decoupled", default=False),
        form=section.choice("form", get_args(CodeForm), "auto"),
        optimise=section.choice("optimise", get_args(Optimise), "speed"),
        ports=_read_ports(section) if "ports" in section else None,
    )


def _read_ports(section: Section) -> tuple[str, ...]:
    """Names of ports; which there are, the family knows."""
    expected, place = "a list of names of ports", section.place.entry("ports")
    names = as_list(section.table["ports"], place, expected)
    for i, name in enumerate(names):
        if not isinstance(name, str):
            raise place.item(i).error(describe(name), "the name of a port")
    return tuple(dict.fromkeys(map(str, names)))
