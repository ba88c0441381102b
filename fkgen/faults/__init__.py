"""What can fail, one file per kind of fault."""

from fkgen.faults.actuator import ActuatorFaults
from fkgen.faults.chain import Mode
from fkgen.faults.jump import JumpFaults
from fkgen.faults.section import Faults
from fkgen.faults.sensor import Moments, SensorFaults
from fkgen.faults.soft import SoftFaults

__all__ = [
    "ActuatorFaults",
    "Faults",
    "JumpFaults",
    "Mode",
    "Moments",
    "SensorFaults",
    "SoftFaults",
]
