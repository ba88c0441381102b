"""Is the plant one that a filter can follow: stable, observable, detectable, stirred by noise."""

from __future__ import annotations

import math

import numpy as np

from fkgen.problem import Number
from fkgen.study.diagnostics.findings import Finding, Part
from fkgen.study.diagnostics.model_numbers import Figures, listed
from fkgen.study.diagnostics.visibility import ON_THE_CIRCLE, Hidden, unobservable, unreachable

#: Beyond this many samples a filter is taken to be slower than anybody means it to be.
_SLOW = 1e6


def stability(figures: Figures) -> Part:
    """Spectral radius of A."""
    radius = float(np.abs(np.linalg.eigvals(figures.A)).max())
    values = {"spectral_radius": radius}
    if radius <= 1.0 + ON_THE_CIRCLE:
        return Part((), values)
    doubling = math.log(2.0) / math.log(radius)
    message = (
        f"the plant is unstable: |eigenvalue| {radius:.6g}, so left alone an error doubles "
        f"in {doubling:.3g} samples"
    )
    remedy = "right if the real plant is so"
    return Part((Finding("unstable_plant", "note", message, radius, remedy),), values)


def observability(figures: Figures) -> Part:
    """What the measurements never show, and whether that matters."""
    n = len(figures.A)
    hidden = unobservable(figures.A, figures.C)
    values = {"observability_rank": float(n - hidden.size)}
    if not hidden.size:
        return Part((), values)
    where = _where(figures, hidden)
    lasting = hidden.eigenvalues[np.abs(hidden.eigenvalues) >= 1.0 - ON_THE_CIRCLE]
    remedy = "measure it, or leave it out of the model"
    if not lasting.size:
        message = (
            f"unobservable: rank {n - hidden.size} of {n}; the measurements say nothing about "
            f"{where}, whose error only dies away on its own"
        )
        return Part((Finding("unobservable", "warning", message, hidden.size, remedy),), values)
    message = (
        f"not detectable: rank {n - hidden.size} of {n}; the measurements say nothing about "
        f"{where}, and its error does not die away (|eigenvalue| {np.abs(lasting).max():.6g})"
    )
    return Part((Finding("undetectable", "error", message, hidden.size, remedy),), values)


def _where(figures: Figures, hidden: Hidden) -> str:
    names = listed([figures.states[i] for i in hidden.states])
    if len(hidden.states) == hidden.size:
        return names
    count = "one combination" if hidden.size == 1 else f"{hidden.size} combinations"
    return f"{count} of {names}"


def excitation(figures: Figures) -> Part:
    """Modes on the unit circle that no noise reaches: the filter stops listening to them."""
    still = unreachable(figures.A, figures.Q)
    n = len(figures.A)
    values = {"noise_reachability_rank": float(n - still.size)}
    circle = np.abs(np.abs(still.eigenvalues) - 1.0) <= ON_THE_CIRCLE
    if not circle.any():
        return Part((), values)
    message = (
        f"no process noise reaches {_where(figures, still)}, which does not die away either: its "
        "gain tends to 0 and the filter ends up ignoring its measurements"
    )
    remedy = "give it some process noise, unless it is a constant to be learnt once"
    finding = Finding("not_stabilisable", "warning", message, int(circle.sum()), remedy)
    return Part((finding,), values)


def rest(figures: Figures) -> Part:
    """Where the filter comes to rest, and how fast."""
    found = figures.rest
    if found is None:
        message = (
            "the filter does not come to rest: the Riccati equation has no stabilising solution"
        )
        remedy = "see what is said about detectability and process noise"
        return Part((Finding("no_stationary_filter", "warning", message, None, remedy),))
    samples = 0.0 if found.radius <= 0.0 else -1.0 / math.log(found.radius)
    values = {"closed_loop_radius": found.radius, "time_constant_samples": samples}
    text = f"an error of the estimate decays with a time constant of {samples:.3g} samples"
    period = figures.spec.model.sample_time
    if period is not None:
        values["time_constant_seconds"] = samples * period
        text += f" ({samples * period:.3g} s)"
    slow = samples > _SLOW
    remedy = "more process noise makes it quicker" if slow else ""
    findings = [
        Finding("time_constant", "warning" if slow else "note", text, samples, remedy),
        _precision(figures, values),
    ]
    return Part(tuple(findings), values)


def _precision(figures: Figures, values: dict[str, float]) -> Finding:
    """Standard deviations at rest, as one note; also entered into the values."""
    found = figures.rest
    texts = []
    signals = figures.spec.model.states
    for i, signal in enumerate(signals if found is not None else ()):
        if found is None:
            continue
        deviation = math.sqrt(max(found.filtered[i, i], 0.0))
        values[f"stationary_sd.{signal.name}"] = deviation
        values[f"stationary_predicted_sd.{signal.name}"] = math.sqrt(
            max(found.predicted[i, i], 0.0)
        )
        texts.append(f"{signal.name} {deviation:.3g} {signal.unit}".rstrip())
    healthy = "" if figures.spec.faults.sensor is None else " and none faulty"
    message = f"standard deviation of the filtered state at rest, all rows present{healthy}: "
    message += ", ".join(texts)
    return Finding("stationary_sd", "note", message)


def silence(figures: Figures) -> Part:
    """Sensors that say nothing and states that nothing drives, by the zeros of the matrices."""
    model, zero = figures.spec.model, Number(0.0)
    findings = []
    for i, name in enumerate(figures.outputs):
        entries = model.C.rows[i] + (model.D.rows[i] if figures.has_faults else ())
        if all(entry == zero for entry in entries):
            message = f"{name} says nothing: its row of C is zero"
            finding = Finding("silent_output", "warning", message, i, "leave it out, or mend C")
            findings.append(finding)
    for i, name in enumerate(figures.states):
        entries = model.A.rows[i] + model.B.rows[i] + model.Q.rows[i]
        if all(entry == zero for entry in entries):
            message = (
                f"nothing drives {name}: its rows of A, B and Q are zero, so it is 0 after one step"
            )
            findings.append(Finding("idle_state", "warning", message, i, "leave it out, or mend A"))
    return Part(tuple(findings))
