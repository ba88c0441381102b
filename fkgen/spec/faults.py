"""What can fail, and which family is about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from fkgen.spec.actuator_faults import ActuatorFaults, read_actuator_faults
from fkgen.spec.model import Model
from fkgen.spec.place import Place
from fkgen.spec.section import Section
from fkgen.spec.sensor_faults import SensorFaults, read_sensor_faults
from fkgen.spec.soft_faults import SoftFaults, read_soft_faults


@dataclass(frozen=True, slots=True)
class Faults:
    """What can fail.

    Parameters
    ----------
    actuator : ActuatorFaults or None
        Intermittent actuator faults, if any.
    sensor : SensorFaults or None
        Sensors that lose their signal or gain noise, if any.
    soft : SoftFaults or None
        Sensors that drift slowly, if any.
    """

    actuator: ActuatorFaults | None = None
    sensor: SensorFaults | None = None
    soft: SoftFaults | None = None

    def plain(self) -> dict[str, object]:
        """Return the table a spec file would hold."""
        sections = {"actuator": self.actuator, "sensor": self.sensor, "soft": self.soft}
        return {name: faults.plain() for name, faults in sections.items() if faults is not None}


#: The section of ``faults`` that each family is about; kf knows no faults.
SECTIONS = {
    **dict.fromkeys(("mkf", "mme"), "actuator"),
    **dict.fromkeys(("linear_optimal", "one_step", "imm", "genie"), "sensor"),
    **dict.fromkeys(("compression_full", "dfcf", "cpcf"), "soft"),
}


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
    section = Section(table, place, known=("actuator", "sensor", "soft"), later=("jump",))
    own = SECTIONS.get(family)
    for kind in section.table:
        if kind != own:
            able = ", ".join(name for name, of in SECTIONS.items() if of == kind)
            raise place.entry(kind).error(
                f"{kind} faults", f"none for the family {family}; {able} handle {kind} faults"
            )
    if own is None:
        return Faults()
    where = place.entry(own)
    if own not in section and family != "mme":
        raise where.error(
            "nothing (the section is missing)", f"{own} faults for the family {family}"
        )
    given = section.table.get(own, {})
    if own == "sensor":
        return Faults(sensor=read_sensor_faults(given, where, model.outputs, family))
    if own == "soft":
        return Faults(soft=read_soft_faults(given, where, defaults, family, model))
    return Faults(read_actuator_faults(given, where, defaults, family=family, inputs=model.nu))
