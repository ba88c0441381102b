"""What can fail, and which family is about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from fkgen.errors import InternalError
from fkgen.faults.actuator import ActuatorFaults, read_actuator_faults
from fkgen.faults.chain import ModeChain
from fkgen.faults.jump import JumpFaults, read_jump_faults
from fkgen.faults.sensor import SensorFaults, read_sensor_faults
from fkgen.faults.soft import SoftFaults, read_soft_faults
from fkgen.problem.filter import SECTIONS
from fkgen.problem.model import Model
from fkgen.problem.table.place import Place
from fkgen.problem.table.section import Section


@dataclass(frozen=True, slots=True)
class Faults:
    """What can fail.

    Parameters
    ----------
    actuator : ActuatorFaults or None
        Intermittent actuator faults, if any.
    sensor : SensorFaults or None
        Sensors that lose their signal or gain noise, if any.
    jump : JumpFaults or None
        Modes between which the plant jumps, and samples that are lost, if any.
    soft : SoftFaults or None
        Sensors that drift slowly, if any.
    """

    actuator: ActuatorFaults | None = None
    sensor: SensorFaults | None = None
    jump: JumpFaults | None = None
    soft: SoftFaults | None = None

    def chain(self, model: Model) -> ModeChain:
        """The modes of the plant under faults that are no soft ones, and their chain."""
        found = self.sensor or self.jump or self.actuator
        if found is None:
            raise InternalError("no chain of modes without faults, or for soft ones")
        return found.chain(model)

    def plain(self) -> dict[str, object]:
        """Return the table a spec file would hold."""
        sections = {
            "actuator": self.actuator,
            "sensor": self.sensor,
            "jump": self.jump,
            "soft": self.soft,
        }
        return {name: faults.plain() for name, faults in sections.items() if faults is not None}


def read_faults(
    table: object, place: Place, defaults: Mapping[str, float], family: str, model: Model
) -> Faults:
    """Return the faults that a table describes, which must be those the family handles.

    Parameters
    ----------
    table : object
        What stands under ``faults``; an empty mapping if nothing does.
    place : Place
        Where.
    defaults : mapping of str to float
        The parameters and their default values.
    family : str
        The family of the filter.
    model : Model
        The plant that fails.

    Raises
    ------
    SpecError
        If a section is missing, unknown or of no use to the family, or a rate or a law is
        impossible.
    """
    section = Section(table, place, known=("actuator", "sensor", "jump", "soft"))
    own = SECTIONS.get(family, ())
    for kind in section.table:
        if kind not in own:
            able = ", ".join(name for name, of in SECTIONS.items() if kind in of)
            raise place.entry(kind).error(
                f"{kind} faults", f"none for the family {family}; {able} handle {kind} faults"
            )
    if not own:
        return Faults()
    kind = _one_kind(section, own, family)
    where, given = place.entry(kind), section.table.get(kind, {})
    if kind == "sensor":
        return Faults(sensor=read_sensor_faults(given, where, model.outputs, family))
    if kind == "jump":
        return Faults(jump=read_jump_faults(given, where, defaults, family=family, model=model))
    if kind == "soft":
        return Faults(soft=read_soft_faults(given, where, defaults, family, model))
    return Faults(read_actuator_faults(given, where, defaults, family=family, inputs=model.nu))


def _one_kind(section: Section, own: tuple[str, ...], family: str) -> str:
    """The section that is there, of those that the family handles; for mme none need be."""
    present = [kind for kind in own if kind in section]
    if len(present) > 1:
        raise section.place.entry(present[1]).error(
            f"{present[1]} faults beside {present[0]} faults",
            f"one of them for the family {family}",
        )
    if not present and family != "mme":
        raise section.place.entry(own[0]).error(
            "nothing (the section is missing)",
            f"{' or '.join(own)} faults for the family {family}",
        )
    return present[0] if present else own[0]
