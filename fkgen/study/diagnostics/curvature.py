"""How nonlinear f and h are where the filter runs: over the spread of its estimate, against noise.

For errors e of covariance P = L L' second-order terms of a function g are q = e' g'' e / 2, with

    E[q_i] = tr(g_i'' P) / 2,   Cov(q_i, q_j) = tr(g_i'' P g_j'' P) / 2

(Jazwinski 1970, sec. 9.3). The derivatives are differences over one deviation, along columns of L:
a kink counts where the estimate may lie beyond it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from fkgen.families import NAMES, family
from fkgen.faults.actuator import pattern_law
from fkgen.oracle.plants.actuator import actuation_of
from fkgen.oracle.plants.nonlinear import NonlinearSystem
from fkgen.problem import Signal, Spec
from fkgen.problem.equations import Equations
from fkgen.study.diagnostics.subject import Array, Subject
from fkgen.study.diagnostics.trajectory import Trajectory
from fkgen.trials.errors import error_signals, errors_of, moved_by, numbers_of, reduced

#: Root mean square of second-order terms, and means of errors, in deviations, that nobody notices:
#: the normalised square of an error grows by the square of it.
SMALL = 0.3
#: From here on what is not linear is most of the error, which is then far from Gaussian.
LARGE = 1.0
_ROUNDED = 1e-6  # what is less of a deviation comes of rounding
_MANY_INPUTS = 10
_WAYS = ("point", "anew", "spread")  # the cheapest first
_FINEST = 64

#: d (..., T, e) -> the change of a function over all samples (..., T, m).
_Change = Callable[[Array], Array]


@dataclass(frozen=True, slots=True, eq=False)
class Terms:
    """Second-order terms over the samples."""

    mean: Array  # (T, m)
    covariance: Array  # (T, m, m)

    def shares(self, deviation: Array) -> Array:
        """Root mean squares in deviations (T, m); 0 where there is neither."""
        size = np.sqrt(self.mean**2 + np.diagonal(self.covariance, axis1=1, axis2=2).clip(0.0))
        safe = np.where(deviation > 0.0, deviation, 1.0)
        return np.asarray(np.where(deviation > 0.0, size / safe, np.where(size > 0, np.inf, 0.0)))


def roots(covariance: Array) -> Array:
    """(T, e, e) with L L' = P, along principal axes of the correlations."""
    size = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1).clip(0.0))
    outer = size[..., :, None] * size[..., None, :]
    there = outer > 0.0
    correlation = np.divide(covariance, outer, out=np.zeros_like(covariance), where=there)
    values, vectors = np.linalg.eigh(correlation)
    return np.asarray(size[..., :, None] * vectors * np.sqrt(values.clip(0.0))[..., None, :])


def second_order(change: _Change, root: Array) -> Terms:
    """The second-order terms of a function, from its changes over columns of L (T, e, r)."""
    columns = np.moveaxis(root, -1, 0)
    r = len(columns)
    plus, minus = change(columns), change(-columns)
    second = np.zeros((r, r, *plus.shape[1:]))
    for j in range(r):
        second[j, j] = plus[j] + minus[j]
        for k in range(j):
            a, b = columns[j] + columns[k], columns[j] - columns[k]
            crossed = change(np.stack([a, -a, b, -b]))
            second[j, k] = second[k, j] = (crossed[:2].sum(axis=0) - crossed[2:].sum(axis=0)) / 4
    mean = 0.5 * np.einsum("jjti->ti", second)
    return Terms(mean, 0.5 * np.einsum("jkti,jkta->tia", second, second))


class Curved:
    """f and h of one plant over the samples of a trajectory, as changes by errors."""

    def __init__(self, path: Trajectory, equations: Equations, system: NonlinearSystem) -> None:
        self.path, self.equations, self.system = path, equations, system
        model = path.spec.model
        self.states, self.outputs = model.states, model.outputs
        self.params = {
            name: np.array([each[name] for each in system.parameters])
            for name in system.parameters[0]
        }
        self.u = tuple(path.u.T)

    def seen(self, x: Array) -> Array:
        """H of states (..., T, nx)."""
        found = self.equations.seen(numbers_of(x), self.u, self.params)
        return _stacked(found, x.shape[:-1])

    def moved(self, x: Array, w: Array | None = None) -> Array:
        """F of states (..., T, nx) and noises (..., T, r)."""
        r = len(self.equations.noises)
        w = np.zeros((*x.shape[:-1], r)) if w is None else w
        found = self.equations.moved(numbers_of(x), self.u, numbers_of(w), self.params)
        return _stacked(found, x.shape[:-1])

    def change_of_h(self, x: Array) -> _Change:
        """By errors of states (T, nx)."""
        centre = self.seen(x)
        wraps = [each.wrap for each in self.outputs]

        def change(d: Array) -> Array:
            start = np.broadcast_to(x, (*d.shape[:-1], x.shape[-1]))
            apart = self.seen(moved_by(self.states, start, d)) - centre
            return np.asarray(np.where(wraps, reduced(apart), apart))

        return change

    def change_of_f(self, x: Array) -> _Change:
        """By errors of states (T, nx), then by noises."""
        centre, ne = self.moved(x), self.path.spec.model.ne

        def change(d: Array) -> Array:
            start = np.broadcast_to(x, (*d.shape[:-1], x.shape[-1]))
            there = self.moved(moved_by(self.states, start, d[..., :ne]), d[..., ne:])
            return errors_of(self.states, there, np.broadcast_to(centre, there.shape))

        return change

    def noises(self) -> tuple[Array, Array]:
        """Variances of w (T, r) and the covariance of what is added to x."""
        pairs = [self.system.noises(k) for k in range(self.path.T)]
        W, Q = zip(*pairs, strict=True)
        return np.array(W), np.array(Q)

    @property
    def spread(self) -> Array:
        """L of x(k|k) and w, (T, ne + r, ne + r)."""
        P, W = self.path.filtered[1], self.noises()[0]
        ne, r = P.shape[1], W.shape[1]
        whole = np.zeros((len(P), ne + r, ne + r))
        whole[:, :ne, :ne] = roots(P)
        whole[:, range(ne, ne + r), range(ne, ne + r)] = np.sqrt(W)
        return whole


def _stacked(values: Sequence[Array], shape: tuple[int, ...]) -> Array:
    if not values:
        return np.zeros((*shape, 0))
    return np.stack([np.broadcast_to(np.asarray(each, float), shape) for each in values], axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """Second-order terms along a trajectory, in deviations of the noise."""

    before: Array  # (T, p): of h over x(k|k-1), in deviations of R
    after: Array  # (T, p): over x(k|k)
    innovation: Array  # (T, p): over x(k|k-1), in deviations of the innovation
    motion: Array  # (T, ne): of f over x(k|k), in deviations of x(k+1|k)
    extended: Array  # (T, ne): mean of the error of ekf in its deviations, of second order
    iterated: Array  # (T, ne): of iekf


def measured(curved: Curved) -> Measured:
    """All of one plant."""
    path, system = curved.path, curved.system
    (x, P), (xf, Pf) = path.predicted, path.filtered
    h, f = curved.change_of_h(x), curved.change_of_f(xf)
    with np.errstate(all="ignore"):
        before, after = second_order(h, roots(P)), second_order(curved.change_of_h(xf), roots(Pf))
        moved = second_order(f, curved.spread)
    noise = np.sqrt(np.diagonal(system.R, axis1=1, axis2=2))
    H = np.array([system.seen(k, x[k], path.u[k]).H for k in range(path.T)])
    F = np.array([system.moved(k, xf[k], path.u[k]).F for k in range(path.T)])
    S = H @ P @ H.transpose(0, 2, 1) + system.R
    whole = np.sqrt(np.diagonal(S, axis1=1, axis2=2))
    noise = np.where(noise > 0.0, noise, whole)  # of an exact row there is no other measure
    ahead = np.sqrt(np.diagonal(_shifted(P, F, Pf), axis1=1, axis2=2).clip(0.0))
    bias = partial_bias(path, (H, S, F), moved.mean)
    return Measured(
        before=before.shares(noise),
        after=after.shares(noise),
        innovation=before.shares(whole),
        motion=moved.shares(ahead),
        extended=bias(before.mean),
        iterated=bias(after.mean),
    )


def _shifted(P: Array, F: Array, Pf: Array) -> Array:
    """P(k+1|k), the last one without its noise."""
    return np.concatenate([P[1:], F[-1:] @ Pf[-1:] @ F[-1:].transpose(0, 2, 1)])


def partial_bias(
    path: Trajectory, linear: tuple[Array, Array, Array], of_f: Array
) -> Callable[[Array], Array]:
    """The mean of the error that second-order terms of h (T, p) and of f leave, in deviations.

    m(k|k) = (I - K H) m(k|k-1) - K E[q_h], m(k+1|k) = F m(k|k) + E[q_f].
    """
    H, S, F = linear
    P, Pf = path.predicted[1], path.filtered[1]
    sd = np.sqrt(np.diagonal(Pf, axis1=1, axis2=2).clip(0.0))
    there = np.ones(S.shape[:2], bool) if path.drive.y is None else np.isfinite(path.drive.y)
    there &= path.accepted[:, None]

    def along(of_h: Array) -> Array:
        m, found = np.zeros(P.shape[1]), np.zeros(sd.shape)
        for k, used in enumerate(there):
            Hk, Sk = H[k][used], S[k][np.ix_(used, used)]
            K = P[k] @ Hk.T @ np.linalg.pinv(Sk, hermitian=True)
            m = m - K @ (Hk @ m + of_h[k][used])
            found[k] = np.divide(m, sd[k], out=np.zeros_like(m), where=sd[k] > 0.0)
            m = F[k] @ m + of_f[k]
        return found

    return along


def nonlinearity(model: Subject, path: Trajectory) -> None:
    """What second-order terms do, and which of ekf, iekf and ukf is enough for that."""
    curved = [
        Curved(path, plant.equations, system)
        for plant, system in zip(model.spec.plants, path.systems, strict=True)
        if plant.equations is not None
    ]
    found = [measured(each) for each in curved]
    worst = {
        name: np.max([getattr(each, name) for each in found], axis=0)
        for name in ("before", "after", "innovation", "motion")
    }
    model_ = model.spec.model
    rows, states = model_.outputs, error_signals(model_.states)
    for key, name, signals in (("h", "before", rows), ("f", "motion", states)):
        of = [each.name for each in signals]
        for when, part in (("start", slice(0, 1)), ("later", slice(path.T // 2, None))):
            largest = worst[name][part].max(axis=0)
            model.put(f"second_order_{key}.{when}", of, largest)
        if not np.isfinite(worst[name]).all():
            k, i = np.argwhere(~np.isfinite(worst[name]))[0]
            model.add("no_value", int(k), key=key, name=of[i], of=path.drive.of)
            return
    alone = model.spec.filter.traits.models == "one" and not model.spec.faults.plain()
    biases = {name: np.abs(getattr(found[0], name)) for name in ("extended", "iterated")}
    if alone:
        model.put("mean_error", [each.name for each in states], biases["extended"].max(axis=0))
    else:
        biases = {name: np.zeros_like(each) for name, each in biases.items()}
    _verdict(model, path, worst, biases)


def _verdict(
    model: Subject, path: Trajectory, worst: dict[str, Array], biases: dict[str, Array]
) -> None:
    """The first of the filters, the cheapest first, for which everything is small."""
    motion, largest = worst["motion"].max(), {n: float(each.max()) for n, each in worst.items()}
    left = {
        "point": max(largest["before"], motion, biases["extended"].max()),
        "anew": max(largest["after"], motion, biases["iterated"].max()),
    }
    enough = next((way for way, each in left.items() if each <= SMALL), "spread")
    if enough == "spread" and max(largest["innovation"], motion) > LARGE:
        enough = "none"
    own, order = family(model.spec.filter.family), [*_WAYS, "none"]
    code = "nonlinearity"
    if order.index(enough) > order.index(own.traits.looks):
        code += ".faults" if own.accepts else f".{enough}"
    outputs, states = model.spec.model.outputs, error_signals(model.spec.model.states)
    facts = {
        "h": _largest(worst["before"], outputs),
        "h_after": f"{largest['after']:.2g}",
        "f": _largest(worst["motion"], states),
        "of": path.drive.of,
        "enough": _named(enough),
        "family": own.name,
    }
    model.add(code, left["point"], **facts)


def _named(way: str) -> str:
    """The family about no faults that takes f and h in a way; none has the rest."""
    plain = (each for each in map(family, NAMES) if each.traits.nonlinear and not each.accepts)
    return next((each.name for each in plain if each.traits.looks == way), "")


def _largest(shares: Array, signals: Sequence[Signal]) -> str:
    """The largest share, where and when."""
    k, i = np.unravel_index(int(np.argmax(shares)), shares.shape)
    if shares[k, i] < _ROUNDED:
        return "0"
    return f"{shares[k, i]:.2g} ({signals[int(i)].name}, sample {k})"


def integration(model: Subject, path: Trajectory) -> None:
    """What substeps leave of dx/dt, in deviations of the prediction over a sample."""
    for plant, system in zip(model.spec.plants, path.systems, strict=True):
        equations = plant.equations
        if equations is None or equations.period is None:
            continue
        P = path.predicted[1]
        sd = np.sqrt(np.diagonal(np.concatenate([P[1:], P[-1:]]), axis1=1, axis2=2).clip(0.0))

        def off(count: int, equations: Equations = equations, sd: Array = sd) -> float:
            with np.errstate(all="ignore"):
                coarse, fine = (
                    Curved(path, replace(equations, substeps=n), system).moved(path.filtered[0])  # noqa: B023
                    for n in (count, 4 * count)
                )
                apart = np.abs(errors_of(model.spec.model.states, coarse, fine))
                share = np.where(sd > 0.0, apart / np.where(sd > 0.0, sd, 1.0), 0.0)
            return float(share.max()) if np.isfinite(share).all() else np.inf

        count = equations.substeps
        share = off(count)
        model.values["integration_error"] = max(share, model.values.get("integration_error", 0.0))
        if share <= 0.1:
            continue
        while count < _FINEST and off(count) > 0.01:
            count *= 2
        facts = {"integrator": equations.integrator, "substeps": equations.substeps}
        model.add("integration", share, count=count, **facts)


def inputs(model: Subject, path: Trajectory) -> None:
    """What f and h make of inputs that arrive or not, beside what they make of their mean."""
    spec, q = model.spec, model.spec.model.nu
    if spec.faults.actuator is None or spec.model.equations is None or not 0 < q <= _MANY_INPUTS:
        return
    law = _patterns(spec, path)
    if law is None:
        return
    curved = Curved(path, spec.model.equations, path.systems[0])
    u, (patterns, chances) = path.drive.u, law
    if not u.any():
        u = np.ones_like(u)
    sizes = {
        "h": np.sqrt(np.diagonal(curved.system.R, axis1=1, axis2=2)),
        "f": np.sqrt(np.diagonal(path.predicted[1], axis1=1, axis2=2).clip(0.0)),
    }
    found: dict[str, Array] = {}
    for key, at in (("f", path.filtered[0]), ("h", path.predicted[0])):
        values = []
        for pattern in (chances @ patterns, *patterns):
            curved.u = tuple((pattern * u).T)
            values.append(curved.moved(at) if key == "f" else curved.seen(at))
        centre = values[0]
        if key == "f":
            apart = [errors_of(spec.model.states, each, centre) for each in values[1:]]
        else:
            wraps = [each.wrap for each in spec.model.outputs]
            apart = [np.where(wraps, reduced(v - centre), v - centre) for v in values[1:]]
        off = np.abs(np.tensordot(chances, np.array(apart), axes=1))
        sd = sizes[key]
        found[key] = np.where(sd > 0.0, off / np.where(sd > 0.0, sd, 1.0), 0.0)
    signals = {"f": error_signals(spec.model.states), "h": spec.model.outputs}
    for key, shares in found.items():
        largest = float(shares.max(initial=0.0))
        model.values[f"not_affine_{key}"] = largest
        if largest > _ROUNDED:
            code = "not_affine" if largest > SMALL else "not_affine.little"
            model.add(
                code,
                largest,
                key=key,
                where=_largest(shares, signals[key]),
                family=spec.filter.family,
            )


def _patterns(spec: Spec, path: Trajectory) -> tuple[Array, Array] | None:
    """What of the inputs arrives, and how probably, at the first sample."""
    rate, covariance = actuation_of(spec, path.T, path.drive.params, spec.first_rates)
    q = rate.shape[1]
    patterns = np.array(list(product((1.0, 0.0), repeat=q)))
    faults = spec.faults.actuator
    if faults is not None and faults.dependence == "common":
        return np.array([np.ones(q), np.zeros(q)]), np.array([rate[0, 0], 1.0 - rate[0, 0]])
    if faults is not None and faults.dependence == "independent":
        return patterns, np.prod(np.where(patterns > 0.0, rate[0], 1.0 - rate[0]), axis=1)
    law = pattern_law(rate[0], covariance[0])
    return None if law is None else (patterns, law)
