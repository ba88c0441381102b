"""What the filter costs, and what of the spec it does not use."""

from __future__ import annotations

from fkgen.backend.lower import lower
from fkgen.families import family
from fkgen.problem import Spec, names
from fkgen.runtime.compiler import LARGE
from fkgen.study.diagnostics.findings import Finding, Part
from fkgen.study.diagnostics.model_numbers import Figures, listed


def cost(figures: Figures) -> Part:
    """Operations of one step of the generated code."""
    spec = figures.spec
    program = lower(family(spec.filter.family).build(spec))
    values = {
        "flops_per_step": float(program.flops),
        "calls_per_step": float(sum(n for op, n in program.operations.items() if op.is_function)),
    }
    if program.flops <= LARGE:
        return Part((), values)
    message = (
        f"one step has {program.flops} operations: as straight-line C that is a large file, slow "
        "to compile and slow in the instruction cache"
    )
    remedy = "zeros in A and C cost nothing: look for a basis with more of them"
    return Part((Finding("large_code", "warning", message, program.flops, remedy),), values)


def used_parameters(spec: Spec) -> frozenset[str]:
    """Names of the parameters on which the filter depends."""
    faults, plants = spec.faults.actuator, spec.plants
    used = frozenset().union(
        *(getattr(plant, x).names for plant in plants for x in ("A", "B", "C", "D", "Q", "R"))
    )
    if spec.faults.jump is not None:
        used = used.union(*(mode.c.names for mode in spec.faults.jump.modes))
    if faults is not None and spec.first_rates is None:
        used = used.union(*(names(rate) for rate in faults.success_rate))
        used |= faults.covariance.names if faults.covariance is not None else frozenset()
    return used


def parameters(figures: Figures) -> Part:
    """Parameters that nothing uses, and what they mean for the figures."""
    spec = figures.spec
    used = used_parameters(spec)
    findings = []
    unused = [p.name for p in spec.stated_parameters if p.name not in used]
    if unused:
        message = f"nothing uses the parameter{'s' * (len(unused) > 1)} {listed(unused)}"
        remedy = "take out of [parameters], or use in a matrix"
        findings.append(Finding("unused_parameter", "warning", message, len(unused), remedy))
    moving = [f"{p.name} = {p.default:g}" for p in spec.parameters if p.name in used]
    if moving:
        message = f"the model changes with its parameters; all figures are for {listed(moving)}"
        findings.append(Finding("time_varying", "note", message, len(moving)))
    return Part(tuple(findings))
