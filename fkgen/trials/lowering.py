"""A sampling, lowered and printed: C that draws trials of a plant, for Python only."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np

from fkgen.backend.functions import elementary_context
from fkgen.backend.ir import (
    Element,
    Operate,
    Operator,
    Phase,
    Scalar,
    Space,
    operands,
    walk,
)
from fkgen.backend.lower import lower_phase
from fkgen.backend.printer import StatementPrinter, tests_finiteness
from fkgen.backend.render import filled
from fkgen.symbolic.interface import Port, Status
from fkgen.trials import random_numbers
from fkgen.trials.conditions import Conditions
from fkgen.trials.sampling import INPUTS, Sampling
from fkgen.version import __version__


@dataclass(frozen=True, slots=True, kw_only=True)
class SamplerProgram:
    """Statements that draw one sample, and the tables of what is drawn; always in double."""

    name: str
    scalar: Scalar
    parameters: tuple[tuple[str, float], ...]  # of the plant, with their defaults
    ports: tuple[Port, ...]  # what the phases write
    sizes: tuple[int, int, int]  # states, inputs, measurements
    conditions: Conditions
    start: Phase
    law: Phase
    measure: Phase
    move: Phase

    @property
    def phases(self) -> tuple[Phase, ...]:
        """In the order in which they run."""
        return self.start, self.law, self.measure, self.move

    @property
    def functions(self) -> frozenset[Operator]:
        """Elementary functions that the program needs; normal numbers need two."""
        used = {operator for operator in self.operations if operator.is_function}
        return frozenset({Operator.LOG, Operator.SQRT} | used)

    @property
    def operations(self) -> list[Operator]:
        """Every operation of the four phases."""
        nodes = (node for phase in self.phases for node in walk(phase.body))
        return [node.operator for node in nodes if isinstance(node, Operate)]


@dataclass(frozen=True, eq=False, kw_only=True)
class SamplerSource:
    """Generated C of one sampler, and the facts (JSON) that Python needs to call it."""

    name: str
    text: str
    facts: str
    operations: int


def lower_sampling(sampling: Sampling) -> SamplerProgram:
    """Turn a sampling into statements."""
    spec, ports = sampling.spec, sampling.ports
    model = spec.model
    return SamplerProgram(
        name=spec.name,
        scalar="double",
        parameters=tuple((p.name, p.default) for p in spec.stated_parameters),
        ports=ports,
        sizes=(model.nx, model.nu, model.ny),
        conditions=sampling.conditions,
        start=lower_phase(ports, sampling.start, INPUTS),
        law=lower_phase(ports, sampling.law, INPUTS),
        measure=lower_phase(ports, sampling.measure, INPUTS),
        move=lower_phase(ports, sampling.move, INPUTS),
    )


def render_sampler(program: SamplerProgram) -> SamplerSource:
    """Print a sampler."""
    c = StatementPrinter(program.name, program.scalar, program.sizes[2])
    conditions = program.conditions
    phases = [
        _PhaseText(verb, comment, phase, _read(phase), c.block(phase.body))
        for verb, comment, phase in (
            ("start", "x[0]", program.start),
            ("law", "probabilities of coins, summed up", program.law),
            ("measure", "y[k]", program.measure),
            ("move", "x[k+1]", program.move),
        )
    ]
    context = elementary_context(c, program.functions) | {
        "program": program,
        "version": __version__,
        "tests_finiteness": tests_finiteness(program.phases),
        "n": program.sizes[0],
        "q": program.sizes[1],
        "p": program.sizes[2],
        "conditions": conditions,
        "indicators": len(conditions.indicators[0]) if conditions.indicators else 0,
        "initial": _cumulative(conditions.initial),
        "kernel": [_cumulative(row) for row in conditions.kernel],
        "prior": _cumulative(conditions.prior),
        "phases": phases,
        "statuses": (Status.OK, Status.PARAMETER_OUT_OF_RANGE, Status.RESULT_NOT_FINITE),
        "numbers": random_numbers,
        "streams": random_numbers.STREAMS,
    }
    facts = {
        "name": program.name,
        "sizes": program.sizes,
        "parameters": [name for name, _ in program.parameters],
        "coins": conditions.coins,
        "modes": conditions.modes,
        "lost": conditions.lost,
        "hypotheses": len(conditions.prior),
    }
    return SamplerSource(
        name=program.name,
        text=filled("sampler.c.j2", context),
        facts=json.dumps(facts),
        operations=len(program.operations),
    )


@dataclass(frozen=True, slots=True)
class _PhaseText:
    verb: str
    comment: str
    program: Phase
    reads: tuple[str, ...]
    body: str


def _read(phase: Phase) -> tuple[str, ...]:
    """Names of the arguments that a phase reads."""
    found = {
        operand.name
        for node in walk(phase.body)
        for operand in operands(node)
        if isinstance(operand, Element) and operand.space is Space.INPUT
    }
    return tuple(name for name in INPUTS if name in found)


def _cumulative(law: tuple[float, ...]) -> list[float]:
    """Sums up to each entry but the last: whatever has no probability gets none by rounding."""
    if not law:
        return []
    sums = np.cumsum(law)
    sums[np.flatnonzero(law)[-1] :] = 1.0
    return [float(value) for value in sums[:-1]]
