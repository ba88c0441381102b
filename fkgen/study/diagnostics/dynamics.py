"""Is the plant one that a filter can follow, and does the filter forget its errors."""

from __future__ import annotations

import math

import numpy as np

from fkgen.problem import Number, Spec
from fkgen.study.diagnostics.findings import ReportBuilder
from fkgen.study.diagnostics.model_numbers import Array, ModelNumbers, listed
from fkgen.study.diagnostics.size import used_parameters
from fkgen.study.diagnostics.visibility import ON_THE_CIRCLE, Hidden, unobservable, unreachable

#: Beyond this many samples a filter is taken to be slower than anybody means it to be.
_SLOW = 1e6


def stability(model: ModelNumbers, report: ReportBuilder) -> None:
    """Spectral radius of A."""
    radius = float(np.abs(np.linalg.eigvals(model.A)).max())
    report.values["spectral_radius"] = radius
    if radius > 1.0 + ON_THE_CIRCLE:
        doubling = math.log(2.0) / math.log(radius)
        message = (
            f"the plant is unstable: |eigenvalue| {radius:.6g}, so left alone an error doubles "
            f"in {doubling:.3g} samples"
        )
        report.note("unstable_plant", message, radius, "right if the real plant is so")


def observability(model: ModelNumbers, report: ReportBuilder) -> None:
    """What the measurements never show, and whether that matters."""
    n, hidden = len(model.A), unobservable(model.A, model.C)
    report.values["observability_rank"] = float(n - hidden.size)
    if not hidden.size:
        return
    where = f"the measurements say nothing about {_where(model, hidden)}"
    lasting = hidden.eigenvalues[np.abs(hidden.eigenvalues) >= 1.0 - ON_THE_CIRCLE]
    remedy = "measure it, or leave it out of the model"
    if not lasting.size:
        message = f"unobservable: rank {n - hidden.size} of {n}; {where}"
        message += ", whose error only dies away on its own"
        report.warning("unobservable", message, hidden.size, remedy)
        return
    message = f"not detectable: rank {n - hidden.size} of {n}; {where}"
    message += f", and its error does not die away (|eigenvalue| {np.abs(lasting).max():.6g})"
    report.error("undetectable", message, hidden.size, remedy)


def _where(model: ModelNumbers, hidden: Hidden) -> str:
    names = listed([model.states[i] for i in hidden.states])
    if len(hidden.states) == hidden.size:
        return names
    count = "one combination" if hidden.size == 1 else f"{hidden.size} combinations"
    return f"{count} of {names}"


def excitation(model: ModelNumbers, report: ReportBuilder) -> None:
    """Modes on the unit circle that no noise reaches: the filter stops listening to them."""
    still = unreachable(model.A, model.Q)
    report.values["noise_reachability_rank"] = float(len(model.A) - still.size)
    circle = np.abs(np.abs(still.eigenvalues) - 1.0) <= ON_THE_CIRCLE
    if circle.any():
        message = (
            f"no process noise reaches {_where(model, still)}, which does not die away either: its "
            "gain tends to 0 and the filter ends up ignoring its measurements"
        )
        remedy = "give it some process noise, unless it is a constant to be learnt once"
        report.warning("not_stabilisable", message, int(circle.sum()), remedy)


def steady_state(model: ModelNumbers, report: ReportBuilder) -> None:
    """The steady state of the filter, and how fast it gets there."""
    steady = model.steady
    if steady is None:
        message = (
            "the filter does not come to rest: the Riccati equation has no stabilising solution"
        )
        remedy = "see what is said about detectability and process noise"
        report.warning("no_stationary_filter", message, None, remedy)
        return
    samples = 0.0 if steady.radius <= 0.0 else -1.0 / math.log(steady.radius)
    report.values |= {"closed_loop_radius": steady.radius, "time_constant_samples": samples}
    text = f"an error of the estimate decays with a time constant of {samples:.3g} samples"
    period = model.spec.model.sample_time
    if period is not None:
        report.values["time_constant_seconds"] = samples * period
        text += f" ({samples * period:.3g} s)"
    if samples > _SLOW:
        report.warning("time_constant", text, samples, "more process noise makes it quicker")
    else:
        report.note("time_constant", text, samples)
    healthy = "" if model.spec.faults.sensor is None else " and none faulty"
    covariances = steady.predicted, steady.filtered
    deviations(model.spec, report, covariances, f"all rows present{healthy}", full=False)


def deviations(
    spec: Spec, report: ReportBuilder, covariances: tuple[Array, Array], which: str, *, full: bool
) -> None:
    """Standard deviations in the steady state (predicted, filtered), as values and as one note."""
    predicted, filtered = covariances
    texts = []
    for i, signal in enumerate(spec.model.states):
        for j in range(i + 1 if full else 0):
            report.values[f"stationary_covariance[{i}][{j}]"] = float(predicted[i, j])
            report.values[f"stationary_filtered_covariance[{i}][{j}]"] = float(filtered[i, j])
        deviation = math.sqrt(max(filtered[i, i], 0.0))
        report.values[f"stationary_sd.{signal.name}"] = deviation
        before = math.sqrt(max(predicted[i, i], 0.0))
        report.values[f"stationary_predicted_sd.{signal.name}"] = before
        texts.append(f"{signal.name} {deviation:.3g} {signal.unit}".rstrip())
    message = f"standard deviation of the filtered state at rest, {which}: {', '.join(texts)}"
    report.note("stationary_sd", message)


def silence(model: ModelNumbers, report: ReportBuilder) -> None:
    """Sensors that say nothing and states that nothing drives, by the zeros of the matrices."""
    plant, zero = model.spec.model, Number(0.0)
    for i, name in enumerate(model.outputs):
        entries = plant.C.rows[i] + (plant.D.rows[i] if model.has_faults else ())
        if all(entry == zero for entry in entries):
            message = f"{name} says nothing: its row of C is zero"
            report.warning("silent_output", message, i, "leave it out, or mend C")
    for i, name in enumerate(model.states):
        if all(entry == zero for entry in plant.A.rows[i] + plant.B.rows[i] + plant.Q.rows[i]):
            message = (
                f"nothing drives {name}: its rows of A, B and Q are zero, so it is 0 after one step"
            )
            report.warning("idle_state", message, i, "leave it out, or mend A")


def error_decay(model: ModelNumbers, report: ReportBuilder) -> None:
    """Does the effect of a fault die away: which of the sufficient conditions that are true holds.

    Song & Hu 2019, Theorem 1 (every rho(M[k]) < 1) is not among them: it is false. What is true,
    for M[k] = (I - K[k+1] C[k+1]) A[k]:

    a. one norm in which all ||M[k]|| <= q < 1;
    b. the joint spectral radius of the set of all M[k] is below 1;
    c. M[k] tends to an M with rho(M) < 1: constant data, and a Riccati equation that has a
       stabilising solution;
    d. bounded data, (A, C) uniformly detectable, (A, Q^1/2) uniformly stabilisable;
    e. always: Delta' P(k|k)^-1 Delta never grows once the fault is over.
    """
    spec, steady = model.spec, model.steady
    if steady is None:
        if spec.filter.traits.linear:
            _only_e(report, "the filter does not come to rest")
        return
    for i, state in enumerate(model.states):
        for j, output in enumerate(model.outputs):
            gain = float(steady.filtered_gain[i, j])
            report.values[f"filtered_gain.{state}.{output}"] = gain
    M = (np.eye(len(model.A)) - steady.filtered_gain @ model.C) @ model.A
    norm = float(np.linalg.norm(M, 2))
    report.values["closed_loop_norm"] = norm
    if not spec.filter.traits.linear:
        message = (
            f"the gains of {spec.filter.family} depend on the measurements or on the law of their "
            "faults: no condition on its products of gains is known; the figures are those of the "
            "Kalman filter without faults"
        )
        report.note("error_decay_unknown", message)
        return
    decays = (
        f"the effect of a fault dies away: M[k] tends to M with rho(M) = {steady.radius:.9g} < 1 "
        "(condition c)"
    )
    if norm >= 1.0:
        decays += f", after it may have grown at first: ||M|| = {norm:.4g}"
    if reason := _varying(model):
        _only_e(report, f"{decays}, as long as nothing varies; but {reason}")
    else:
        report.note("error_decay", decays, steady.radius)


def _varying(model: ModelNumbers) -> str:
    """What makes gains vary for ever, if anything does."""
    spec = model.spec
    if spec.filter.traits.told:
        return "signals may be lost"
    moving = [p.name for p in spec.parameters if p.name in used_parameters(spec)]
    if moving:
        return f"the model changes with {listed(moving)}"
    return "the gain changes with u" if model.has_faults else ""


def _only_e(report: ReportBuilder, reason: str) -> None:
    message = (
        f"{reason}: then it is only certain that the effect, measured by P(k|k), never grows once "
        "the fault is over (condition e); that every rho(M[k]) < 1 would prove nothing more"
    )
    remedy = "see fault-effect, over parameters and inputs that occur"
    report.note("error_decay_unproved", message, None, remedy)
