"""The best linear estimate from its definition: one joint distribution, then projections.

No recursion takes place: every estimate conditions anew on all measurements up to its sample.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fkgen.oracle.exact.gaussian import (
    RANK_TOLERANCE,
    Array,
    Whitening,
    log_density,
    square_root,
    whiten,
)
from fkgen.oracle.plants.actuator import LinearSystem

#: By how many samples rows are late, (T, p).
Delays: TypeAlias = NDArray[np.intp]


@dataclass(frozen=True, eq=False, kw_only=True)
class Joint:
    """States and measurements, linear in uncorrelated z of variance 1: x[0], then gamma, v, w."""

    state_mean: Array  # (T + 1, n), (T + 1, n, d): x[k] = state_mean[k] + state_root[k] @ z
    state_root: Array
    measurement_mean: Array  # (T, p), (T, p, d): the same of y[k]
    measurement_root: Array
    #: (c, d): Vectors that are known to be 1 from the start: where means are taken for variables
    known: Array | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class Estimates:
    """Estimates of one record; names and times as the ports of a filter."""

    filtered_state: Array  # (T, n), (T, n, n): x(k|k) and its error covariance
    filtered_covariance: Array
    predicted_state: Array  # (T, n), (T, n, n): x(k+1|k) and its error covariance
    predicted_covariance: Array
    innovation: Array  # (T, p): y[k] less what the past lets expect; NaN where y is
    innovation_covariance: Array  # (T, p, p): Of all rows, given the past

    @classmethod
    def of(cls, rows: Sequence[Mapping[str, ArrayLike]]) -> Self:
        """One array per port, from the ports of each sample."""
        return cls(**{name: np.array([row[name] for row in rows]) for name in rows[0]})


@dataclass(frozen=True, eq=False, kw_only=True)
class BatchResult(Estimates):
    """Estimates, and how well the finite rows of y fit them."""

    nis: Array  # (T,): Normalised square of the innovation; 0 if there is no row
    log_likelihood: Array  # (T,): Its Gaussian log density; 0 if there is no row


def joint_distribution(system: LinearSystem, u: Array | None) -> Joint:
    """Write a record in terms of what is random in it, eq. (1)-(3); u (T, q)."""
    T, n, p, q = system.length, system.nx, system.ny, system.nu
    u = system.inputs(u)
    size = n + T * (q + n + p)
    state_mean, state_root = np.zeros((T + 1, n)), np.zeros((T + 1, n, size))
    measurement_mean, measurement_root = np.zeros((T, p)), np.zeros((T, p, size))
    fault_root, state_noise, measurement_noise = map(
        square_root, (system.fault_covariance, system.Q, system.R)
    )
    roots = system.noise_root() if system.S.any() else None
    state_mean[0], state_root[0, :, :n] = system.x0, square_root(system.P0)
    for k in range(T):
        start = n + k * (q + n + p)
        applied = np.zeros((q, size))  # (gamma - rate) u: the same in both lines of eq. (1)
        applied[:, start : start + q] = u[k][:, None] * fault_root[k]
        expected = system.rate[k] * u[k]
        measurement_mean[k] = system.C[k] @ state_mean[k] + system.D[k] @ expected + system.d[k]
        measurement_root[k] = system.C[k] @ state_root[k] + system.D[k] @ applied
        noise = slice(start + q, start + q + n + p)
        measurement_root[k, :, start + q + n : noise.stop] += measurement_noise[k]
        state_mean[k + 1] = system.A[k] @ state_mean[k] + system.B[k] @ expected + system.c[k]
        state_root[k + 1] = system.A[k] @ state_root[k] + system.B[k] @ applied
        state_root[k + 1, :, start + q : start + q + n] += state_noise[k]
        if roots is not None:  # one root for both, since they are correlated
            measurement_root[k, :, noise], state_root[k + 1, :, noise] = roots[k, n:], roots[k, :n]
    return Joint(
        state_mean=state_mean,
        state_root=state_root,
        measurement_mean=measurement_mean,
        measurement_root=measurement_root,
    )


def late(joint: Joint, system: LinearSystem, y: Array, delays: Delays) -> tuple[Joint, Array]:
    """Rows that see the sample of ``delays`` (T, p) samples ago, with the noise of their own one.

    And y, in which rows from before sample 0 are missing. Missing rows see their own sample.
    """
    T, p = y.shape
    n, q = system.nx, system.nu
    own = np.zeros_like(joint.measurement_root)  # what is noise of the sample itself
    for k in range(T):
        begin = n + k * (q + n + p) + q
        noise = slice(begin, begin + n + p)
        own[k, :, noise] = joint.measurement_root[k, :, noise]
    signal, at = joint.measurement_root - own, np.arange(T)[:, None] - delays
    unseen = (at < 0) | np.isnan(y)
    there, columns = np.where(unseen, np.arange(T)[:, None], at), np.arange(p)
    found = replace(
        joint,
        measurement_mean=joint.measurement_mean[there, columns],
        measurement_root=signal[there, columns] + own,
    )
    return found, np.where(at < 0, np.nan, y)


def batch_lmmse(
    system: LinearSystem, y: Array, u: Array | None, delays: Delays | None = None
) -> BatchResult:
    """Estimate each state by projecting it on all measurements up to its time; y (T, p), u (T, q).

    A singular covariance is projected on its range, the rank decided on rows of unit variance.
    """
    return BatchResult.of(project(*measured(system, y, u, delays)))


def measured(
    system: LinearSystem, y: Array, u: Array | None, delays: Delays | None
) -> tuple[Joint, Array]:
    """The distribution of a record, some rows of which may be late, and what counts of it."""
    joint = joint_distribution(system, u)
    return (joint, y) if delays is None else late(joint, system, y, delays)


#: Ports of one sample, and an index of the entries of the record that are not used any longer.
Judged: TypeAlias = tuple[dict[str, ArrayLike], Any]
Judge: TypeAlias = Callable[[int, Array, Array], Judged]


def project(joint: Joint, y: Array, judge: Judge | None = None) -> list[dict[str, ArrayLike]]:
    """Ports of each sample: the state projected on the finite measurements up to its time.

    `judge(k, innovation, covariance)` adds ports, and says what is not used any longer.
    """
    used, rows = y.copy(), []
    past, z = past_of(joint, y[:0])
    for k, now in enumerate(y):
        root = past.unexplained(joint.measurement_root[k])
        residual = now - (joint.measurement_mean[k] + joint.measurement_root[k] @ z)
        S = root @ root.T
        row: dict[str, ArrayLike] = {
            "innovation": residual,
            "innovation_covariance": S,
            **_agreement(residual, root, joint.measurement_root[k]),
        }
        if judge is not None:
            judged, forgotten = judge(k, residual, S)
            row |= judged
            used[forgotten] = np.nan
        past, z = past_of(joint, used[: k + 1])
        for at, when in ((k, "filtered"), (k + 1, "predicted")):
            root = past.unexplained(joint.state_root[at])
            row[f"{when}_state"] = joint.state_mean[at] + joint.state_root[at] @ z
            row[f"{when}_covariance"] = root @ root.T
        rows.append(row)
    return rows


def past_of(joint: Joint, y: Array) -> tuple[Whitening, Array]:
    """What the finite measurements so far reveal of z, and the mean of z given them, (d,)."""
    finite, samples = np.isfinite(y), len(y)
    residual = (y - joint.measurement_mean[:samples])[finite]
    root = joint.measurement_root[:samples][finite]
    if joint.known is not None:
        root = np.vstack([joint.known, root])
        residual = np.append(np.ones(len(joint.known)), residual)
    whitening = whiten(root)
    return whitening, whitening.directions @ (whitening.weights @ residual)


def _agreement(innovation: Array, root: Array, before: Array) -> dict[str, float]:
    """Ports of the finite rows of an innovation, from their roots given the past and `before`."""
    finite = np.isfinite(innovation)
    if not finite.any():
        return {"nis": 0.0, "log_likelihood": 0.0}
    # What is left of a row that the past determines is rounding of the row as it was.
    dust = RANK_TOLERANCE * np.linalg.norm(before[finite], axis=1)
    whitening = whiten(root[finite], negligible=dust)
    return {
        "nis": float(np.sum((whitening.weights @ innovation[finite]) ** 2)),
        "log_likelihood": log_density(innovation[finite], whitening),
    }
