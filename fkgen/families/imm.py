"""Interacting multiple models over the conditions of a sensor, or over modes of the plant.

Blom & Bar-Shalom 1988; for sensors Sigalov & Oshman, sec. IV: one estimate per mode; before each
sample the estimates are mixed by what the chain says about the mode before, eqs. (17), (18).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Self

from fkgen.families.family import Family, Table, built_by, proved_by
from fkgen.faults import Faults, JumpFaults
from fkgen.faults.jump import read_jump_faults
from fkgen.faults.sensor import read_sensor_faults
from fkgen.problem import Model, Spec
from fkgen.problem.filter import Options, Traits
from fkgen.problem.finding import Finding
from fkgen.problem.table.place import Place, show
from fkgen.problem.table.section import Section, as_number

#: Probabilities closer than this are the same.
EQUAL = 1e-12


@dataclass(frozen=True, slots=True)
class ImmOptions(Options):
    """How many modes there are: of a sensor 4 or 3 (no signal is one), of a plant all it has."""

    modes: int = 4

    @classmethod
    def read(cls, section: Section, faults: Faults, _: Model) -> Self:
        """The number of modes; that of jump faults may be repeated."""
        place, allowed = section.place.entry("modes"), {3, 4}
        expected = (
            "4, or 3: the modes without signal are one, with the mixture of their likelihoods"
        )
        if faults.jump is not None:
            allowed = {len(faults.jump.modes)}
            expected = f"{max(allowed)}, the number of faults.jump.modes, or no such key"
        number = as_number(section.table.get("modes", max(allowed)), place, expected)
        if number not in allowed:
            given = number if faults.jump is None else section.table["modes"]
            raise place.error(show(given), expected)
        sensor = faults.sensor
        if number == 3 and sensor is not None and (sensor.law or sensor.first) is not None:
            given = "3 with probabilities that depend on parameters"
            raise place.error(given, "4: what three modes put together has to be a constant")
        return cls(int(number))


def three_modes(spec: Spec) -> tuple[Finding, ...]:
    """Three modes for four events, which is exact for a lumpable chain only: sec. III and IV."""
    faults = spec.faults.sensor
    if faults is None or spec.filter.options.modes != 3 or faults.noise_factor == 1.0:
        return ()
    defect = faults.lumped().defect
    if defect <= EQUAL:
        return ()
    message = (
        "three modes are not Markov here: delta at gamma = 0 depends on the past or tells about the"
        f" future, and treating it as drawn anew is wrong by up to {defect:.3g} in the probability"
        " of a step"
    )
    return (Finding("three-modes", "warning", message, defect, "modes = 4"),)


def without_channel(table: Table, truth: Spec) -> Table:
    """The same faults; samples that may be lost, and may not be known to be, are modes."""
    faults = truth.faults.jump
    if faults is None:
        return table
    if faults.rate is not None:
        place = Place(truth.file, "faults.jump.arrival_rate")
        raise place.error("a rate that depends on parameters", "a number, to make modes of it")
    chain = faults.chain(truth.model)
    if faults.arrival == "unknown" and faults.channel is not None:
        chain = chain.times(faults.channel)
    jump = JumpFaults(
        chain.transition, chain.initial, chain.modes, law=chain.law, first=chain.first
    )
    return table | {"faults": {"jump": jump.plain()}}


FAMILY = Family(
    name="imm",
    title="modes of the sensor or of the plant that last: interacting multiple models",
    build=built_by("models.interacting:interacting_models"),
    proof=proved_by(
        "sensor",
        "IMM",
        "ENUMERATION",
        "nonlinear:LINEARISED_IMM",
        theorems="gaussian:MIXTURE_IDENTITIES",
    ),
    traits=Traits(models="mixed", densities=True, nonlinear=True),
    options=ImmOptions,
    accepts={"sensor": read_sensor_faults, "jump": partial(read_jump_faults, sizes=True)},
    caveats=three_modes,
    adopt=without_channel,
    starter="starter_imm.toml",
)
