"""What the filter costs, and what of the spec it does not use."""

from __future__ import annotations

from fkgen.backend.lower import lower
from fkgen.families import family
from fkgen.problem import Spec, names
from fkgen.runtime.compiler import LARGE
from fkgen.study.diagnostics.findings import ReportBuilder
from fkgen.study.diagnostics.model_numbers import ModelNumbers, listed


def cost(model: ModelNumbers, report: ReportBuilder) -> None:
    """Operations of one step of the generated code."""
    spec = model.spec
    program = lower(family(spec.filter.family).build(spec))
    calls = sum(n for op, n in program.operations.items() if op.is_function)
    report.values |= {"flops_per_step": float(program.flops), "calls_per_step": float(calls)}
    if program.flops > LARGE:
        message = (
            f"one step has {program.flops} operations: as straight-line C that is a large file, "
            "slow to compile and slow in the instruction cache"
        )
        remedy = "zeros in A and C cost nothing: look for a basis with more of them"
        report.warning("large_code", message, program.flops, remedy)


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


def parameters(model: ModelNumbers, report: ReportBuilder) -> None:
    """Parameters that nothing uses, and what they mean for the numbers."""
    spec, used = model.spec, used_parameters(model.spec)
    unused = [p.name for p in spec.stated_parameters if p.name not in used]
    if unused:
        message = f"nothing uses the parameter{'s' * (len(unused) > 1)} {listed(unused)}"
        remedy = "take out of [parameters], or use in a matrix"
        report.warning("unused_parameter", message, len(unused), remedy)
    moving = [f"{p.name} = {p.default:g}" for p in spec.parameters if p.name in used]
    if moving:
        message = f"the model changes with its parameters; all figures are for {listed(moving)}"
        report.note("time_varying", message, len(moving))
