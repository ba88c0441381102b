"""Jumping plants: the chain, mean-square stability, the steady state, what a test can see."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import chdtrc, ndtr

from fkgen.faults import JumpFaults
from fkgen.faults.jump_filter import MARGIN, is_ergodic, mean_square_radius
from fkgen.oracle import JumpSystem, SteadyState, composite, stationary_jumps
from fkgen.oracle.claims.jump import unobserved_chain
from fkgen.problem.filter import DEFAULT_ALPHA
from fkgen.problem.probability import period, stationary_law, visited
from fkgen.study.diagnostics.dynamics import deviations
from fkgen.study.diagnostics.findings import ReportBuilder
from fkgen.study.diagnostics.model_numbers import ModelNumbers, listed
from fkgen.study.diagnostics.visibility import numerical_rank

#: Radii from here on take a thousand samples to forget where the moments started.
NEARLY_UNSTABLE = 0.999
#: Signals closer to zero than this many deviations of the noise cannot be told from a loss.
VISIBLE = 2.0
#: Above this share of invisible losses a test is no help.
MANY = 0.5
#: Above this rate of false alarms a filter that rejects them loses its track.
ALARMS = 0.05


def chain(model: ModelNumbers, report: ReportBuilder) -> None:
    """Does the distribution of the mode have a limit, and which modes never come."""
    faults = model.spec.faults.jump
    if faults is None:
        return
    P = faults.transition
    ergodic, law = is_ergodic(P), stationary_law(P)
    report.values["ergodic"] = float(ergodic)
    if law is None:
        message = "the chain has several stationary laws: where it starts decides where it stays"
        report.note("not_ergodic", message, None)
    elif not ergodic:
        message = f"the chain goes round in {period(P)} steps: its law has no limit"
        report.note("not_ergodic", message, float(period(P)))
    else:
        report.values |= {f"stationary_probability.{i}": float(p) for i, p in enumerate(law)}
    never = [str(i) for i, seen in enumerate(visited(P, faults.initial)) if not seen]
    if never:
        plural = "s" * (len(never) > 1)
        message = f"the mode{plural} {listed(never)} never come{'' if plural else 's'}"
        remedy = "another initial, or a transition that leads there, if it can happen"
        report.note("impossible_mode", message, len(never), remedy)


def radius(model: ModelNumbers, report: ReportBuilder) -> None:
    """Do the second moments of the state have a limit."""
    faults = model.spec.faults.jump
    if faults is None:
        return
    found = _radius(model, faults)
    report.values["mean_square_radius"] = found
    if found >= 1.0 - MARGIN:
        message = (
            f"not mean-square stable: radius {found:.6g}, the second moments of the state grow"
            " without bound"
        )
        if faults.arrival == "unknown" and model.spec.filter.detector == "none":
            message += ", and where it is unknown what was lost they act as noise"
            remedy = "a detector, or arrival = 'known'"
            report.warning("not_mean_square_stable", message, found, remedy)
        else:
            report.note("not_mean_square_stable", message, found)
    elif found >= NEARLY_UNSTABLE:
        message = (
            f"nearly not mean-square stable: radius {found:.6g}, the second moments of the state"
            f" take {-1.0 / math.log(found):.3g} samples to settle by a factor e"
        )
        report.warning("nearly_unstable", message, found, "more damping")


def _radius(model: ModelNumbers, faults: JumpFaults) -> float:
    defaults = model.spec.defaults
    return mean_square_radius(faults.transition, [m.A.values(defaults) for m in faults.modes])


def steady_state(model: ModelNumbers, report: ReportBuilder) -> None:
    """The steady state at u = 0: error of the filter, and what its innovation is expected."""
    trusting, own = _steady(model, believing=True), _steady(model, believing=False)
    if trusting is None or own is None:
        return
    n = model.spec.model.nx
    E = np.tile(np.eye(n, n + 1), len(own.covariance) // (n + 1))
    J1, J0 = trusting.expected_squares
    parts = np.arange(len(trusting.covariance)) % (n + 1) < n
    report.values |= {
        "closed_loop_radius": own.closed_loop_radius,
        "J1": J1,
        "J0": J0,
        "stationary_trace": float(np.trace(trusting.covariance[np.ix_(parts, parts)])),
    }
    covariances = E @ own.covariance @ E.T, E @ own.filtered @ E.T
    deviations(model.spec, report, covariances, "no row missing", full=True)


def _steady(model: ModelNumbers, *, believing: bool) -> SteadyState | None:
    """The steady state, of a plant without inputs; ``believing`` takes y for good."""
    spec, faults = model.spec, model.spec.faults.jump
    if faults is None or spec.filter.family != "mjls_lmmse" or not is_ergodic(faults.transition):
        return None
    if _radius(model, faults) >= 1.0 - MARGIN:
        return None
    system = JumpSystem.from_spec(spec, 1).without_inputs()
    if not believing and unobserved_chain(spec):
        return stationary_jumps(composite(system)) if is_ergodic(faults.arrival_chain) else None
    doubtful = faults.arrival == "unknown" and spec.filter.detector == "none"
    return stationary_jumps(system, 1.0 if believing or not doubtful else _rate(faults))


def _rate(faults: JumpFaults) -> float:
    return 1.0 if faults.arrival_rate is None else faults.arrival_rate


def innovation(model: ModelNumbers, report: ReportBuilder) -> None:
    """Rank of S at the prior and in the steady state."""
    spec, faults = model.spec, model.spec.faults.jump
    if faults is None or spec.filter.family != "mjls_lmmse":
        return
    system, p = JumpSystem.from_spec(spec, 1), spec.model.ny
    initial, P0 = system.initial, system.P0
    C = np.einsum("i,iab->ab", initial, system.C[0])
    spread = np.einsum("i,iab->ab", initial, system.R[0])
    for weight, own in zip(initial, system.C[0] - C, strict=True):
        shift = own @ system.x0
        spread = spread + weight * (own @ P0 @ own.T + np.outer(shift, shift))
    ranks = {"innovation_rank": numerical_rank(C @ P0 @ C.T + spread)}
    steady = _steady(model, believing=False)
    if steady is not None:
        ranks["innovation_rank_stationary"] = numerical_rank(steady.innovation_covariance)
    report.values |= {name: float(rank) for name, rank in ranks.items()}
    report.rank(min(ranks.values()), p)


def visibility(model: ModelNumbers, report: ReportBuilder) -> None:
    """How many losses find a predicted signal that looks like noise."""
    faults, found = model.spec.faults.jump, _steady(model, believing=True)
    if faults is None or found is None or not (faults.has_channel and _rate(faults) < 1.0):
        return
    split, n = found.split, model.spec.model.nx
    # The constant is a part of the state: its second moment with x is the mean of x.
    mean = split.L @ split.now[:, n :: n + 1].sum(axis=1)
    predicted = split.signal - split.L @ found.covariance @ split.L.T
    shares = []
    for i, center in enumerate(mean):
        noise = math.sqrt(split.R[i, i])
        spread = math.sqrt(max(predicted[i, i] - center**2, 0.0))
        if spread > 0.0:
            low, high = (VISIBLE * s * noise - center for s in (-1.0, 1.0))
            shares.append(float(ndtr(high / spread) - ndtr(low / spread)))
        else:
            shares.append(float(abs(center) < VISIBLE * noise))
    share = min(shares)
    report.values["invisible_losses"] = share
    message = (
        f"about {share:.1%} of losses are invisible: the predicted signal is then within"
        f" {VISIBLE:g} noise deviations of zero"
    )
    if share <= MANY or model.spec.filter.detector == "none":
        report.note("invisible_losses", message, share)
    else:
        remedy = "measure from another zero, or filter without a detector"
        report.warning("invisible_losses", message, share, remedy)


def detector(model: ModelNumbers, report: ReportBuilder) -> None:
    """What a test does to good samples, and options that it does not use."""
    options = model.spec.filter
    unused = options.family == "mjls_lmmse" and options.detector != "nis"
    if unused and options.alpha != DEFAULT_ALPHA:
        message = f"nothing uses alpha = {options.alpha:g}: it is the false alarm rate of nis"
        report.note("unused_alpha", message, options.alpha)
    remedy = "detector = 'llr', which tests both hypotheses"
    if options.detector == "energy":
        freedom = model.spec.model.ny * options.window
        rate = float(chdtrc(freedom, options.kappa * freedom))
        report.values["false_alarm_rate"] = rate
        message = (
            f"the energy rule rejects {rate:.1%} of good samples even where nothing was lost"
            " (Gaussian rows of one size); with what it rejects the prediction drifts, and more is"
            " rejected"
        )
        if rate > ALARMS:
            report.warning("energy_rule", message, rate, remedy)
    if options.detector == "nis":
        report.values["false_alarm_rate"] = options.alpha
        message = (
            "nis tests one hypothesis: after rejections its gate opens, and a lost sample near"
            " zero is taken for a good one"
        )
        report.note("one_hypothesis", message, options.alpha, remedy)
