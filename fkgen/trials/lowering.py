"""A sampling, lowered and printed: C that draws trials of a plant, for Python only."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np

from fkgen.backend.ir import Element, Operate, Operator, Phase, Require, Space, every, read
from fkgen.backend.lower import lower_phase
from fkgen.backend.printer import StatementPrinter
from fkgen.backend.render import elementary_context, filled
from fkgen.symbolic.interface import Kind, Status
from fkgen.trials import random_numbers
from fkgen.trials.sampling import INPUTS, Sampling
from fkgen.version import __version__

#: The phases in the order in which they run, and what each of them computes.
_PHASES = (
    ("start", "x[0]"),
    ("law", "probabilities of coins, summed up"),
    ("measure", "y[k]"),
    ("move", "x[k+1]"),
)

#: What normal numbers need.
_NORMAL = {Operator.LOG, Operator.SQRT}


@dataclass(frozen=True, eq=False, kw_only=True)
class SamplerSource:
    """Generated C of one sampler, and the facts (JSON) that Python needs to call it."""

    name: str
    text: str
    facts: str
    operations: int


def render_sampler(sampling: Sampling) -> SamplerSource:
    """Lower and print a sampling; the truth is always computed in double."""
    spec, conditions = sampling.spec, sampling.conditions
    sizes = spec.model.nx, spec.model.nu, spec.model.ny
    c = StatementPrinter(spec.name, "double", sizes[2])
    lowered = [
        (verb, comment, lower_phase(sampling.ports, getattr(sampling, verb), INPUTS))
        for verb, comment in _PHASES
    ]
    body = tuple(node for _, _, phase in lowered for node in phase.body)
    operations = [node.operator for node in every(Operate, body)]
    functions = {operator for operator in operations if operator.is_function}
    context = elementary_context(c, frozenset(functions | _NORMAL)) | {
        "parameters": [(p.name, p.default) for p in spec.stated_parameters],
        "ports": sampling.ports,
        "version": __version__,
        "tests_finiteness": any(n.kind is Kind.FINITE for n in every(Require, body)),
        "n": sizes[0],
        "q": sizes[1],
        "p": sizes[2],
        "conditions": conditions,
        "indicators": len(conditions.indicators[0]) if conditions.indicators else 0,
        "initial": _cumulative(conditions.initial),
        "kernel": [_cumulative(row) for row in conditions.kernel],
        "prior": _cumulative(conditions.prior),
        "phases": [
            _PhaseText(verb, comment, phase, _read(phase), c.block(phase.body))
            for verb, comment, phase in lowered
        ],
        "statuses": (Status.OK, Status.PARAMETER_OUT_OF_RANGE, Status.RESULT_NOT_FINITE),
        "numbers": random_numbers,
        "streams": random_numbers.STREAMS,
    }
    facts = {
        "name": spec.name,
        "sizes": sizes,
        "parameters": [parameter.name for parameter in spec.stated_parameters],
        "coins": conditions.coins,
        "modes": conditions.modes,
        "lost": conditions.lost,
        "hypotheses": len(conditions.prior),
    }
    return SamplerSource(
        name=spec.name,
        text=filled("sampler.c.j2", context),
        facts=json.dumps(facts),
        operations=len(operations),
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
    found = {each.name for each in read(Element, phase.body) if each.space is Space.INPUT}
    return tuple(name for name in INPUTS if name in found)


def _cumulative(law: tuple[float, ...]) -> list[float]:
    """Sums up to each entry but the last: whatever has no probability gets none by rounding."""
    if not law:
        return []
    sums = np.cumsum(law)
    sums[np.flatnonzero(law)[-1] :] = 1.0
    return [float(value) for value in sums[:-1]]
