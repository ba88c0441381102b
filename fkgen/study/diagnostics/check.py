"""Look at a model before anyone trusts it: can it be filtered, are there digits, what does it cost.

All numbers are for the default parameters, u = 0 (unless their name says otherwise) and all rows of
y present.
"""

from __future__ import annotations

from fkgen.problem import Spec
from fkgen.problem.finding import Finding
from fkgen.study.diagnostics import (
    dynamics,
    faults,
    jumps,
    noise,
    rounding,
    size,
    visibility,
)
from fkgen.study.diagnostics.findings import Report, ReportBuilder
from fkgen.study.diagnostics.model_numbers import ModelNumbers

__all__ = ["Finding", "Report", "check"]

_DIAGNOSTICS = (
    dynamics.stability,
    dynamics.observability,
    dynamics.excitation,
    dynamics.silence,
    dynamics.steady_state,
    dynamics.error_decay,
    visibility.states,
    visibility.sensors,
    visibility.inputs,
    noise.innovation,
    noise.conditioning,
    noise.rounding,
    noise.number_range,
    rounding.float_suitability,
    faults.known_rate,
    faults.hypotheses,
    faults.caveats,
    faults.noise_factor,
    faults.distribution,
    faults.lost_signal,
    faults.compression_loss,
    size.parameters,
    size.cost,
)

#: Where every mode has matrices of its own, those of the model say little.
_OF_JUMPS = (jumps.diagnose, faults.caveats, size.parameters, size.cost)


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
    model, report = ModelNumbers(spec), ReportBuilder()
    for diagnose in _DIAGNOSTICS if spec.faults.jump is None else _OF_JUMPS:
        diagnose(model, report)
    return report.report()
