"""Jumping plants: the chain, mean-square stability, the steady state, what a test can see."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import chdtrc, ndtr

from fkgen.families.mjls_lmmse import DEFAULT_ALPHA
from fkgen.faults import JumpFaults
from fkgen.faults.chain import MARGIN, is_ergodic, mean_square_radius
from fkgen.oracle.claims.jump import unobserved_chain
from fkgen.oracle.plants.jump import JumpSystem
from fkgen.oracle.textbook.jump import SteadyState, composite, stationary_jumps
from fkgen.problem import Spec
from fkgen.problem.probability import period, stationary_law, visited
from fkgen.study.diagnostics.dynamics import deviations
from fkgen.study.diagnostics.subject import Subject, listed

NEARLY_UNSTABLE = 0.999  # radii from here on take a thousand samples to forget the start
VISIBLE = 2.0  # deviations of the noise: signals closer to zero cannot be told from a loss
MANY = 0.5  # above this share of invisible losses a test is no help
ALARMS = 0.05  # above this rate of false alarms a filter that rejects them loses its track


def diagnose(model: Subject) -> None:
    """All that is special to a jumping plant and its filter."""
    spec, faults = model.spec, model.spec.faults.jump
    if faults is None:
        return
    dynamics = [mode.A.values(spec.defaults) for mode in faults.modes]
    radius = mean_square_radius(faults.transition, dynamics)
    chain(model)
    _stability(model, faults, radius)
    trusting = own = None
    if spec.filter.traits.moments:
        settles = radius < 1.0 - MARGIN
        alone = faults.gain_needs_no_moments(tested=not _detects_nothing(spec))
        if is_ergodic(faults.transition) and (settles or alone):
            trusting, own = (_steady(spec, faults, believing=each) for each in (True, False))
        if trusting is not None and own is not None:
            _steady_state(model, trusting, own)
        _innovation(model, own)
        trusting = trusting if settles else None
    rate = 1.0 if faults.arrival_rate is None else faults.arrival_rate
    if trusting is not None and faults.has_channel and rate < 1.0:
        _visibility(model, trusting)
    if spec.filter.option("detector", None) is not None:
        _detector(model)


def chain(model: Subject) -> None:
    """Does the distribution of the mode have a limit, and which modes never come."""
    faults = model.spec.faults.jump
    if faults is None:
        return
    P = faults.transition
    ergodic, law = is_ergodic(P), stationary_law(P)
    model.values["ergodic"] = float(ergodic)
    if law is None:
        model.add("not_ergodic.reducible")
    elif not ergodic:
        model.add("not_ergodic", float(period(P)))
    else:
        model.put("stationary_probability", range(len(law)), law)
    never = [str(i) for i, seen in enumerate(visited(P, faults.initial)) if not seen]
    if never:
        endings = {"plural": "s" * (len(never) > 1), "singular": "s" * (len(never) == 1)}
        model.add("impossible_mode.jump", len(never), names=listed(never), **endings)


def _stability(model: Subject, faults: JumpFaults, radius: float) -> None:
    """Do the second moments of the state have a limit."""
    model.values["mean_square_radius"] = radius
    if radius >= 1.0 - MARGIN:
        noise = faults.arrival == "unknown" and _detects_nothing(model.spec)
        model.add(f"not_mean_square_stable{'.noise' * noise}", radius)
    elif radius >= NEARLY_UNSTABLE:
        model.add("nearly_unstable", radius, samples=-1.0 / math.log(radius))


def _detects_nothing(spec: Spec) -> bool:
    return bool(spec.filter.option("detector", "none") == "none")


def _steady_state(model: Subject, trusting: SteadyState, own: SteadyState) -> None:
    """The steady state at u = 0: error of the filter, and what its innovation is expected."""
    n = model.spec.model.nx
    E = np.tile(np.eye(n, n + 1), len(own.covariance) // (n + 1))
    J1, J0 = trusting.expected_squares
    parts = np.arange(len(trusting.covariance)) % (n + 1) < n
    model.values |= {
        "closed_loop_radius": own.closed_loop_radius,
        "J1": J1,
        **({"J0": J0} if math.isfinite(J0) else {}),
        "stationary_trace": float(np.trace(trusting.covariance[np.ix_(parts, parts)])),
    }
    predicted, filtered = E @ own.covariance @ E.T, E @ own.filtered @ E.T
    for i, j in zip(*np.tril_indices(n), strict=True):
        model.values[f"stationary_covariance[{i}][{j}]"] = float(predicted[i, j])
        model.values[f"stationary_filtered_covariance[{i}][{j}]"] = float(filtered[i, j])
    deviations(model, predicted, filtered, "no row missing")


def _steady(spec: Spec, faults: JumpFaults, *, believing: bool) -> SteadyState | None:
    """The steady state, of a plant without inputs; ``believing`` takes y for good."""
    system = JumpSystem.from_spec(spec, 1).without_inputs()
    if not believing and unobserved_chain(spec):
        return stationary_jumps(composite(system)) if is_ergodic(faults.arrival_chain) else None
    doubtful = faults.arrival == "unknown" and _detects_nothing(spec)
    rate = 1.0 if believing or not doubtful else faults.arrival_rate
    return stationary_jumps(system, 1.0 if rate is None else rate)


def _innovation(model: Subject, steady: SteadyState | None) -> None:
    """Rank of S at the prior and in the steady state."""
    system = JumpSystem.from_spec(model.spec, 1)
    C = np.einsum("i,iab->ab", system.initial, system.C[0])
    own = system.C[0] - C
    spread = own @ (system.P0 + np.outer(system.x0, system.x0)) @ own.transpose(0, 2, 1)
    spread = np.einsum("i,iab->ab", system.initial, system.R[0] + spread)
    found = {"innovation_rank": C @ system.P0 @ C.T + spread}
    if steady is not None:
        found["innovation_rank_stationary"] = steady.innovation_covariance
    model.ranks(found, {})


def _visibility(model: Subject, steady: SteadyState) -> None:
    """How many losses find a predicted signal that looks like noise."""
    split, n = steady.split, model.spec.model.nx
    # The constant is a part of the state: its second moment with x is the mean of x.
    mean = split.L @ split.now[:, n :: n + 1].sum(axis=1)
    predicted = split.signal - split.L @ steady.covariance @ split.L.T
    spread = np.sqrt(np.maximum(np.diag(predicted) - mean**2, np.finfo(float).tiny))
    noise = VISIBLE * np.sqrt(np.diag(split.R))
    share = float((ndtr((noise - mean) / spread) - ndtr((-noise - mean) / spread)).min())
    model.values["invisible_losses"] = share
    many = share > MANY and not _detects_nothing(model.spec)
    model.add(f"invisible_losses{'.many' * many}", share, visible=VISIBLE)


def _detector(model: Subject) -> None:
    """What a test does to good samples, and options that it does not use."""
    options = model.spec.filter.options
    if options.detector != "nis" and options.alpha != DEFAULT_ALPHA:
        model.add("unused_alpha", options.alpha)
    if options.detector == "energy":
        freedom = model.spec.model.ny * options.window
        rate = float(chdtrc(freedom, options.kappa * freedom))
        model.values["false_alarm_rate"] = rate
        if rate > ALARMS:
            model.add("energy_rule", rate)
    if options.detector == "nis":
        model.values["false_alarm_rate"] = options.alpha
        model.add("one_hypothesis", options.alpha)
