"""What can be seen: each state through y, and each fault through the innovation."""

from __future__ import annotations

import math

import numpy as np

from fkgen.closed_form.gaussian import square_root
from fkgen.spec.covariance import is_singular
from fkgen.study.effects.power import required_noncentrality
from fkgen.study.effects.response import LINEAR
from fkgen.study.examinations.figures import Array, Figures, Rest, listed
from fkgen.study.examinations.findings import Finding, Part
from fkgen.study.examinations.subspaces import unobservable

#: The usual test: one false alarm in a thousand samples, nine of ten faults found.
FALSE_ALARM, POWER = 1e-3, 0.9

#: An innovation below this share of the fault, both in standard deviations, counts as none.
_NOTHING = 1e-6


def states(figures: Figures) -> Part:
    """How well n samples alone determine each state, in its unit: infinite if they do not."""
    if is_singular(figures.R):
        return Part()
    n = len(figures.A)
    whitened = np.linalg.solve(square_root(figures.R), figures.C)
    rows = [whitened]
    for _ in range(n - 1):
        rows.append(rows[-1] @ figures.A)
    stacked = np.vstack(rows)
    scale = np.linalg.norm(stacked, axis=0)
    scale[scale == 0.0] = 1.0
    _, singular, right = np.linalg.svd(stacked / scale, full_matrices=False)
    hidden = unobservable(figures.A, figures.C)
    kept = singular[: n - hidden.size]
    spread = np.linalg.norm(right[: len(kept)].T / kept, axis=1) / scale
    values = {
        f"observation_sd.{name}": math.inf if i in hidden.states else float(spread[i])
        for i, name in enumerate(figures.states)
    }
    return Part((), values)


def sensors(figures: Figures) -> Part:
    """The least bias of each row that one sample shows, and what remains of a lasting one."""
    rest = figures.rest
    if rest is None or figures.spec.filter.family not in LINEAR:
        return Part()
    inverse = np.linalg.pinv(rest.innovation, hermitian=True)
    needed = required_noncentrality(1, FALSE_ALARM, POWER)
    values, findings = {}, []
    for i, signal in enumerate(figures.spec.model.outputs):
        bias = np.eye(len(figures.C))[i]
        left = lasting_innovation(figures, rest, bias)
        onset, after = (float(v @ inverse @ v) for v in (bias, left))
        least = math.sqrt(needed / onset) if onset > 0.0 else math.inf
        share = math.sqrt(max(after, 0.0) / onset) if onset > 0.0 else 0.0
        values[f"detectable_bias.{signal.name}"] = least
        values[f"visible_share.{signal.name}"] = share
        if share < _NOTHING:
            message = (
                f"a lasting bias of {signal.name} cannot be seen: the estimate takes all of it in, "
                f"and only its first samples show in the innovation (from {least:.3g} "
                f"{signal.unit}".rstrip()
                + " on, GLR of one sample)"
            )
            remedy = "a second sensor of the same, if that matters"
            findings.append(Finding("unseen_bias", "note", message, share, remedy))
    findings += _together(figures, rest, values)
    return Part(tuple(findings), values)


def _together(figures: Figures, rest: Rest, values: dict[str, float]) -> list[Finding]:
    """Biases of several rows at once that the estimate takes in, though it does not those of one.

    The rows are scaled by the standard deviations of their innovations, so units do not count.
    """
    size = np.sqrt(np.diag(rest.innovation))
    rows = [i for i in range(len(size)) if size[i] > 0.0]
    rows = [i for i in rows if values[f"visible_share.{figures.outputs[i]}"] >= _NOTHING]
    if len(rows) < 2:
        return []
    columns = [lasting_innovation(figures, rest, size[i] * np.eye(len(size))[i]) for i in rows]
    left = np.array(columns).T[size > 0.0] / size[size > 0.0, np.newaxis]
    _, singular, right = np.linalg.svd(left)
    seen = int(np.count_nonzero(singular > _NOTHING))
    unseen = right[seen:]
    values["unseen_bias_directions"] = float(len(unseen))
    if not len(unseen):
        return []
    involved = np.flatnonzero(np.linalg.norm(unseen, axis=0) > _NOTHING)
    names = listed([figures.outputs[rows[j]] for j in involved])
    how = f"{len(unseen)} combinations"
    if len(unseen) == 1:
        bias = unseen[0][involved] * size[[rows[j] for j in involved]]
        how = "in the ratio " + " : ".join(f"{b / bias[0]:.3g}" for b in bias)
    message = (
        f"lasting biases of {names} together ({how}) cannot be seen: the estimate takes them in"
    )
    remedy = "a sensor that does not share their cause, if they can share one"
    return [Finding("unseen_biases", "note", message, len(unseen), remedy)]


def inputs(figures: Figures) -> Part:
    """Inputs whose faults never reach y, in no sample."""
    if figures.spec.filter.family not in LINEAR:
        return Part()
    findings = []
    for j, signal in enumerate(figures.spec.model.inputs):
        reached, seen = np.abs(figures.B[:, j]), np.abs(figures.D[:, j]).any()
        for _ in range(len(figures.A)):
            seen = seen or (np.abs(figures.C) @ reached).any()
            reached = np.abs(figures.A) @ reached
        if not seen:
            message = (
                f"a fault of the input {signal.name} cannot be seen: it reaches no measurement, "
                "but it may reach the state"
            )
            remedy = "measure something that it drives"
            findings.append(Finding("unseen_input", "warning", message, j, remedy))
    return Part(tuple(findings))


def lasting_innovation(figures: Figures, rest: Rest, bias: Array) -> Array:
    """The innovation of a bias of y that lasts for ever: (I - C (I - A + K C)^-1 K) b.

    Song & Hu 2019, (12) for i -> infinity, in terms of the gain K of x(k+1|k).
    """
    F = figures.A - rest.gain @ figures.C
    state = np.linalg.solve(np.eye(len(F)) - F, rest.gain @ bias)
    return np.asarray(bias - figures.C @ state)
