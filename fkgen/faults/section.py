"""What can fail: at most one kind of fault."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from fkgen.errors import InternalError
from fkgen.faults import jump, sensor
from fkgen.faults.actuator import ActuatorFaults
from fkgen.faults.chain import ModeChain
from fkgen.faults.jump import JumpFaults
from fkgen.faults.sensor import SensorFaults
from fkgen.faults.soft import SoftFaults
from fkgen.problem.model import Model
from fkgen.problem.probability import SUM_TOLERANCE, FirstLaw, Transition
from fkgen.problem.text.expression import names
from fkgen.problem.text.matrix import expressions, plain_fields


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

    @property
    def law_names(self) -> frozenset[str]:
        """The parameters that probabilities and the noise of a fault depend on."""
        keys = ("law", "factor", "rate", "arrivals", "first")
        found = [each for each in (self.sensor, self.jump) if each is not None]
        laws = tuple(getattr(each, key, None) for each in found for key in keys)
        return frozenset().union(*map(names, expressions(laws)))

    @property
    def firsts(self) -> tuple[FirstLaw, ...]:
        """The laws of sample 0 that depend on parameters."""
        found = [each.first for each in (self.sensor, self.jump) if each is not None]
        if self.jump is not None and self.jump.channel is not None:
            found.append(self.jump.channel.first)
        return tuple(each for each in found if each is not None)

    @property
    def lasting(self) -> Faults:
        """The same without the laws of sample 0."""
        sensor, jump = self.sensor, self.jump
        return replace(
            self,
            sensor=None if sensor is None else replace(sensor, first=None),
            jump=None if jump is None else replace(jump, first=None),
        )

    def at(self, parameters: Mapping[str, float]) -> Faults:
        """The faults whose laws have these parameters for good."""
        return Faults(
            self.actuator,
            None if self.sensor is None else self.sensor.at(parameters),
            None if self.jump is None else self.jump.at(parameters),
            self.soft,
        )

    def begun(self, parameters: Mapping[str, float]) -> Faults:
        """The same laws, which begin with these parameters."""
        found = self.at(parameters)
        sensor, jump = self.sensor, self.jump
        if sensor is not None and found.sensor is not None:
            factor, law, independent = sensor.factor, sensor.law, sensor.independent
            sensor = replace(found.sensor, factor=factor, law=law, independent=independent)
        if jump is not None and found.jump is not None:
            jump = replace(found.jump, law=jump.law, rate=jump.rate, arrivals=jump.arrivals)
        return replace(self, sensor=sensor, jump=jump)

    def in_domain(self, parameters: Mapping[str, float]) -> bool:
        """Whether the laws are probabilities, and the noise factor positive, with these."""
        if not self.law_names:
            return True
        found = self.at(parameters)
        laws: list[Transition] = []
        rates = [0.0]
        if found.sensor is not None:
            laws += [found.sensor.kernel, (found.sensor.initial,)] if found.sensor.kernel else []
            rates += [] if 0.0 < found.sensor.noise_factor <= sensor.LARGEST_FACTOR else [-1.0]
        if found.jump is not None:
            laws += [found.jump.transition, (found.jump.initial,), found.jump.arrival_chain]
            rates += [] if found.jump.arrival_rate is None else [found.jump.arrival_rate]
        rows = [row for law in laws for row in law]
        whole = all(abs(sum(row) - 1.0) <= SUM_TOLERANCE for row in rows)
        return whole and all(0.0 <= each <= 1.0 for row in (*rows, rates) for each in row)

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
