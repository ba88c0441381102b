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


def diagnose(model: ModelNumbers, report: ReportBuilder) -> None:
    """All that is special to a jumping plant and its filter."""
    spec, faults = model.spec, model.spec.faults.jump
    if faults is None:
        return
    A = [mode.A.values(spec.defaults) for mode in faults.modes]
    radius = mean_square_radius(faults.transition, A)
    _chain(faults, report)
    _stability(spec, faults, radius, report)
    trusting = own = None
    if spec.filter.traits.moments:
        if is_ergodic(faults.transition) and radius < 1.0 - MARGIN:
            trusting, own = (_steady(spec, faults, believing=each) for each in (True, False))
        if trusting is not None and own is not None:
            _steady_state(spec, trusting, own, report)
        _innovation(spec, own, report)
    rate = 1.0 if faults.arrival_rate is None else faults.arrival_rate
    if trusting is not None and faults.has_channel and rate < 1.0:
        _visibility(spec, trusting, report)
    if spec.filter.option("detector", None) is not None:
        _detector(spec, report)


def _chain(faults: JumpFaults, report: ReportBuilder) -> None:
    """Does the distribution of the mode have a limit, and which modes never come."""
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


def _stability(spec: Spec, faults: JumpFaults, radius: float, report: ReportBuilder) -> None:
    """Do the second moments of the state have a limit."""
    report.values["mean_square_radius"] = radius
    if radius >= 1.0 - MARGIN:
        message = (
            f"not mean-square stable: radius {radius:.6g}, the second moments of the state grow"
            " without bound"
        )
        if faults.arrival == "unknown" and _detects_nothing(spec):
            message += ", and where it is unknown what was lost they act as noise"
            remedy = "a detector, or arrival = 'known'"
            report.warning("not_mean_square_stable", message, radius, remedy)
        else:
            report.note("not_mean_square_stable", message, radius)
    elif radius >= NEARLY_UNSTABLE:
        message = (
            f"nearly not mean-square stable: radius {radius:.6g}, the second moments of the state"
            f" take {-1.0 / math.log(radius):.3g} samples to settle by a factor e"
        )
        report.warning("nearly_unstable", message, radius, "more damping")


def _detects_nothing(spec: Spec) -> bool:
    return bool(spec.filter.option("detector", "none") == "none")


def _steady_state(
    spec: Spec, trusting: SteadyState, own: SteadyState, report: ReportBuilder
) -> None:
    """The steady state at u = 0: error of the filter, and what its innovation is expected."""
    n = spec.model.nx
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
    deviations(spec, report, covariances, "no row missing", full=True)


def _steady(spec: Spec, faults: JumpFaults, *, believing: bool) -> SteadyState | None:
    """The steady state, of a plant without inputs; ``believing`` takes y for good."""
    system = JumpSystem.from_spec(spec, 1).without_inputs()
    if not believing and unobserved_chain(spec):
        return stationary_jumps(composite(system)) if is_ergodic(faults.arrival_chain) else None
    doubtful = faults.arrival == "unknown" and _detects_nothing(spec)
    rate = 1.0 if believing or not doubtful else faults.arrival_rate
    return stationary_jumps(system, 1.0 if rate is None else rate)


def _innovation(spec: Spec, steady: SteadyState | None, report: ReportBuilder) -> None:
    """Rank of S at the prior and in the steady state."""
    system = JumpSystem.from_spec(spec, 1)
    initial, P0 = system.initial, system.P0
    C = np.einsum("i,iab->ab", initial, system.C[0])
    spread = np.einsum("i,iab->ab", initial, system.R[0])
    for weight, own in zip(initial, system.C[0] - C, strict=True):
        shift = own @ system.x0
        spread = spread + weight * (own @ P0 @ own.T + np.outer(shift, shift))
    ranks = {"innovation_rank": numerical_rank(C @ P0 @ C.T + spread)}
    if steady is not None:
        ranks["innovation_rank_stationary"] = numerical_rank(steady.innovation_covariance)
    report.values |= {name: float(rank) for name, rank in ranks.items()}
    report.rank(min(ranks.values()), spec.model.ny)


def _visibility(spec: Spec, steady: SteadyState, report: ReportBuilder) -> None:
    """How many losses find a predicted signal that looks like noise."""
    split, n = steady.split, spec.model.nx
    # The constant is a part of the state: its second moment with x is the mean of x.
    mean = split.L @ split.now[:, n :: n + 1].sum(axis=1)
    predicted = split.signal - split.L @ steady.covariance @ split.L.T
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
    if share <= MANY or _detects_nothing(spec):
        report.note("invisible_losses", message, share)
    else:
        remedy = "measure from another zero, or filter without a detector"
        report.warning("invisible_losses", message, share, remedy)


def _detector(spec: Spec, report: ReportBuilder) -> None:
    """What a test does to good samples, and options that it does not use."""
    options = spec.filter.options
    if options.detector != "nis" and options.alpha != DEFAULT_ALPHA:
        message = f"nothing uses alpha = {options.alpha:g}: it is the false alarm rate of nis"
        report.note("unused_alpha", message, options.alpha)
    remedy = "detector = 'llr', which tests both hypotheses"
    if options.detector == "energy":
        freedom = spec.model.ny * options.window
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
