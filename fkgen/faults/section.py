"""What can fail: at most one kind of fault."""

from __future__ import annotations

from dataclasses import dataclass

from fkgen.errors import InternalError
from fkgen.faults import jump, sensor
from fkgen.faults.actuator import ActuatorFaults
from fkgen.faults.chain import ModeChain
from fkgen.faults.jump import JumpFaults
from fkgen.faults.sensor import SensorFaults
from fkgen.faults.soft import SoftFaults
from fkgen.problem.model import Model
from fkgen.problem.text.matrix import plain_fields


@dataclass(frozen=True, slots=True)
class Faults:
    """What can fail."""

    actuator: ActuatorFaults | None = None  # Intermittent actuator faults, if any
    sensor: SensorFaults | None = None  # Sensors that lose their signal or gain noise, if any
    #: Modes between which the plant jumps, and samples that are lost, if any
    jump: JumpFaults | None = None
    soft: SoftFaults | None = None  # Sensors that drift slowly, if any

    def chain(self, model: Model) -> ModeChain:
        """The modes of the plant under faults that are no soft ones, and their chain."""
        found = self.sensor or self.jump
        if found is None:
            raise InternalError("no chain of modes without faults of sensors or jumps")
        return found.chain(model)

    def plain(self) -> dict[str, object]:
        """Return the table a spec file would hold."""
        return plain_fields(self)


#: The sections of ``faults``, and their keys.
KINDS = {
    "actuator": ("success_rate", "dependence", "covariance"),
    "sensor": sensor.KEYS,
    "jump": jump.KEYS,
    "soft": ("host", "window", "false_alarm", "groups"),
}
