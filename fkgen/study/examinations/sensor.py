"""Sensor faults: what their law says, and what it leaves of the filter."""

from __future__ import annotations

import numpy as np

from fkgen.families import family
from fkgen.spec.chain import stationary_law, visited
from fkgen.study.examinations.figures import Figures, listed
from fkgen.study.examinations.findings import Finding, Part

_MODES = ("(1,1)", "(1,C)", "(0,1)", "(0,C)")

#: Rows of a kernel closer than this are equal.
_EQUAL = 1e-12


def caveats(figures: Figures) -> Part:
    """Where the filter is less than its name says: what its family knows about that."""
    spec = figures.spec
    return Part(family(spec.filter.family).caveats(spec))


def noise_factor(figures: Figures) -> Part:
    """A factor below one, or one that makes delta meaningless."""
    faults = figures.spec.faults.sensor
    if faults is None:
        return Part()
    factor = faults.noise_factor
    values = {"noise_factor": factor}
    if factor < 1.0:
        message = (
            f"noise_factor = {factor:g} is below 1: the fault delta = C makes the sensor better"
        )
        remedy = "state R of the better condition, and a factor above 1"
        return Part((Finding("noise_factor", "warning", message, factor, remedy),), values)
    return Part((), values)


def law(figures: Figures) -> Part:
    """Rates at the start and in the long run; modes that never come; modes of no memory."""
    spec, faults = figures.spec, figures.spec.faults.sensor
    if faults is None or not faults.kernel:
        return Part()
    kernel, initial = np.array(faults.kernel), np.array(faults.initial)
    values = {f"initial_probability.{m}": float(p) for m, p in zip(_MODES, initial, strict=True)}
    findings = []
    lasting = stationary_law(kernel)
    if lasting is not None:
        values["gamma_rate"] = float(lasting[:2].sum())
        values["delta_nominal_rate"] = float(lasting[[0, 2]].sum())
    never = [mode for mode, seen in zip(_MODES, visited(kernel, initial), strict=True) if not seen]
    if never:
        message = f"the modes {listed(never)} never come: their probability is exactly zero"
        remedy = "another initial, or a kernel that leads there, if they can happen"
        findings.append(Finding("impossible_mode", "note", message, len(never), remedy))
    if spec.filter.family == "imm" and np.ptp(kernel, axis=0).max() <= _EQUAL:
        message = "the rows of the kernel are equal: imm gives what one_step gives, at more cost"
        findings.append(
            Finding("no_memory", "note", message, None, 'family = "one_step" is cheaper')
        )
    return Part(tuple(findings), values)


def lost_signal(figures: Figures) -> Part:
    """An unstable plant under a linear filter: the second moment of the state acts as noise."""
    spec, faults = figures.spec, figures.spec.faults.sensor
    if faults is None or spec.filter.family != "linear_optimal":
        return Part()
    rate = faults.moments.gamma_rate if faults.moments is not None else _lowest_rate(figures)
    radius = float(np.abs(np.linalg.eigvals(figures.A)).max())
    if rate >= 1.0 - _EQUAL or radius < 1.0:
        return Part()
    message = (
        f"the plant is not stable (radius {radius:.4g}) and E[gamma] = {rate:.4g} is below 1: a"
        " lost signal counts as noise of the size of the state, which grows, and the error of a"
        " linear filter with it"
    )
    remedy = 'family = "imm" or "one_step"'
    return Part((Finding("unstable_linear", "warning", message, radius, remedy),))


def _lowest_rate(figures: Figures) -> float:
    faults = figures.spec.faults.sensor
    if faults is None:
        return 1.0
    lasting = stationary_law(faults.kernel)
    rates = [sum(faults.initial[:2])]
    return min(rates if lasting is None else [*rates, float(lasting[:2].sum())])
