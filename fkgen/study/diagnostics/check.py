"""Look at a model before anyone trusts it: can it be filtered, are there digits, what does it cost.

All numbers are for the default parameters, u = 0 (unless their name says otherwise) and all rows of
y present.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from numpy.typing import ArrayLike

from fkgen.backend.lower import lower
from fkgen.errors import DataError, SpecError, UnfitError
from fkgen.families import family
from fkgen.problem import Spec
from fkgen.problem.finding import Finding, Severity
from fkgen.problem.spec import as_spec
from fkgen.runtime.compiler import LARGE
from fkgen.study.diagnostics import (
    curvature,
    digits,
    dynamics,
    faults,
    jumps,
    start,
    trajectory,
    visibility,
)
from fkgen.study.diagnostics.subject import Subject, listed
from fkgen.study.records.reading import Reading
from fkgen.study.records.table import Say, constants_or_record
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
    model.findings.extend(family(model.spec.filter.family).remarks(model.spec))


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
    try:
        apart = replace(model.spec, code=replace(model.spec.code, decoupled=True))
        fewer = lower(family(apart.filter.family).build(apart)).flops
    except SpecError:  # the state is coupled as a whole
        return
    if fewer < program.flops:
        model.add("decoupled", fewer, whole=program.flops)


def _functions(model: Subject, given: Mapping[str, Any]) -> None:
    """The questions about a plant with f and h."""
    for diagnose in _OF_FUNCTIONS:
        diagnose(model)
    drive = trajectory.drive_of(model.spec, **given)
    try:
        path = trajectory.Trajectory(model.spec, drive)
    except UnfitError:  # which is a finding by now
        return
    for examine in _ON_THE_WAY:
        examine(model, path)


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

#: Of plants with f and h, matrices there are none: what says something without them.
_OF_FUNCTIONS = (
    *(digits.perfect_measurements, digits.number_range, start.start, faults.known_rate),
    *(faults.hypotheses, _caveats, faults.noise_factor, faults.distribution, jumps.chain),
    *(_parameters, _cost),
)
#: And what is found along a trajectory.
_ON_THE_WAY = (
    *(trajectory.spread, trajectory.observability, curvature.nonlinearity),
    *(curvature.inputs, curvature.integration),
)


def check(
    spec: Spec,
    *,
    y: ArrayLike | None = None,
    u: ArrayLike | None = None,
    params: Mapping[str, ArrayLike] | None = None,
) -> Report:
    """Examine the model of a spec; nothing is built or written.

    Parameters
    ----------
    spec : Spec
        A spec that could be read; what cannot be is a `SpecError` before this.
    y, u, params : (T, p), (T, q) array_like, mapping
        A record along which a plant with f and h is linearised, as for `run`, of which the first
        thousand samples are looked at. Without y a trial is drawn, with u constant (q,) or (T, q);
        zero by default. A plant of matrices is the same everywhere: it takes none of them.

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
    if model.curved:
        _functions(model, {"y": y, "u": u, "params": params})
    elif any(each is not None for each in (y, u, params)):
        given, expected = "a record", "none: matrices are the same wherever the plant is"
        raise DataError("check", given=given, expected=expected)
    for diagnose in () if model.curved else _OF_JUMPS if spec.faults.jump else _DIAGNOSTICS:
        diagnose(model)
    worst_first = sorted(model.findings, key=lambda finding: _ORDER.index(finding.severity))
    return Report(tuple(worst_first), model.values)


def checked(spec: Spec, *, record: Reading | None, inputs: str, say: Say) -> Report:
    """The report of the command: with a record, or constant inputs."""
    constants, table = constants_or_record(spec, inputs, record, say)
    if table is None:
        return check(spec, u=constants)
    if len(table.y) > trajectory.LONGEST and spec.filter.linearises:
        say("note", [f"{table.samples} samples: the first {trajectory.LONGEST} are looked at"])
    return check(spec, y=table.y, u=table.u if spec.model.nu else None, params=table.params)
