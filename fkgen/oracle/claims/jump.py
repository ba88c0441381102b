"""Closed forms for filters of jumping plants: every path of modes, and whole matrices."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fkgen.oracle.claims.claim import ClosedForm, Ports, Record, ports
from fkgen.oracle.claims.gaussian import EXACT, RANK_DEFICIENT, has_exact_rows, undecided
from fkgen.oracle.exact.paths import JumpResult, enumerate_paths
from fkgen.oracle.plants.jump import JumpSystem
from fkgen.oracle.textbook.jump import SteadyState, composite, stationary_jumps, textbook_jumps
from fkgen.oracle.textbook.loss_tests import VERDICT, LossTest
from fkgen.problem import Spec

#: Paths of modes that are written side by side.
MANY_PATHS = 1000

#: Rounding of some thirty roundings of every entry; the errors found stay below a tenth of this.
LOST_DIGITS = 30.0 * float(np.finfo(float).eps)

#: A comparison that allows a larger error than this decides nothing.
NO_DIGITS = 1e-3


def jump_system(spec: Spec, record: Record) -> JumpSystem:
    """The plant of a record as the filter understands it."""
    system = JumpSystem.from_spec(spec, len(record.y), record.parameters)
    faults = spec.faults.jump
    unknown = faults is not None and faults.arrival == "unknown"
    if not unknown or spec.filter.options.detector != "none":
        system = system.always_arriving()
    return replace(system, P0=record.P0)


def loss_test(spec: Spec, record: Record | None = None) -> LossTest | None:
    """The test of a spec, with nothing seen yet."""
    faults = spec.faults.jump
    if faults is None or spec.filter.options.detector == "none":
        return None
    rate = 1.0 if faults.arrival_rate is None else faults.arrival_rate
    varying = None
    if record is not None:
        varying = JumpSystem.from_spec(spec, len(record.y), record.parameters).arrival_rates
    return LossTest(options=spec.filter.options, rate=rate, rates=varying)


def unobserved_chain(spec: Spec) -> bool:
    """Whether gamma is a Markov chain that the filter does not see."""
    faults = spec.faults.jump
    if faults is None or spec.filter.options.detector != "none" or faults.arrival != "unknown":
        return False
    return bool(faults.arrival_chain)


def steady_state(spec: Spec, system: JumpSystem) -> SteadyState | None:
    """Where the filter of a spec comes to rest; ``system`` is what it takes the plant for."""
    chain = unobserved_chain(spec)
    rate = float(system.arrival_initial[1])
    return stationary_jumps(composite(system)) if chain else stationary_jumps(system, rate)


def _ports(spec: Spec, result: JumpResult) -> Ports:
    undetected = VERDICT if spec.filter.options.detector == "none" else ()
    found = ports(result, *undetected, *undecided(spec))
    if np.isinf(found.get("test_statistic", 0.0)).any():
        del found["test_statistic"]  # a rate of 0 or 1: the filter has a large number for infinity
    return found


def _by_paths(spec: Spec, record: Record) -> tuple[JumpSystem, JumpResult]:
    """Projections over as many samples as there can be paths of."""
    system = jump_system(spec, record)
    samples = int(np.log(MANY_PATHS) / np.log(max(2, system.count)))
    T = max(1, min(samples, system.length))
    system = system.over(slice(T))
    return system, enumerate_paths(system, record.y[:T], record.u[:T], loss_test(spec, record))


def _paths(spec: Spec, record: Record) -> Ports | None:
    if spec.filter.options.gain == "stationary":
        return None
    return _ports(spec, _by_paths(spec, record)[1])


def _tolerance(spec: Spec, record: Record) -> float:
    """Digits that S costs beside R: what a sample may have to take away from an estimate."""
    if has_exact_rows(spec):
        return RANK_DEFICIENT
    system, found = _by_paths(spec, record)
    S, R = (
        np.diagonal(each, axis1=-2, axis2=-1) for each in (found.innovation_covariance, system.R)
    )
    lost = LOST_DIGITS * np.max(S / R.min(axis=1))
    return float(min(max(EXACT, lost), NO_DIGITS))


def _textbook(spec: Spec, record: Record) -> Ports | None:
    system, chain = jump_system(spec, record), unobserved_chain(spec)
    stationary = spec.filter.options.gain == "stationary"
    steady = steady_state(spec, system) if stationary else None
    if (stationary and steady is None) or _difference_tolerance(spec, record) > NO_DIGITS:
        return None
    plant, test = composite(system) if chain else system, loss_test(spec, record)
    result = textbook_jumps(plant, record.y, record.u, test=test, steady=steady)
    if chain:
        law = result.mode_law.reshape(len(record.y), 2, -1).sum(axis=1)
        result = replace(result, mode_law=law)
    return _ports(spec, result)


def _difference_tolerance(spec: Spec, record: Record) -> float:
    """The same, and what is left of V as a difference of second moments of the state."""
    if has_exact_rows(spec):
        return RANK_DEFICIENT
    system = jump_system(spec, record)
    x0 = system.x0
    growth = np.abs(system.A).sum(axis=-1).max() ** 2
    state = np.trace(system.P0) + x0 @ x0 + np.trace(system.Q, axis1=-2, axis2=-1).max()
    added = np.abs(system.offsets(record.u)[0]).max() ** 2
    signal = np.abs(system.C).max() ** 2 * (state + added) * max(1.0, growth)
    noise = np.diagonal(system.R, axis1=-2, axis2=-1).min()
    return float(max(EXACT, 10.0 * LOST_DIGITS * signal / noise))


PATHS = ClosedForm(
    claim="estimates are the best linear ones: projections over all paths of modes and arrivals",
    source="projection on exact second moments, path by path",
    tolerance=_tolerance,
    expected=_paths,
)
TEXTBOOK = ClosedForm(
    claim="estimates and covariances are those of whole matrices over the split state",
    source="Costa 1994; Sun, Zhao & Yin, Lemma 3 and Theorem 6",
    tolerance=_difference_tolerance,
    expected=_textbook,
)
