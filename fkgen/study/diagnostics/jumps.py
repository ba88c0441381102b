"""Jumping plants: the chain, mean-square stability, where the filter rests, what a test can see."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import chdtrc, ndtr

from fkgen.families.mjls_lmmse import DEFAULT_ALPHA
from fkgen.faults import JumpFaults
from fkgen.faults.jump_filter import MARGIN, is_ergodic, mean_square_radius
from fkgen.oracle import JumpSystem, SteadyState, composite, stationary_jumps
from fkgen.oracle.claims.jump import unobserved_chain
from fkgen.problem.probability import period, stationary_law, visited
from fkgen.study.diagnostics.findings import Finding, Part
from fkgen.study.diagnostics.model_numbers import Figures, listed
from fkgen.study.diagnostics.visibility import numerical_rank

#: Radii from here on take a thousand samples to forget where the moments started.
NEARLY_UNSTABLE = 0.999

#: Signals closer to zero than this many deviations of the noise cannot be told from a loss.
VISIBLE = 2.0

#: Above this share of invisible losses a test is no help.
MANY = 0.5

#: Above this rate of false alarms a filter that rejects them loses its track.
ALARMS = 0.05


def chain(figures: Figures) -> Part:
    """Does the law of the mode have a limit, and which modes never come."""
    faults = figures.spec.faults.jump
    if faults is None:
        return Part()
    P, findings = faults.transition, []
    ergodic = is_ergodic(P)
    values = {"ergodic": float(ergodic)}
    law = stationary_law(P)
    if law is None:
        message = "the chain has several stationary laws: where it starts decides where it stays"
        findings.append(Finding("not_ergodic", "note", message, None))
    elif not ergodic:
        message = f"the chain goes round in {period(P)} steps: its law has no limit"
        findings.append(Finding("not_ergodic", "note", message, float(period(P))))
    else:
        values |= {f"stationary_probability.{i}": float(p) for i, p in enumerate(law)}
    never = [str(i) for i, seen in enumerate(visited(P, faults.initial)) if not seen]
    if never:
        plural = "s" * (len(never) > 1)
        message = f"the mode{plural} {listed(never)} never come{'' if plural else 's'}"
        remedy = "another initial, or a transition that leads there, if it can happen"
        findings.append(Finding("impossible_mode", "note", message, len(never), remedy))
    return Part(tuple(findings), values)


def radius(figures: Figures) -> Part:
    """Do the second moments of the state have a limit."""
    faults = figures.spec.faults.jump
    if faults is None:
        return Part()
    found = _radius(figures, faults)
    values = {"mean_square_radius": found}
    if found >= 1.0 - MARGIN:
        message = (
            f"not mean-square stable: radius {found:.6g}, the second moments of the state grow"
            " without bound"
        )
        if faults.arrival == "unknown" and figures.spec.filter.option("detector", "none") == "none":
            message += ", and where it is unknown what was lost they act as noise"
            remedy = "a detector, or arrival = 'known'"
            return Part(
                (Finding("not_mean_square_stable", "warning", message, found, remedy),), values
            )
        return Part((Finding("not_mean_square_stable", "note", message, found),), values)
    if found < NEARLY_UNSTABLE:
        return Part((), values)
    samples = -1.0 / math.log(found)
    message = (
        f"nearly not mean-square stable: radius {found:.6g}, the second moments of the state take"
        f" {samples:.3g} samples to settle by a factor e"
    )
    return Part((Finding("nearly_unstable", "warning", message, found, "more damping"),), values)


def _radius(figures: Figures, faults: JumpFaults) -> float:
    defaults = figures.spec.defaults
    return mean_square_radius(faults.transition, [m.A.values(defaults) for m in faults.modes])


def rest(figures: Figures) -> Part:
    """Where the filter comes to rest at u = 0: its error, and what its innovation is expected."""
    spec, trusting = figures.spec, _at_rest(figures, believing=True)
    own = _at_rest(figures, believing=False)
    if trusting is None or own is None:
        return Part()
    n = spec.model.nx
    E = np.tile(np.eye(n, n + 1), len(own.covariance) // (n + 1))
    J1, J0 = trusting.expected_squares
    parts = np.arange(len(trusting.covariance)) % (n + 1) < n
    values = {
        "closed_loop_radius": own.closed_loop_radius,
        "J1": J1,
        "J0": J0,
        "stationary_trace": float(np.trace(trusting.covariance[np.ix_(parts, parts)])),
    }
    predicted, filtered = E @ own.covariance @ E.T, E @ own.filtered @ E.T
    texts = []
    for i, signal in enumerate(spec.model.states):
        for j in range(i + 1):
            values[f"stationary_covariance[{i}][{j}]"] = float(predicted[i, j])
            values[f"stationary_filtered_covariance[{i}][{j}]"] = float(filtered[i, j])
        deviation = math.sqrt(max(filtered[i, i], 0.0))
        values[f"stationary_sd.{signal.name}"] = deviation
        values[f"stationary_predicted_sd.{signal.name}"] = math.sqrt(max(predicted[i, i], 0.0))
        texts.append(f"{signal.name} {deviation:.3g} {signal.unit}".rstrip())
    message = "standard deviation of the filtered state at rest, no row missing: "
    return Part((Finding("stationary_sd", "note", message + ", ".join(texts)),), values)


def _at_rest(figures: Figures, *, believing: bool) -> SteadyState | None:
    """The stationary filter, of a plant without inputs; ``believing`` takes y for good."""
    spec, faults = figures.spec, figures.spec.faults.jump
    if faults is None or not spec.filter.traits.moments or not is_ergodic(faults.transition):
        return None
    if _radius(figures, faults) >= 1.0 - MARGIN:
        return None
    system = JumpSystem.from_spec(spec, 1).without_inputs()
    if not believing and unobserved_chain(spec):
        return stationary_jumps(composite(system)) if is_ergodic(faults.arrival_chain) else None
    doubtful = faults.arrival == "unknown" and spec.filter.option("detector", "none") == "none"
    return stationary_jumps(system, 1.0 if believing or not doubtful else _rate(faults))


def _rate(faults: JumpFaults) -> float:
    return 1.0 if faults.arrival_rate is None else faults.arrival_rate


def innovation(figures: Figures) -> Part:
    """Rank of S at the prior and at rest."""
    spec, faults = figures.spec, figures.spec.faults.jump
    if faults is None or not spec.filter.traits.moments:
        return Part()
    system, p = JumpSystem.from_spec(spec, 1), spec.model.ny
    law, P0 = system.initial, system.P0
    C = np.einsum("i,iab->ab", law, system.C[0])
    spread = np.einsum("i,iab->ab", law, system.R[0])
    for weight, own in zip(law, system.C[0] - C, strict=True):
        shift = own @ system.x0
        spread = spread + weight * (own @ P0 @ own.T + np.outer(shift, shift))
    ranks = {"innovation_rank": numerical_rank(C @ P0 @ C.T + spread)}
    own_rest = _at_rest(figures, believing=False)
    if own_rest is not None:
        ranks["innovation_rank_stationary"] = numerical_rank(own_rest.innovation_covariance)
    values = {name: float(rank) for name, rank in ranks.items()}
    lowest = min(ranks.values())
    if lowest == p:
        return Part((), values)
    message = (
        f"the innovation covariance has rank {lowest} of {p}: some rows of y follow exactly from"
        " the others, and are left out by a decision on rank"
    )
    remedy = "give every measurement some noise, at least that of its last digit"
    return Part((Finding("innovation_rank", "warning", message, lowest, remedy),), values)


def visibility(figures: Figures) -> Part:
    """How many losses find a predicted signal that looks like noise."""
    faults, found = figures.spec.faults.jump, _at_rest(figures, believing=True)
    if faults is None or found is None or not (faults.has_channel and _rate(faults) < 1.0):
        return Part()
    split = found.split
    # The constant is a part of the state: its second moment with x is the mean of x.
    mean = split.L @ split.now[:, figures.spec.model.nx :: figures.spec.model.nx + 1].sum(axis=1)
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
    values = {"invisible_losses": share}
    message = (
        f"about {share:.1%} of losses are invisible: the predicted signal is then within"
        f" {VISIBLE:g} noise deviations of zero"
    )
    if share <= MANY or figures.spec.filter.option("detector", "none") == "none":
        return Part((Finding("invisible_losses", "note", message, share),), values)
    remedy = "measure from another zero, or filter without a detector"
    return Part((Finding("invisible_losses", "warning", message, share, remedy),), values)


def detector(figures: Figures) -> Part:
    """What a test does to good samples, and options that it does not use."""
    options, p = figures.spec.filter.options, figures.spec.model.ny
    findings, values = [], {}
    if figures.spec.filter.option("detector", None) is None:
        return Part()
    if options.detector != "nis" and options.alpha != DEFAULT_ALPHA:
        message = f"nothing uses alpha = {options.alpha:g}: it is the false alarm rate of nis"
        findings.append(Finding("unused_alpha", "note", message, options.alpha))
    if options.detector == "energy":
        freedom = p * options.window
        rate = float(chdtrc(freedom, options.kappa * freedom))
        values["false_alarm_rate"] = rate
        message = (
            f"the energy rule rejects {rate:.1%} of good samples even where nothing was lost"
            " (Gaussian rows of one size); with what it rejects the prediction drifts, and more is"
            " rejected"
        )
        if rate > ALARMS:
            remedy = "detector = 'llr', which tests both hypotheses"
            findings.append(Finding("energy_rule", "warning", message, rate, remedy))
    if options.detector == "nis":
        values["false_alarm_rate"] = options.alpha
        message = (
            "nis tests one hypothesis: after rejections its gate opens, and a lost sample near"
            " zero is taken for a good one"
        )
        remedy = "detector = 'llr', which tests both hypotheses"
        findings.append(Finding("one_hypothesis", "note", message, options.alpha, remedy))
    return Part(tuple(findings), values)
