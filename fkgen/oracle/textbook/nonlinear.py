"""Extended, iterated and unscented Kalman filters in whole matrices, on vectors and rotations.

Jazwinski 1970, sec. 8.3; Bell & Cathey 1993; Julier & Uhlmann 1997. An estimate is a state and the
covariance of its error; a correction d is found in errors about the prediction, then the state
moves, x (+) d, and the covariance turns with it, T P T' (`Space.turned`).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from fkgen.oracle.exact.gate import Flags, outliers
from fkgen.oracle.exact.gaussian import Array, log_density, square_root, units, whiten
from fkgen.oracle.plants.dual import values_of
from fkgen.oracle.plants.manifold import Gaussian
from fkgen.oracle.plants.nonlinear import NonlinearSystem, Seen
from fkgen.oracle.textbook.mkf import scaled_pseudo_inverse

#: A pivot of a covariance below this share of its variance is the zero of a semidefinite one.
NO_PIVOT = 1e-14

#: Costs that differ by a smaller share than this are told apart by rounding.
UNDECIDED = 1e-12


@dataclass(frozen=True, eq=False, kw_only=True)
class Corrected:
    """One sample taken in: what was expected, and the estimate in errors about the prediction.

    Errors are those of the state, then of the inputs and of the noise that is added to the state.
    """

    expected: Array  # (p,)
    S: Array  # (p, p): Of all rows
    innovation: Array  # (p,)
    used: Flags  # (p,): Whether a row is there and not rejected
    d: Array  # (e,), (e, e): Mean and covariance of the errors given y
    P: Array
    others: dict[str, ArrayLike] = field(default_factory=dict)  # Ports that not every filter has

    @property
    def agreement(self) -> tuple[float, float]:
        """Normalised square and Gaussian log density of the rows used."""
        return agreement(self.innovation[self.used], self.S[np.ix_(self.used, self.used)])


def agreement(innovation: Array, S: Array) -> tuple[float, float]:
    """Normalised square and Gaussian log density, 0 if there is no row."""
    if not innovation.size:
        return 0.0, 0.0
    whitening = whiten(square_root(S))
    square = float(np.sum((whitening.weights @ innovation) ** 2))
    return square, log_density(innovation, whitening)


@dataclass(frozen=True, eq=False, kw_only=True)
class Extended:
    """The filter ekf; with random inputs mkf, with the signals that are there genie."""

    system: NonlinearSystem
    rate: Array = field(default_factory=lambda: np.zeros(0))  # (T, q): Mean of gamma, 1 if empty
    #: (T, q, q): Covariance of gamma, 0 if empty
    fault_covariance: Array = field(default_factory=lambda: np.zeros(0))
    gate: tuple[float, bool] | None = None  # Its probability, and whether rows are judged together

    def run(self, y: Array, u: Array) -> dict[str, Array]:
        """Ports of a record; y (T, p), u (T, q)."""
        system = self.system
        prior: Gaussian = (system.space.normal(system.x0), system.P0)
        rows = []
        for k, now in enumerate(y):
            found = self.update(k, prior, now, u[k])
            x, P = self.filtered(prior, found)
            prior = self.predict(k, prior, found, u[k])
            rows.append(innovation_ports(found) | {
                "filtered_state": x, "filtered_covariance": P,
                "predicted_state": prior[0], "predicted_covariance": prior[1],
            })  # fmt: skip
        return {name: np.array([row[name] for row in rows], float) for name in rows[0]}

    def actuation(self, k: int, u: Array) -> tuple[Array, Array]:
        """Mean and covariance of what the inputs are."""
        if not self.rate.size:
            return u, np.zeros((u.size, u.size))
        return self.rate[k] * u, np.diag(u) @ self.fault_covariance[k] @ np.diag(u)

    def update(self, k: int, prior: Gaussian, y: Array, u: Array) -> Corrected:
        """Correct with h linearised at x(k|k-1)."""
        system, (worked, N) = self.system, self.actuation(k, u)
        seen = system.seen(k, prior[0], worked)
        H = np.hstack([seen.H, seen.D, np.zeros(system.S[k].T.shape)])
        joint = _joint(prior[1], N, system.noises(k)[1], system.R[k])
        errors, ne = len(joint) - system.ny, system.space.ne
        joint[errors - ne : errors, errors:] = system.S[k]
        joint[errors:, errors - ne : errors] = system.S[k].T
        through = np.hstack([H, np.eye(system.ny)])
        S = through @ joint @ through.T
        innovation = system.residual(y, seen.y)
        used, others = self.judge(innovation, S)
        K = gain((joint @ through[used].T)[:errors], S[np.ix_(used, used)])
        left = np.eye(errors, len(joint)) - K @ through[used]
        return Corrected(
            expected=seen.y,
            S=S,
            innovation=innovation,
            used=used,
            d=K @ innovation[used],
            P=left @ joint @ left.T,
            others=others,
        )

    def judge(self, innovation: Array, S: Array) -> tuple[Flags, dict[str, ArrayLike]]:
        """The rows that are used, and the port of a gate."""
        finite = np.isfinite(innovation)
        if self.gate is None:
            return finite, {}
        probability, together = self.gate
        rejected = outliers(innovation, S, probability, together=together)
        return finite & ~rejected, {"rejected": rejected * 1.0}

    def filtered(self, prior: Gaussian, found: Corrected) -> Gaussian:
        """x(k|k) and its covariance."""
        ne = self.system.space.ne
        T = self.system.space.turned(found.d[:ne])
        return self.system.space.moved(prior[0], found.d[:ne]), T @ found.P[:ne, :ne] @ T.T

    def predict(self, k: int, prior: Gaussian, found: Corrected, u: Array) -> Gaussian:
        """Move on with f linearised at x(k|k); what y says of inputs and noise moves the state."""
        space = self.system.space
        ne, system = space.ne, self.system
        x, P = self.filtered(prior, found)
        moved = system.moved(k, x, self.actuation(k, u)[0])
        W, Q = system.noises(k)
        spread = moved.G @ np.diag(W) @ moved.G.T
        if len(found.d) == ne:  # y tells of the state alone
            return moved.x, moved.F @ P @ moved.F.T + spread + Q
        A = np.hstack([moved.F @ space.turned(found.d[:ne]), moved.B, np.eye(ne)])
        shift = A[:, ne:] @ found.d[ne:]
        T = space.turned(shift)
        return space.moved(moved.x, shift), T @ (A @ found.P @ A.T + spread) @ T.T


def innovation_ports(found: Corrected) -> dict[str, ArrayLike]:
    """The ports of one sample that compare y with what was expected."""
    nis, log_likelihood = found.agreement
    ports: dict[str, ArrayLike] = {
        "innovation": found.innovation,
        "innovation_covariance": found.S,
        "nis": nis,
        "log_likelihood": log_likelihood,
    }
    return ports | found.others


def gain(cross: Array, S: Array) -> Array:
    """Cov(e, y) S^-1, of a singular S with its pseudo-inverse."""
    return cross @ scaled_pseudo_inverse(S) if S.size else cross


def _stabilised(K: Array, H: Array, P: Array, R: Array) -> Array:
    """Joseph's form."""
    E = np.eye(len(P)) - K @ H
    return np.asarray(E @ P @ E.T + K @ R @ K.T)


def _joint(*covariances: Array) -> Array:
    """The covariance of vectors that are not correlated."""
    size, at = sum(map(len, covariances)), 0
    joint = np.zeros((size, size))
    for each in covariances:
        joint[at : at + len(each), at : at + len(each)] = each
        at += len(each)
    return joint


@dataclass(frozen=True, eq=False, kw_only=True)
class Iterated(Extended):
    """The filter iekf: Gauss and Newton's steps down the cost of the maximum a posteriori.

    Beside its ports there are `decided`, 0 where rounding says whether the last step lowers the
    cost, and `doubt`: how far, in deviations, that step goes; 0 if it is decided.
    """

    iterations: int = 3

    def update(self, k: int, prior: Gaussian, y: Array, u: Array) -> Corrected:
        """Correct with h linearised anew at every step, d = P a."""
        found = super().update(k, prior, y, u)
        used, (x, P) = found.used, prior
        R = self.system.R[k][np.ix_(used, used)]
        a, ports = np.zeros(len(P)), {"stayed": 0.0, "doubt": 0.0, "decided": 1.0}
        seen, r = self._about(k, x, P @ a, (y, u))
        for _ in range(self.iterations):
            H = seen.H[used]
            S = H @ P @ H.T + R
            K = gain(P @ H.T, S)
            beyond = H.T @ scaled_pseudo_inverse(S) @ (r[used] + H @ P @ a) if used.any() else a
            seen_there, r_there = self._about(k, x, P @ beyond, (y, u))
            now, then = _cost(a, P, r[used], R), _cost(beyond, P, r_there[used], R)
            if abs(now - then) <= UNDECIDED * now:
                ports["decided"] = 0.0
                ports["doubt"] = float(np.abs(P @ (beyond - a) / units(P)).max(initial=0.0))
            if not then < now:
                ports["stayed"] = 1.0
                break
            a, seen, r = beyond, seen_there, r_there
        return Corrected(
            expected=found.expected,
            S=found.S,
            innovation=found.innovation,
            used=used,
            d=P @ a,
            P=_stabilised(K, H, P, R),
            others=dict(ports),
        )

    def _about(self, k: int, x: Array, d: Array, given: tuple[Array, Array]) -> tuple[Seen, Array]:
        """Linearise h at x (+) d, and the residual there."""
        seen = self.system.seen(k, x, given[1], d)
        return seen, self.system.residual(given[0], seen.y)


def _cost(a: Array, P: Array, r: Array, R: Array) -> float:
    """The cost d' P^-1 d + r' R^-1 r with d = P a."""
    return float(a @ P @ a + r @ np.linalg.solve(R, r))


@dataclass(frozen=True, eq=False, kw_only=True)
class Unscented(Extended):
    """The filter ukf: moments of points instead of derivatives."""

    kappa: float = 0.0

    def weights(self, N: int) -> Array:
        """Those of the points of N errors, the centre first if it has one."""
        around = np.full(2 * N, 0.5 / (N + self.kappa))
        return np.append(self.kappa / (N + self.kappa), around) if self.kappa else around

    def points(self, P: Array) -> Array:
        """Errors (., N) whose mean is 0 and whose covariance is P: plus columns, minus columns."""
        N = len(P)
        columns = np.sqrt(N + self.kappa) * lower_root(P).T
        centre = np.zeros((1 if self.kappa else 0, N))
        return np.vstack([centre, columns, -columns])

    def update(self, k: int, prior: Gaussian, y: Array, u: Array) -> Corrected:
        """Correct with points drawn from the prediction."""
        system, (x, P) = self.system, prior
        e, weights = self.points(P), self.weights(len(P))
        seen = np.array([system.measured(k, values_of(system.space.plus(x, d)), u) for d in e])
        expected = seen[0] + weights @ np.array([system.residual(z, seen[0]) for z in seen])
        spread = np.array([system.residual(z, expected) for z in seen])
        S = np.einsum("i,ia,ib->ab", weights, spread, spread) + system.R[k]
        innovation = system.residual(y, expected)
        used, others = self.judge(innovation, S)
        cross = np.einsum("i,ia,ib->ab", weights, e, spread[:, used])
        K = gain(cross, S[np.ix_(used, used)])
        return Corrected(
            expected=expected,
            S=S,
            innovation=innovation,
            used=used,
            d=K @ innovation[used],
            P=P - K @ S[np.ix_(used, used)] @ K.T,
            others=others,
        )

    def predict(self, k: int, prior: Gaussian, found: Corrected, u: Array) -> Gaussian:
        """Send points of state and noises through f; mean and deviations on the manifold."""
        system, space = self.system, self.system.space
        x, P = self.filtered(prior, found)
        W, Q = system.noises(k)
        e, weights = self.points(_joint(P, np.diag(W))), self.weights(len(P) + len(W))
        moved = np.array([
            space.normal(values_of(system.step(k, space.plus(x, d[: space.ne]), u, d[space.ne :])))
            for d in e
        ])  # fmt: skip
        mean = space.moved(moved[0], weights @ np.array([space.minus(z, moved[0]) for z in moved]))
        spread = np.array([space.minus(z, mean) for z in moved])
        return mean, np.einsum("i,ia,ib->ab", weights, spread, spread) + Q


def lower_root(P: Array) -> Array:
    """Cholesky's factor of a semidefinite matrix, with a column of zeros for each zero pivot."""
    L = np.zeros(P.shape)
    for j in range(len(P)):
        rest = P[j:, j] - L[j:, :j] @ L[j, :j]
        if rest[0] > NO_PIVOT * P[j, j]:
            L[j:, j] = rest / np.sqrt(rest[0])
    return L
