"""Host and compression filters from joint distributions, window by window.

Nothing but (x, P) passes from one to the next, so a window is a record with a prior of its own. The
statistic comes from a square root of D = P - P*: what compressed rows say beyond the host's.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from fkgen.faults import SoftFaults
from fkgen.oracle.exact.batch import BatchResult, batch_lmmse, joint_distribution
from fkgen.oracle.exact.gaussian import RANK_TOLERANCE, Array, whiten
from fkgen.oracle.plants.actuator import LinearSystem


@dataclass(frozen=True, eq=False, kw_only=True)
class CompressionResult(BatchResult):
    """Estimates of the host after what it accepts, with `nis` and likelihood of its own rows."""

    #: (T, s, n), (T, s, n, n): Of every set of groups: its estimate minus the host's, and its
    #: covariance
    compression_deviation: Array
    compression_covariance: Array
    test_statistic: Array  # (T, g), as the next three: NaN, 0 and 0 where no test is made
    test_dof: Array
    fault_declared: Array
    #: Smallest share of a variance of the host that the compressed rows remove along a direction
    #: that counts; NaN where no test is made. The statistic divides by it
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


def only(y: Array, rows: Iterable[int]) -> Array:
    """The record with all other rows missing."""
    result = np.full_like(y, np.nan)
    result[:, list(rows)] = y[:, list(rows)]
    return result


def accepted_rows(soft: SoftFaults, y: Array, ends: Sequence[int], accepted: Array) -> Array:
    """The measurements (T, p) that the host has taken over; accepted (windows, groups)."""
    result, begin = only(y, soft.host), 0
    for end, flags in zip(ends, accepted, strict=True):
        rows = [row for g in np.flatnonzero(flags) for row in soft.groups[g]]
        result[begin : end + 1, rows] = y[begin : end + 1, rows]
        begin = end + 1
    return result


def batch_compression(
    system: LinearSystem, soft: SoftFaults, policy: Policy, y: Array, u: Array | None
) -> CompressionResult:
    """Filter a record; y (T, p), u (T, q): Lee & Lee, Theorems 2 and 3, (50), (51).

    From their statement: the host is the Kalman filter of its rows and of what it accepted.
    """
    T, inputs, pieces = system.length, system.inputs(u), []
    ends = [*range(policy.first, T, soft.window)] if policy.first else []
    begin, rejections, x, P = 0, 0, system.x0, system.P0
    for last in dict.fromkeys([*ends, T - 1]):
        piece = slice(begin, last + 1)
        part = replace(system.over(piece), x0=x, P0=P)
        window = _Window(part, soft, y[piece], inputs[piece])
        ports = window.projections()
        if last in ends:
            rejections = window.close(ports, policy, rejections)
        begin, x, P = last + 1, ports["predicted_state"][-1], ports["predicted_covariance"][-1]
        pieces.append(ports)
    return CompressionResult(
        **{name: np.concatenate([ports[name] for ports in pieces]) for name in pieces[0]}
    )


@dataclass(frozen=True, eq=False)
class _Window:
    """A window: the plant with the prior of its first sample, and the record."""

    part: LinearSystem
    soft: SoftFaults
    y: Array
    u: Array

    @property
    def subsets(self) -> list[tuple[int, ...]]:
        """Every set of groups that may be accepted, the small ones first."""
        groups = range(len(self.soft.groups))
        return [s for size in range(1, len(groups) + 1) for s in combinations(groups, size)]

    def projections(self) -> dict[str, Array]:
        """Project on the rows of the host, and on those of each set of groups too."""
        part, soft = self.part, self.soft
        host, *found = (
            batch_lmmse(part, only(self.y, sum((soft.groups[g] for g in s), soft.host)), self.u)
            for s in ((), *self.subsets)
        )
        before = np.vstack([part.x0, host.predicted_state[:-1]])
        predicted = part.C @ before[..., None] + part.D @ self.u[..., None] + part.d[..., None]
        deviations = [each.filtered_state - host.filtered_state for each in found]
        untested = np.zeros((len(self.y), len(soft.groups)))
        return {
            **vars(host),
            "innovation": self.y - predicted[..., 0],
            "compression_deviation": np.stack(deviations, axis=1),
            "compression_covariance": np.stack([each.filtered_covariance for each in found], 1),
            "test_statistic": untested + np.nan,
            "test_dof": untested.copy(),
            "fault_declared": untested.copy(),
            "faintest": untested + np.nan,
        }

    def close(self, ports: dict[str, Array], policy: Policy, rejections: int) -> int:
        """Test every group, take over what passes; return the windows of rejections in a row."""
        part = self.part
        accepted, rejected = self._verdicts(ports, policy)
        x, P = ports["filtered_state"][-1], ports["filtered_covariance"][-1]
        d = ports["compression_deviation"][-1, -1].copy()
        if accepted:
            at = self.subsets.index(accepted)
            x += ports["compression_deviation"][-1, at]
            P[:] = ports["compression_covariance"][-1, at]
        rejections = 0 if accepted else rejections + rejected
        if policy.reacquire is not None and rejections >= policy.reacquire:
            P += np.outer(d, d)
        ports["predicted_state"][-1] = part.A[-1] @ x + part.B[-1] @ self.u[-1] + part.c[-1]
        ports["predicted_covariance"][-1] = part.A[-1] @ P @ part.A[-1].T + part.Q[-1]
        ports["compression_deviation"][-1] = 0.0
        ports["compression_covariance"][-1] = P
        return rejections

    def _news(self, group: Sequence[int]) -> tuple[Array, Array]:
        """What a group says beyond the host, whitened: c; M in x* - x = M c, host's deviation 1."""
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

    def _verdicts(self, ports: dict[str, Array], policy: Policy) -> tuple[tuple[int, ...], bool]:
        """Groups that are accepted, and whether any is rejected."""
        from scipy.special import chdtri  # noqa: PLC0415 - slow to import

        accepted, rejected = [], False
        for g, group in enumerate(self.soft.groups):
            if not np.isfinite(self.y[:, list(group)]).any():
                continue
            statistic, dof, faintest = quadratic_form(*self._news(group), policy.negligible)
            fault = policy.test and dof > 0 and statistic > chdtri(dof, self.soft.false_alarm)
            ports["test_dof"][-1, g], ports["faintest"][-1, g] = dof, faintest
            ports["test_statistic"][-1, g] = statistic if dof else np.nan
            ports["fault_declared"][-1, g] = fault
            rejected |= bool(fault)
            if not fault:
                accepted.append(g)
        return tuple(accepted), rejected


def quadratic_form(c: Array, M: Array, negligible: float) -> tuple[float, int, float]:
    """The statistic d' (M M')^+ d for d = M c, the rank of M M', and the smallest pivot.

    It is the square of the projection of c on rows of M that LAPACK's diagonal pivoting chooses.
    """
    from scipy.linalg.lapack import dpstrf  # noqa: PLC0415 - slow to import

    if not M.size:
        return 0.0, 0, np.nan
    factor, order, rank, _ = dpstrf(M @ M.T, tol=negligible, lower=1)
    if not rank:
        return 0.0, 0, np.nan
    basis, _ = np.linalg.qr(M[order[:rank] - 1].T)
    return float(np.sum((basis.T @ c) ** 2)), int(rank), float(factor[rank - 1, rank - 1] ** 2)
