"""What can be seen: each state through y, each fault through the innovation, noise in the state.

Invariant subspaces are decided on scaled matrices: states are scaled so that what enters and what
leaves each of them is of one size, measurements so that each row of C has length one. Changing the
unit of a state or a measurement changes nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fkgen.oracle.exact.gaussian import square_root
from fkgen.problem.covariance import is_singular
from fkgen.study.diagnostics.subject import RANK_TOLERANCE, Array, Subject, correlations, listed
from fkgen.study.effects.effect import required_noncentrality

ON_THE_CIRCLE = 1e-7  # eigenvalues so near to the unit circle: defective ones are known no better
FALSE_ALARM, POWER = 1e-3, 0.9  # one false alarm in a thousand samples, nine of ten faults found
_NOTHING = 1e-6  # shares of a subspace, and of a fault in the innovation (in sd), that are none
_SWEEPS = 12


@dataclass(frozen=True, slots=True, eq=False)
class Hidden:
    """A subspace that A maps into itself and that cannot be seen (or reached)."""

    size: int
    states: tuple[int, ...]  # those that have a share in it
    eigenvalues: NDArray[np.complex128]  # (size,), of A within it


def unobservable(A: Array, C: Array) -> Hidden:
    """The largest A-invariant subspace within the null space of C."""
    scale = _scaled(A, C)
    M = A * scale[np.newaxis, :] / scale[:, np.newaxis]
    V = _null_space(_unit_rows(C * scale[np.newaxis, :]), np.eye(len(A)), 1.0)
    while V.shape[1]:
        outside = M @ V - V @ (V.T @ (M @ V))
        smaller = _null_space(outside, V, max(1.0, float(np.linalg.norm(M, 2))))
        if smaller.shape[1] == V.shape[1]:
            break
        V = smaller
    involved = np.flatnonzero(np.linalg.norm(V, axis=1) > _NOTHING).tolist()
    return Hidden(V.shape[1], tuple(involved), np.linalg.eigvals(V.T @ M @ V).astype(complex))


def unreachable(A: Array, Q: Array) -> Hidden:
    """What noise of covariance Q never reaches: the dual of `unobservable`."""
    size, correlation = correlations(Q)
    values, vectors = np.linalg.eigh(correlation)
    kept = values > RANK_TOLERANCE
    root = size[:, np.newaxis] * vectors[:, kept] * np.sqrt(values[kept])
    return unobservable(A.T, root.T)


def _scaled(A: Array, C: Array) -> Array:
    """Scales d for which diag(1/d) A diag(d) and C diag(d) are balanced (Osborne's sweeps)."""
    n = len(A)
    d = np.ones(n)
    for _ in range(_SWEEPS):
        rows = _unit_rows(C * d[np.newaxis, :])
        for i in range(n):
            others = np.arange(n) != i
            left = np.linalg.norm(A[others, i] * d[i] / d[others])
            leaves = float(np.hypot(left, np.linalg.norm(rows[:, i])))
            enters = float(np.linalg.norm(A[i, others] * d[others] / d[i]))
            if leaves > 0.0 and enters > 0.0:
                factor = np.sqrt(enters / leaves)
            else:
                factor = 1.0 / leaves if leaves > 0.0 else enters or 1.0
            d[i] *= factor
            rows[:, i] *= factor
    return d


def _unit_rows(matrix: Array) -> Array:
    length = np.linalg.norm(matrix, axis=1, keepdims=True)
    return np.asarray(np.divide(matrix, length, out=np.zeros_like(matrix), where=length > 0.0))


def _null_space(matrix: Array, basis: Array, size: float) -> Array:
    """The part of a basis on which a matrix vanishes."""
    _, singular, right = np.linalg.svd(matrix)
    rank = int(np.count_nonzero(singular > RANK_TOLERANCE * size))
    return np.asarray(basis @ right[rank:].T)


def states(model: Subject) -> None:
    """How well n samples alone determine each state, in its unit: infinite if they do not."""
    if is_singular(model.R):
        return
    rows = [np.linalg.solve(square_root(model.R), model.C)]
    for _ in model.states[1:]:
        rows.append(rows[-1] @ model.A)
    stacked = np.vstack(rows)
    scale = np.linalg.norm(stacked, axis=0)
    scale[scale == 0.0] = 1.0
    _, singular, right = np.linalg.svd(stacked / scale, full_matrices=False)
    hidden = unobservable(model.A, model.C)
    kept = singular[: len(model.A) - hidden.size]
    spread = np.linalg.norm(right[: len(kept)].T / kept, axis=1) / scale
    spread[list(hidden.states)] = math.inf
    model.put("observation_sd", model.states, spread)


def sensors(model: Subject) -> None:
    """The least bias of each row that one sample shows, and what remains of a lasting one."""
    steady = model.steady
    if steady is None or not model.spec.filter.traits.linear:
        return
    inverse = np.linalg.pinv(steady.innovation, hermitian=True)
    lasting = model.lasting_innovation(steady, np.eye(len(model.C)))
    needed = required_noncentrality(1, FALSE_ALARM, POWER)
    onset, after = np.diag(inverse), np.einsum("ji,jk,ki->i", lasting, inverse, lasting)
    seen, never = onset > 0.0, np.full_like(onset, np.inf)
    least = np.sqrt(np.divide(needed, onset, out=never, where=seen))
    shares = np.divide(after.clip(0.0), onset, out=np.zeros_like(onset), where=seen) ** 0.5
    model.put("detectable_bias", model.outputs, least)
    model.put("visible_share", model.outputs, shares)
    for signal, bias, share in zip(model.spec.model.outputs, least, shares.tolist(), strict=True):
        if share < _NOTHING:
            shown = f"{bias:.3g} {signal.unit}".rstrip()
            model.add("unseen_bias", share, name=signal.name, least=shown)
    # Biases of several rows that the estimate takes in, though it does not those of one.
    size = np.sqrt(np.diag(steady.innovation))
    rows = np.flatnonzero((size > 0.0) & (shares >= _NOTHING))
    if len(rows) > 1:
        _several_sensors(model, lasting[:, rows], size, rows)


def _several_sensors(model: Subject, lasting: Array, size: Array, rows: NDArray[np.intp]) -> None:
    """The rows are scaled by standard deviations of their innovations: units do not count."""
    left = (lasting * size[rows])[size > 0.0] / size[size > 0.0, np.newaxis]
    _, singular, right = np.linalg.svd(left)
    unseen = right[int(np.count_nonzero(singular > _NOTHING)) :]
    model.values["unseen_bias_directions"] = float(len(unseen))
    if not len(unseen):
        return
    involved = np.flatnonzero(np.linalg.norm(unseen, axis=0) > _NOTHING)
    how = f"{len(unseen)} combinations"
    if len(unseen) == 1:
        bias = unseen[0][involved] * size[rows[involved]]
        how = "in the ratio " + " : ".join(f"{b / bias[0]:.3g}" for b in bias)
    names = listed([model.outputs[i] for i in rows[involved]])
    model.add("unseen_biases", len(unseen), names=names, how=how)


def inputs(model: Subject) -> None:
    """Inputs whose faults never reach y, in no sample."""
    if model.spec.filter.traits.linear:
        for j, signal in enumerate(model.spec.model.inputs):
            if not model.D[:, j].any() and not reaches(model, j):
                model.add("unseen_input", j, name=signal.name)


def reaches(model: Subject, j: int) -> bool:
    """Whether an input reaches y through the state: a Markov parameter C A^k B is not zero."""
    reached = np.abs(model.B[:, j])
    for _ in range(len(model.A)):
        if (np.abs(model.C) @ reached).any():
            return True
        reached = np.abs(model.A) @ reached
    return False
