"""What the user says: plant, faults, filter and code options, as frozen and checked values."""

from fkgen.spec.actuator_faults import ActuatorFaults
from fkgen.spec.code_options import Code
from fkgen.spec.definition import Parameter, Spec
from fkgen.spec.expression import Expression, Name, Number, Operation, evaluate, names, parse
from fkgen.spec.faults import Faults
from fkgen.spec.filter import Filter
from fkgen.spec.jump_faults import JumpFaults, JumpMode
from fkgen.spec.matrix import Matrix
from fkgen.spec.model import Model
from fkgen.spec.reader import load
from fkgen.spec.sensor_faults import Moments, SensorFaults
from fkgen.spec.signals import Signal
from fkgen.spec.soft_faults import SoftFaults

__all__ = [
    "ActuatorFaults",
    "Code",
    "Expression",
    "Faults",
    "Filter",
    "JumpFaults",
    "JumpMode",
    "Matrix",
    "Model",
    "Moments",
    "Name",
    "Number",
    "Operation",
    "Parameter",
    "SensorFaults",
    "Signal",
    "SoftFaults",
    "Spec",
    "evaluate",
    "load",
    "names",
    "parse",
]
