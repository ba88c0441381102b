"""Filters over modes of nonlinear plants: multiple models, interacting, one-step.

Every mode is corrected and moved by the extended filter at an estimate of its own; weights are
logarithms. Mixtures are computed about their first component (`Space.mixture`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from fkgen.oracle.exact.gaussian import Array, mixture
from fkgen.oracle.exact.hypotheses import reweigh
from fkgen.oracle.plants.manifold import Gaussian
from fkgen.oracle.plants.nonlinear import NonlinearSystem
from fkgen.oracle.plants.sensor import SensorLaw, gamma_delta
from fkgen.oracle.textbook.mkf import patterns_of, scaled_pseudo_inverse
from fkgen.oracle.textbook.nonlinear import Corrected, Extended, agreement
from fkgen.oracle.textbook.switching import (
    Lumping,
    estimates,
    log_of,
    normalised,
    silent_lumped,
    step_law,
)

Ports = dict[str, Array]
Row = dict[str, ArrayLike]


@dataclass(frozen=True, eq=False, kw_only=True)
class Modes:
    """Plants of one state space, and the chain that says which of them holds."""

    systems: tuple[NonlinearSystem, ...]  # N conditions
    lumping: Lumping  # How M modes are made of them, and their chain
    announced: Array | None = None  # (T, M): The law of the mode at k + 1 as sample k has it

    @classmethod
    def of(
        cls,
        systems: Sequence[NonlinearSystem],
        transitions: Array,
        initial: Array,
        announced: Array | None = None,
    ) -> Modes:
        """Every condition is a mode; transitions (T, N, N), initial (N,)."""
        lumping = Lumping(shares=np.eye(len(systems)), kernels=transitions, initial=initial)
        return cls(systems=tuple(systems), lumping=lumping, announced=announced)

    def said(self, k: int, log_held: Array) -> Array:
        """Logs of the law of the next mode as sample k has it."""
        return log_held if self.announced is None else log_of(self.announced[k])


def sensor_modes(system: NonlinearSystem, law: SensorLaw, *, modes: Literal[4, 3] = 4) -> Modes:
    """The conditions of a sensor; as three modes those without signal are one."""
    T = system.length
    systems = tuple(system.told(law.rows, *gamma_delta(law, np.full(T, mode))) for mode in range(4))
    if modes == 3:
        return Modes(systems=systems, lumping=silent_lumped(law, T))
    return Modes.of(systems, law.steps(T), law.initial, law.announced)


def textbook_interacting(modes: Modes, y: Array, u: Array) -> Ports:
    """Run the filter of Blom & Bar-Shalom 1988; y (T, p), u (T, q)."""
    lumping, filters = modes.lumping, [Extended(system=each) for each in modes.systems]
    space, (of, condition) = modes.systems[0].space, np.nonzero(lumping.shares)
    first = [int(np.flatnonzero(each)[0]) for each in lumping.shares]  # says how a mode moves
    held = [(space.normal(filters[i].system.x0), filters[i].system.P0) for i in first]
    log_held, rows = log_of(lumping.initial), []
    for k, now in enumerate(y):
        found = [
            filters[c].update(k, held[m], now, u[k]) for m, c in zip(of, condition, strict=True)
        ]
        log_share = log_of(lumping.shares[of, condition])
        logs = log_share + [each.agreement[1] for each in found]
        within = [of == m for m in range(len(first))]
        log_posterior, row = _bayes(modes, log_held, logs, found, now)
        filtered = [
            _merged(filters, [(held[of[i]], found[i]) for i in np.flatnonzero(own)], logs[own])
            for own in within
        ]
        log_held = step_law(log_posterior, lumping.kernels[k])
        # Eq. (17). A mode that cannot come next has weight 0; any mixture will do for it.
        mixing = log_posterior + log_of(lumping.kernels[k].T)
        mixing[np.isneginf(log_held)] = log_posterior
        mixed = [space.mixture(w, *_stacked(filtered)) for w in np.exp(normalised(mixing))]
        held = [_moved(filters[i], k, each, u[k]) for i, each in zip(first, mixed, strict=True)]
        estimate = space.mixture(np.exp(log_posterior), *_stacked(filtered))
        said = modes.said(k, log_held)
        ahead = space.mixture(np.exp(said), *_stacked(held))
        row |= estimates(estimate, ahead, log_posterior, said)
        for when, each in (("mode_filtered", filtered), ("mode", held)):
            names = (f"{when}_state", f"{when}_covariance")
            row |= dict(zip(names, _stacked(each), strict=True))
        rows.append(row)
    return _ports(rows)


def textbook_gpb1(
    modes: Modes,
    y: Array,
    u: Array,
    *,
    covariance: Literal["moment_matched", "weighted", "paper", "paper_nominal"] = "moment_matched",
) -> Ports:
    """Run the one-step filter over the four conditions of a sensor, Sigalov & Oshman (3)-(10).

    Corrections are mixed as errors about the prediction; the state moves and T turns once.
    """
    filters = [Extended(system=each) for each in modes.systems]
    space = modes.systems[0].space
    x, priors = space.normal(modes.systems[0].x0), [modes.systems[0].P0] * len(filters)
    log_held, rows = log_of(modes.lumping.initial), []
    for k, now in enumerate(y):
        pairs = zip(filters, priors, strict=True)
        found = [each.update(k, (x, P), now, u[k]) for each, P in pairs]
        logs = np.array([each.agreement[1] for each in found])
        log_posterior, row = _bayes(modes, log_held, logs, found, now)
        d, P = (np.array([getattr(each, name) for each in found]) for name in "dP")
        d, P = d[:, : space.ne], P[:, : space.ne, : space.ne]
        mean, merged = mixture(np.exp(log_posterior), d, P)
        if covariance != "moment_matched":
            merged = np.einsum("i,iab->ab", np.exp(log_posterior), P)
        T = space.turned(mean)
        estimate = space.moved(x, mean), T @ merged @ T.T
        ahead = _moved(filters[0], k, estimate, u[k])
        log_held = step_law(log_posterior, modes.lumping.kernels[k])
        rows.append(row | estimates(estimate, ahead, log_posterior, modes.said(k, log_held)))
        x, priors = ahead[0], [ahead[1]] * len(filters)
        if covariance.startswith("paper"):  # (7) to the letter: as if delta were the only fault
            delta = [0, 0, 0, 0] if covariance == "paper_nominal" else [0, 1, 0, 1]
            alone = [(estimate[0], T @ P[i] @ T.T) for i in delta]
            priors = [_moved(filters[0], k, each, u[k])[1] for each in alone]
    return _ports(rows)


@dataclass(frozen=True, eq=False, kw_only=True)
class Hypotheses:
    """Rates of the actuators that are tried, one filter for each."""

    filters: tuple[Extended, ...]
    prior: Array  # (N,)
    weight_floor: float
    likelihood: Literal["mixture", "gaussian"]
    one_rate: bool  # Whether one number is the rate of all inputs


def textbook_bank(bank: Hypotheses, y: Array, u: Array) -> Ports:
    """Run one filter for each hypothesis and weigh them: Strandt, Schneider & Yaz (14)-(18)."""
    space, weights = bank.filters[0].system.space, bank.prior
    held = [(space.normal(each.system.x0), each.system.P0) for each in bank.filters]
    rows: list[Row] = []
    for k, now in enumerate(y):
        pairs = list(zip(bank.filters, held, strict=True))
        found = [each.update(k, before, now, u[k]) for each, before in pairs]
        logs = np.array([
            _log_likelihood(bank, each, k, (before, result), u[k])
            for (each, before), result in zip(pairs, found, strict=True)
        ])  # fmt: skip
        row = _expected(bank.filters[0].system, weights, found, now)
        evidence = log_of(weights) + logs
        row["log_likelihood"] = np.logaddexp.reduce(evidence) if np.isfinite(now).any() else 0.0
        weights = reweigh(weights, logs, now, bank.weight_floor)
        rate = weights @ np.array([each.rate[k] for each in bank.filters])
        filtered = [
            each.filtered(before, result)
            for (each, before), result in zip(pairs, found, strict=True)
        ]
        row |= {
            "mode_probability": weights,
            "success_rate_estimate": rate[0] if bank.one_rate else rate,
            "paper_state": space.mixture(weights, *_stacked(held))[0],
        }
        held = [
            each.predict(k, before, result, u[k])
            for (each, before), result in zip(pairs, found, strict=True)
        ]
        for when, each in (("filtered", filtered), ("predicted", held)):
            x, P = space.mixture(weights, *_stacked(each))
            row |= {f"{when}_state": x, f"{when}_covariance": P}
        rows.append(row)
    return _ports(rows)


def _log_likelihood(
    bank: Hypotheses, each: Extended, k: int, about: tuple[Gaussian, Corrected], u: Array
) -> float:
    """Log of p(y[k] | Y[k-1], xi): Gaussian (15), or the mixture over gamma[k], D at its mean."""
    (x, P), found = about
    patterns = None
    if bank.likelihood == "mixture":
        patterns = patterns_of(each.rate[k], each.fault_covariance[k])
    if patterns is None:
        return found.agreement[1]
    used, seen = found.used, each.system.seen(k, x, each.rate[k] * u)
    H, D = seen.H[used], seen.D[used]
    S = H @ P @ H.T + each.system.R[k][np.ix_(used, used)]
    apart = (patterns[0] - each.rate[k]) * u
    densities = [agreement(found.innovation[used] - D @ a, S)[1] for a in apart]
    return float(np.logaddexp.reduce(log_of(patterns[1]) + densities))


def _bayes(
    modes: Modes, log_held: Array, logs: Array, found: list[Corrected], y: Array
) -> tuple[Array, Row]:
    """Logs of the law of the mode given y, eq. (8), and the ports that compare y with the past."""
    shares = modes.lumping.shares
    of, condition = np.nonzero(shares)
    joint = log_held[of] + logs
    of_modes = np.array([np.logaddexp.reduce(joint[of == m]) for m in range(len(shares))])
    before = np.exp(log_held[of] + log_of(shares[of, condition]))
    row = _expected(modes.systems[0], before, found, y)
    row["log_likelihood"] = np.logaddexp.reduce(joint) if np.isfinite(y).any() else 0.0
    return normalised(of_modes), row


def _expected(system: NonlinearSystem, weights: Array, found: list[Corrected], y: Array) -> Row:
    """What a mixture expected of y, about its first component, and how y fits."""
    first = found[0].expected
    apart = np.array([system.residual(each.expected, first) for each in found])
    mean, S = mixture(weights, apart, np.array([each.S for each in found]))
    residual = system.residual(y, first + mean)
    finite = np.isfinite(y)
    inverse = scaled_pseudo_inverse(S[np.ix_(finite, finite)])
    return {
        "innovation": residual,
        "innovation_covariance": S,
        "nis": residual[finite] @ inverse @ residual[finite] if finite.any() else 0.0,
    }


def _merged(
    filters: list[Extended], parts: list[tuple[Gaussian, Corrected]], logs: Array
) -> Gaussian:
    """The estimate of a mode that is a mixture of conditions."""
    space = filters[0].system.space
    filtered = [filters[0].filtered(*part) for part in parts]
    return space.mixture(np.exp(normalised(logs)), *_stacked(filtered))


def _moved(each: Extended, k: int, estimate: Gaussian, u: Array) -> Gaussian:
    """The prediction from an estimate."""
    moved = each.system.moved(k, estimate[0], u)
    W, Q = each.system.noises(k)
    return moved.x, moved.F @ estimate[1] @ moved.F.T + moved.G @ np.diag(W) @ moved.G.T + Q


def _stacked(estimates: Sequence[Gaussian]) -> Gaussian:
    """States (N, nx) and covariances (N, ne, ne)."""
    return np.array([x for x, _ in estimates]), np.array([P for _, P in estimates])


def _ports(rows: list[Row]) -> Ports:
    """One array per port."""
    return {name: np.array([row[name] for row in rows], float) for name in rows[0]}
