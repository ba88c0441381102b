"""Is the plant one that a filter can follow, and does the filter forget its errors."""

from __future__ import annotations

import math

import numpy as np

from fkgen.problem import Number
from fkgen.study.diagnostics.subject import Array, Subject, listed
from fkgen.study.diagnostics.visibility import ON_THE_CIRCLE, Hidden, unobservable, unreachable

_SLOW = 1e6  # samples: slower than anybody means a filter to be


def stability(model: Subject) -> None:
    """Spectral radius of A."""
    radius = model.spectral_radius
    model.values["spectral_radius"] = radius
    if radius > 1.0 + ON_THE_CIRCLE:
        model.add("unstable_plant", radius, doubling=math.log(2.0) / math.log(radius))


def observability(model: Subject) -> None:
    """What the measurements never show, and whether that matters."""
    n, hidden = len(model.A), unobservable(model.A, model.C)
    rank = n - hidden.size
    model.values["observability_rank"] = float(rank)
    if hidden.size:
        radius = float(np.abs(hidden.eigenvalues).max())
        code = "undetectable" if radius >= 1.0 - ON_THE_CIRCLE else "unobservable"
        model.add(code, hidden.size, rank=rank, n=n, names=_where(model, hidden), radius=radius)


def _where(model: Subject, hidden: Hidden) -> str:
    names = listed([model.states[i] for i in hidden.states])
    if len(hidden.states) == hidden.size:
        return names
    count = "one combination" if hidden.size == 1 else f"{hidden.size} combinations"
    return f"{count} of {names}"


def excitation(model: Subject) -> None:
    """Modes on the unit circle that no noise reaches: the filter stops listening to them."""
    still = unreachable(model.A, model.Q)
    model.values["noise_reachability_rank"] = float(len(model.A) - still.size)
    circle = np.abs(np.abs(still.eigenvalues) - 1.0) <= ON_THE_CIRCLE
    if circle.any():
        model.add("not_stabilisable", int(circle.sum()), names=_where(model, still))


def steady_state(model: Subject) -> None:
    """The steady state of the filter, and how fast it gets there."""
    steady, period, seconds = model.steady, model.spec.period, ""
    if steady is None:
        model.add("no_stationary_filter")
        return
    samples = 0.0 if steady.radius <= 0.0 else -1.0 / math.log(steady.radius)
    model.values |= {"closed_loop_radius": steady.radius, "time_constant_samples": samples}
    if period is not None:
        model.values["time_constant_seconds"] = samples * period
        seconds = f" ({samples * period:.3g} s)"
    code = "time_constant.slow" if samples > _SLOW else "time_constant"
    model.add(code, samples, seconds=seconds)
    healthy = "" if model.spec.faults.sensor is None else " and none faulty"
    deviations(model, steady.predicted, steady.filtered, f"all rows present{healthy}")


def deviations(model: Subject, predicted: Array, filtered: Array, which: str) -> None:
    """Standard deviations in the steady state, as values and as one note."""
    sd, before = (np.sqrt(np.diag(P).clip(0.0)) for P in (filtered, predicted))
    model.put("stationary_sd", model.states, sd)
    model.put("stationary_predicted_sd", model.states, before)
    shown = zip(model.spec.model.states, sd, strict=True)
    texts = (f"{signal.name} {value:.3g} {signal.unit}".rstrip() for signal, value in shown)
    model.add("stationary_sd", which=which, deviations=", ".join(texts))


def silence(model: Subject) -> None:
    """Sensors that say nothing and states that nothing drives, by the zeros of the matrices."""
    shown = "CD" if model.has_faults else "C"
    for code, letters, names in (
        ("silent_output", shown, model.outputs),
        ("idle_state", "ABQc", model.states),
    ):
        matrices = [getattr(model.spec.model, letter) for letter in letters]
        for i, name in enumerate(names):
            if all(entry == Number(0.0) for matrix in matrices for entry in matrix.rows[i]):
                model.add(code, i, name=name)


def error_decay(model: Subject) -> None:
    """Does the effect of a fault die away: which condition of docs/fault-effects.md holds, c or e.

    Song & Hu 2019, Theorem 1 (every rho(M[k]) < 1) is none of them: it is false.
    """
    steady, linear = model.steady, model.spec.filter.traits.linear
    if steady is None:
        if linear:
            model.add("error_decay_unproved", reason="the filter does not come to rest")
        return
    for state, gains in zip(model.states, steady.filtered_gain, strict=True):
        model.put(f"filtered_gain.{state}", model.outputs, gains)
    M = (np.eye(len(model.A)) - steady.filtered_gain @ model.C) @ model.A
    norm = float(np.linalg.norm(M, 2))
    model.values["closed_loop_norm"] = norm
    if not linear:
        model.add("error_decay_unknown", family=model.spec.filter.family)
        return
    decays = (
        f"the effect of a fault dies away: M[k] tends to M with rho(M) = {steady.radius:.9g} < 1 "
        "(condition c)"
    )
    if norm >= 1.0:
        decays += f", after it may have grown at first: ||M|| = {norm:.4g}"
    if varying := _varying(model):
        reason = f"{decays}, as long as nothing varies; but {varying}"
        model.add("error_decay_unproved", reason=reason)
    else:
        model.add("error_decay", steady.radius, decays=decays)


def _varying(model: Subject) -> str:
    """What makes gains vary for ever, if anything does."""
    if model.spec.filter.traits.told:
        return "signals may be lost"
    moving = [p.name for p in model.spec.parameters if p.name in model.used]
    if moving:
        return f"the model changes with {listed(moving)}"
    return "the gain changes with u" if model.has_faults else ""
