"""Look at a model before anyone trusts it: can it be filtered, are there digits, what does it cost.

All numbers are for the default parameters, u = 0 (unless their name says otherwise) and all rows of
y present.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field

from fkgen.backend.lower import lower
from fkgen.families import family
from fkgen.problem import Spec
from fkgen.problem.finding import Finding, Severity
from fkgen.problem.spec import as_spec
from fkgen.runtime.compiler import LARGE
from fkgen.study.diagnostics import digits, dynamics, faults, jumps, start, visibility
from fkgen.study.diagnostics.subject import Subject, listed
from fkgen.study.reports.jsonable import json_text

__all__ = ["Finding", "Report", "check"]

_ORDER: tuple[Severity, ...] = ("error", "warning", "note")


@dataclass(frozen=True, slots=True)
class Report:
    """What a check found, worst first.

    Attributes
    ----------
    findings : tuple of Finding
    values : dict of str to float
        What was computed, at the default parameters: ``spectral_radius``, ``observability_rank``,
        ``closed_loop_radius``, ``stationary_sd.<state>`` ...
    """

    findings: tuple[Finding, ...]
    values: dict[str, float] = field(default_factory=dict)

    @property
    def sound(self) -> bool:
        """Whether there is no error."""
        return not any(finding.severity == "error" for finding in self.findings)

    def to_json(self) -> str:
        """Findings and values as JSON; a number that is not finite becomes null."""
        return json_text({"sound": self.sound, **asdict(self)})


def _caveats(model: Subject) -> None:
    """Where the filter is less than its name says: what its family knows about that."""
    model.findings.extend(family(model.spec.filter.family).caveats(model.spec))


def _parameters(model: Subject) -> None:
    """Parameters that nothing uses, and what they mean for the numbers."""
    unused = [p.name for p in model.spec.stated_parameters if p.name not in model.used]
    if unused:
        plural = "s" * (len(unused) > 1)
        model.add("unused_parameter", len(unused), plural=plural, names=listed(unused))
    moving = [f"{p.name} = {p.default:g}" for p in model.spec.parameters if p.name in model.used]
    if moving:
        model.add("time_varying", len(moving), names=listed(moving))


def _cost(model: Subject) -> None:
    """Operations of one step of the generated code."""
    program = lower(family(model.spec.filter.family).build(model.spec))
    calls = sum(n for op, n in program.operations.items() if op.is_function)
    model.values |= {"flops_per_step": float(program.flops), "calls_per_step": float(calls)}
    if program.statements > LARGE:
        model.add("large_code", program.statements)


_DIAGNOSTICS = (
    *(dynamics.stability, dynamics.observability, dynamics.excitation, dynamics.silence),
    *(dynamics.steady_state, dynamics.error_decay),
    *(visibility.states, visibility.sensors, visibility.inputs),
    *(digits.innovation, digits.conditioning, digits.rounding, digits.number_range),
    *(digits.float_suitability, start.start, faults.known_rate, faults.hypotheses, _caveats),
    *(faults.noise_factor, faults.distribution, faults.lost_signal, faults.compression_loss),
    *(_parameters, _cost),
)

#: Where every mode has matrices of its own, those of the model say little.
_OF_JUMPS = (jumps.diagnose, start.start, _caveats, _parameters, _cost)


def check(spec: Spec) -> Report:
    """Examine the model of a spec; nothing is built or written.

    Parameters
    ----------
    spec : Spec
        A spec that could be read; what cannot be is a `SpecError` before this.

    Returns
    -------
    Report
        Findings, worst first, and values by name.

    References
    ----------
    Anderson & Moore 1979, *Optimal Filtering*, sec. 4.4 and app. C: detectability, stabilisability
    and the Riccati equation. Costa, Fragoso & Marques 2005, ch. 3, for jumping plants. Strandt,
    Schneider & Yaz, eqs. (12), (15) and (22), for faults. Song & Hu 2019 for their effect, with the
    conditions of docs/fault-effects.md. Higham 2002, sec. 3.3: running error analysis.
    """
    model = Subject(as_spec(spec))
    for diagnose in _DIAGNOSTICS if spec.faults.jump is None else _OF_JUMPS:
        diagnose(model)
    worst_first = sorted(model.findings, key=lambda finding: _ORDER.index(finding.severity))
    return Report(tuple(worst_first), model.values)
