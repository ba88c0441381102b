"""Look at a model before anyone trusts it: can it be filtered, are there digits, what does it cost.

All figures are for the default parameters, u = 0 (unless their name says otherwise) and all rows of
y present.
"""

from __future__ import annotations

from fkgen.spec import Spec
from fkgen.study import dynamics, faults, noise, partial, sensor, size
from fkgen.study.figures import Figures
from fkgen.study.findings import Finding, Report, combined

__all__ = ["Finding", "Report", "check"]

_EXAMINATIONS = (
    dynamics.stability,
    dynamics.observability,
    dynamics.excitation,
    dynamics.silence,
    dynamics.rest,
    noise.innovation,
    noise.conditioning,
    noise.rounding,
    noise.number_range,
    faults.known_rate,
    faults.hypotheses,
    faults.identification,
    faults.floor,
    sensor.caveats,
    sensor.noise_factor,
    sensor.law,
    sensor.lost_signal,
    partial.compression_loss,
    size.parameters,
    size.cost,
)


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
    and the Riccati equation. Strandt, Schneider & Yaz, eqs. (12), (15) and (22), for faults.
    """
    figures = Figures(spec)
    return combined([examine(figures) for examine in _EXAMINATIONS])
