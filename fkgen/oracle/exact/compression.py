"""Host and compression filters from joint distributions, window by window.

Between two ends of windows nothing but (x, P) is remembered, so a window is a short record with a
prior of its own: the host is the projection on its rows, a compression filter the projection on the
rows of its groups too. The statistic is taken from a square root of D = P - P*, never from that
difference: what the compressed rows say beyond the host's, whitened, is projected on the part that
moves the estimate.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from itertools import combinations

import numpy as np

from fkgen.faults import SoftFaults
from fkgen.oracle.exact.batch import batch_lmmse, joint_distribution
from fkgen.oracle.exact.gaussian import RANK_TOLERANCE, Array, whiten
from fkgen.oracle.plants.actuator import LinearSystem


@dataclass(frozen=True, eq=False, kw_only=True)
class CompressionResult:
    """Host and compression filters over one record; names and times as the ports of a filter."""

    #: filtered_state, filtered_covariance: (T, n), (T, n, n): Of the host, after it has taken
    #: over what it accepts
    filtered_state: Array
    filtered_covariance: Array
    predicted_state: Array  # predicted_state, predicted_covariance: (T, n), (T, n, n)
    predicted_covariance: Array
    #: compression_deviation, compression_covariance: (T, s n), (T, s, n, n): Of every set of
    #: groups: its estimate minus the host's, and its covariance
    compression_deviation: Array
    compression_covariance: Array
    #: innovation, innovation_covariance: (T, p), (T, p, p): Of all rows, with respect to the
    #: host
    innovation: Array
    innovation_covariance: Array
    nis: Array  # nis, log_likelihood: (T,): Of the rows of the host
    log_likelihood: Array
    #: test_statistic, test_dof, fault_declared: (T, g): NaN, 0 and 0 where no test is made
    test_statistic: Array
    test_dof: Array
    fault_declared: Array
    #: (T, g): Smallest share of a variance of the host that the compressed rows remove along a
    #: direction that counts; NaN where no test is made. The statistic divides by it
    faintest: Array


@dataclass(frozen=True, kw_only=True)
class Policy:
    """When windows end, and what a test leads to."""

    first: int  # Sample at which the first window ends; 0: none does
    test: bool = True  # Whether anything is rejected
    #: Windows of rejections alone, in a row, from which on the host is inflated
    reacquire: int | None = None
    #: A component of the state counts if the compressed rows remove more than this share of the
    #: host's variance of it, given those that count already; the largest share comes first
    negligible: float = 1e-11


def subsets(soft: SoftFaults) -> list[tuple[int, ...]]:
    """Every set of groups that may be accepted, the small ones first."""
    count = len(soft.groups)
    return [s for size in range(1, count + 1) for s in combinations(range(count), size)]


def only(y: Array, rows: Iterable[int]) -> Array:
    """The record with all other rows missing."""
    result = np.full_like(y, np.nan)
    kept = list(rows)
    result[:, kept] = y[:, kept]
    return result


def accepted_rows(soft: SoftFaults, y: Array, ends: Sequence[int], accepted: Array) -> Array:
    """The measurements that the host has taken over by the end of a record.

    Shapes: y (T, p); accepted (windows, groups).
    """
    result, begin = only(y, soft.host), 0
    for end, flags in zip(ends, accepted, strict=True):
        for group, flag in zip(soft.groups, flags, strict=True):
            if flag:
                result[begin : end + 1, list(group)] = y[begin : end + 1, list(group)]
        begin = end + 1
    return result


def batch_compression(
    system: LinearSystem, soft: SoftFaults, policy: Policy, y: Array, u: Array | None
) -> CompressionResult:
    """Filter a record as ``compression_full`` and ``dfcf`` have to.

    Shapes: y (T, p); u (T, q). Lee & Lee, Theorems 2 and 3, (50), (51), from their statement: the
    host is the Kalman filter of its rows and of what it accepted.
    """
    T, inputs = system.length, system.inputs(u)
    result = _empty(system, soft)
    ends = [*range(policy.first, T, soft.window)] if policy.first else []
    begin, prior, rejections = 0, (system.x0, system.P0), 0
    for last in dict.fromkeys([*ends, T - 1]):
        piece = slice(begin, last + 1)
        part = between(system, begin, last + 1, prior)
        window = _Window(part=part, soft=soft, y=y[piece], u=inputs[piece], piece=piece)
        window.fill(result)
        if last in ends:
            rejections = window.close(result, policy, rejections)
        begin, prior = last + 1, (result.predicted_state[last], result.predicted_covariance[last])
    return result


def between(system: LinearSystem, begin: int, end: int, prior: tuple[Array, Array]) -> LinearSystem:
    """The plant from one sample to another, with a prior for the first of them."""
    varying = ("A", "B", "C", "D", "Q", "R", "rate", "fault_covariance")
    parts = {name: getattr(system, name)[begin:end] for name in varying}
    return replace(system, x0=prior[0], P0=prior[1], **parts)


def _empty(system: LinearSystem, soft: SoftFaults) -> CompressionResult:
    T, n, p, g = system.length, system.nx, system.ny, len(soft.groups)
    s = len(subsets(soft))
    shapes = {
        "filtered_state": (n,), "predicted_state": (n,), "compression_deviation": (s, n),
        "filtered_covariance": (n, n), "predicted_covariance": (n, n),
        "compression_covariance": (s, n, n), "innovation": (p,), "innovation_covariance": (p, p),
        "nis": (), "log_likelihood": (), "test_statistic": (g,), "test_dof": (g,),
        "fault_declared": (g,), "faintest": (g,),
    }  # fmt: skip
    result = CompressionResult(
        **{f.name: np.zeros((T, *shapes[f.name])) for f in fields(CompressionResult)}
    )
    result.test_statistic[:] = result.faintest[:] = np.nan
    return result


@dataclass(frozen=True, eq=False, kw_only=True)
class _Window:
    """A window: the plant with the prior of its first sample, and the record."""

    part: LinearSystem
    soft: SoftFaults
    y: Array
    u: Array
    piece: slice

    def fill(self, result: CompressionResult) -> None:
        """Project on the rows of the host, and on those of each set of groups too."""
        part, piece, soft = self.part, self.piece, self.soft
        host = batch_lmmse(part, only(self.y, soft.host), self.u)
        for name in ("filtered", "predicted"):
            getattr(result, f"{name}_state")[piece] = getattr(host, f"{name}_state")
            getattr(result, f"{name}_covariance")[piece] = getattr(host, f"{name}_covariance")
        result.nis[piece], result.log_likelihood[piece] = host.nis, host.log_likelihood
        before = np.vstack([part.x0[None], host.predicted_state[:-1]])
        spread = np.concatenate([part.P0[None], host.predicted_covariance[:-1]])
        predicted = part.C @ before[..., None] + part.D @ self.u[..., None]
        result.innovation[piece] = self.y - predicted[..., 0]
        result.innovation_covariance[piece] = part.C @ spread @ part.C.transpose(0, 2, 1) + part.R
        for at, subset in enumerate(subsets(soft)):
            rows = [*soft.host, *(row for group in subset for row in soft.groups[group])]
            found = batch_lmmse(part, only(self.y, rows), self.u)
            result.compression_deviation[piece, at] = found.filtered_state - host.filtered_state
            result.compression_covariance[piece, at] = found.filtered_covariance

    def close(self, result: CompressionResult, policy: Policy, rejections: int) -> int:
        """Test every group, take over what passes; return the windows of rejections in a row."""
        end, part = self.piece.stop - 1, self.part
        accepted, rejected = self._verdicts(result, policy, end)
        x, P = result.filtered_state[end].copy(), result.filtered_covariance[end].copy()
        d = result.compression_deviation[end, -1].copy()
        if accepted:
            at = subsets(self.soft).index(accepted)
            x += result.compression_deviation[end, at]
            P = result.compression_covariance[end, at].copy()
        rejections = 0 if accepted else rejections + (1 if rejected else 0)
        if policy.reacquire is not None and rejections >= policy.reacquire:
            P = P + np.outer(d, d)
        result.filtered_state[end], result.filtered_covariance[end] = x, P
        result.predicted_state[end] = part.A[-1] @ x + part.B[-1] @ self.u[-1]
        result.predicted_covariance[end] = part.A[-1] @ P @ part.A[-1].T + part.Q[-1]
        result.compression_deviation[end] = 0.0
        result.compression_covariance[end] = P
        return rejections

    def news(self, group: Sequence[int]) -> tuple[Array, Array]:
        """What the rows of a group say beyond the host's, whitened: c; and M in x* - x = M c.

        Rows of M are in units of the host's standard deviations at the end of the window.
        """
        joint = joint_distribution(self.part, self.u)
        seen = np.isfinite(only(self.y, self.soft.host))
        new = np.isfinite(only(self.y, group))
        host = whiten(joint.measurement_root[seen])
        coordinates = host.weights @ (self.y - joint.measurement_mean)[seen]
        whole = joint.measurement_root[new]
        residual = (self.y - joint.measurement_mean)[new] - whole @ (host.directions @ coordinates)
        dust = RANK_TOLERANCE * np.linalg.norm(whole, axis=1)
        beyond = whiten(host.unexplained(whole), negligible=dust)
        state = host.unexplained(joint.state_root[self.part.length - 1])
        deviation = np.linalg.norm(state, axis=1)
        known = deviation > 0.0
        M = (state @ beyond.directions)[known] / deviation[known][:, None]
        return beyond.weights @ residual, M

    def _verdicts(
        self, result: CompressionResult, policy: Policy, end: int
    ) -> tuple[tuple[int, ...], tuple[int, ...]]:
        from scipy.stats import chi2  # noqa: PLC0415 - slow to import

        accepted: list[int] = []
        rejected: list[int] = []
        for g, group in enumerate(self.soft.groups):
            if not np.isfinite(self.y[:, list(group)]).any():
                continue
            c, M = self.news(group)
            statistic, dof, faintest = quadratic_form(c, M, policy.negligible)
            result.test_dof[end, g], result.faintest[end, g] = dof, faintest
            result.test_statistic[end, g] = statistic if dof else np.nan
            fault = policy.test and dof > 0 and statistic > chi2.isf(self.soft.false_alarm, dof)
            result.fault_declared[end, g] = float(fault)
            (rejected if fault else accepted).append(g)
        return tuple(accepted), tuple(rejected)


def quadratic_form(c: Array, M: Array, negligible: float) -> tuple[float, int, float]:
    """The statistic d' (M M')^+ d for d = M c, the rank of M M', and the smallest pivot.

    Rows of M are chosen by LAPACK's elimination with diagonal pivoting; the statistic is the square
    of the projection of c on them.
    """
    from scipy.linalg.lapack import dpstrf  # noqa: PLC0415 - slow to import

    if not M.size:
        return 0.0, 0, np.nan
    factor, order, rank, _ = dpstrf(M @ M.T, tol=negligible, lower=1)
    if not rank:
        return 0.0, 0, np.nan
    basis, _ = np.linalg.qr(M[order[:rank] - 1].T)
    return float(np.sum((basis.T @ c) ** 2)), int(rank), float(factor[rank - 1, rank - 1] ** 2)
