"""Fixed-interval smoothing: x(k | all of the record), by a pass backwards through a run in C.

With the errors of predictions e[k+1] = F e[k] + w - K v and innovations nu = C e + v, sums from the
end of the record on, r = C' S^-1 nu + F' r, M = C' S^-1 C + F' M F, say what later samples tell of
e[k+1] (de Jong 1989, Biometrika 76; Durbin & Koopman 2012, sec. 4.4). No covariance of states is
inverted, and F is stable where the filter is: singular P and Q, and states that die away, do no
harm. M is the response of r to e, and what noise adds has a covariance N of its own; smoothed
covariances are sums of squares of both, as in Joseph's form, which keeps their digits where priors
are vague.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import DataError
from fkgen.problem import Spec
from fkgen.symbolic.interface import UPDATED

if TYPE_CHECKING:
    from fkgen.runtime.results import Run, Snapshot

Array = NDArray[np.float64]

#: Samples whose matrices are in memory at a time.
PIECE = 2**15

#: What of a correlation matrix of innovations counts as zero: rows without noise that others imply.
NEGLIGIBLE = 1e-13

#: What a run has to keep for a smoother.
PORTS = (
    *("predicted_state", "predicted_covariance", "filtered_state", "filtered_covariance"),
    "innovation",
)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Smoothed:
    """Estimates of a whole record from all of it.

    Attributes
    ----------
    state : (T, n) ndarray
        x(k | T - 1). At a held sample no time passed: it repeats the sample before it.
    covariance : (T, n, n) ndarray
        Its error covariance; an attitude has 3 rows.
    status : (T,) ndarray of int32
        That of the filter: a refused sample counts as missing, but its state is estimated.
    approximate : bool
        The plant is linearised, so that these are no exact means and covariances.
    """

    state: Array
    covariance: Array
    status: NDArray[np.int32]
    approximate: bool

    def __repr__(self) -> str:
        T, n = self.state.shape
        return f"<Smoothed: {T} samples of {n} states{', approximate' * self.approximate}>"


def smoothable(path: Path) -> Spec:
    """The spec of a filter, whose estimates can be smoothed.

    Raises
    ------
    DataError
        If its family has no smoother, or it is in a package that is not here.
    """
    from fkgen.families import NAMES, family  # noqa: PLC0415 - few filters are smoothed

    facts: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    spec = Spec.from_dict(facts["spec"])
    if not spec.filter.traits.hindsight:
        able = ", ".join(name for name in NAMES if family(name).traits.hindsight)
        gain = " with a stationary gain" * family(spec.filter.family).traits.hindsight
        given = f"a filter of the family {spec.filter.family}{gain}"
        raise DataError("smooth", given=given, expected=f"one of {able}, its gain not stationary")
    return spec


def smooth(
    spec: Spec,
    run: Run,
    prior: Snapshot,
    u: NDArray[np.floating],
    parameters: list[NDArray[np.floating]],
) -> Smoothed:
    """Smooth a run that kept `PORTS`, from the instance that it began with."""
    T = len(run.status)
    kept = np.flatnonzero(~run.held)
    approximate = spec.filter.linearises
    state, covariance = (np.array(run[f"filtered_{of}"], float) for of in ("state", "covariance"))
    if len(kept):
        backwards = _Backwards.of(spec, run, prior, kept)
        given = [np.broadcast_to(each.astype(float), (T,)) for each in parameters]
        data = np.asarray(u, float).T, np.array(given).reshape(len(given), T)
        for piece, found in backwards.pieces(data):
            state[kept[piece]], covariance[kept[piece]] = found
        last = np.maximum(np.searchsorted(kept, np.arange(T), side="right") - 1, 0)
        state, covariance = state[kept[last]], covariance[kept[last]]
    return Smoothed(state=state, covariance=covariance, status=run.status, approximate=approximate)


@dataclass(slots=True)
class _Backwards:
    """A pass through the samples of a run at which time passed, the last of them first."""

    spec: Spec
    kept: NDArray[np.intp]
    predicted: tuple[Array, Array]  # x(k|k-1), P(k|k-1)
    filtered: tuple[Array, Array]
    innovation: Array  # 0 where a row was not used
    used: NDArray[np.bool_]

    @classmethod
    def of(cls, spec: Spec, run: Run, prior: Snapshot, kept: NDArray[np.intp]) -> _Backwards:
        latest = "filtered_" if _updated(prior) else "predicted_"
        predicted = []
        for of in ("state", "covariance"):
            before = np.asarray(run[f"predicted_{of}"][kept[:-1]], float)
            first = np.asarray(prior[f"{latest}{of}"], float)
            predicted.append(np.concatenate([first[np.newaxis], before]))
        innovation = np.asarray(run["innovation"][kept], float)
        used = np.isfinite(innovation) & (run.status[kept] >= 0)[:, np.newaxis]
        if "rejected" in run.ports:
            used &= ~run["rejected"][kept]
        return cls(
            spec=spec,
            kept=kept,
            predicted=(predicted[0], predicted[1]),
            filtered=(
                np.asarray(run["filtered_state"][kept], float),
                np.asarray(run["filtered_covariance"][kept], float),
            ),
            innovation=np.where(used, innovation, 0.0),
            used=used,
        )

    def pieces(self, data: tuple[Array, Array]) -> Iterator[tuple[slice, tuple[Array, Array]]]:
        """Smoothed states and covariances, piece by piece."""
        from fkgen.estimators.hindsight.linearised import Linearised  # noqa: PLC0415 - slow

        plant = Linearised(self.spec)
        matrices, moved = plant.matrices(), plant.moved()
        n = self.filtered[1].shape[-1]
        later = np.zeros((n, 1)), np.zeros((n, n)), np.zeros((n, n))
        for end in range(len(self.kept), 0, -PIECE):
            piece = slice(max(end - PIECE, 0), end)
            at = self.kept[piece]
            states = [each[0][piece].T for each in (self.predicted, self.filtered)]
            own = matrices((states[0], states[1], data[0][:, at], data[1][:, at]))
            if self.spec.model.attitudes:
                own["A"] = own["A"] @ self._turned(piece, own, moved[1])
            found, later = self._smoothed(piece, own, later)
            errors = found[0][..., 0].T
            none = np.zeros((0, errors.shape[1]))
            state = moved[0]((states[1], errors, none, none))[..., 0]
            turn = moved[1]((states[1], errors, none, none))
            yield piece, (state, turn @ found[1] @ _T(turn))

    def _turned(self, piece: slice, own: Mapping[str, Array], turned: Any) -> Array:
        """By what corrections turn the axes of errors."""
        inverse = _inverse(own["C"], self.predicted[1][piece], own["R"], self.used[piece])
        nu = self.innovation[piece][..., np.newaxis]
        errors = self.predicted[1][piece] @ _T(own["C"]) @ inverse @ nu
        none = np.zeros((0, len(errors)))
        found: Array = turned((self.predicted[0][piece].T, errors[..., 0].T, none, none))
        return found

    def _smoothed(
        self, piece: slice, own: Mapping[str, Array], later: tuple[Array, Array, Array]
    ) -> tuple[tuple[Array, Array], tuple[Array, Array, Array]]:
        """By what samples lie off their filtered states, with covariances; r, M, N at the first."""
        A, C, Q, R, S = (own[letter] for letter in "ACQRS")
        P, filtered = self.predicted[1][piece], self.filtered[1][piece]
        inverse = _inverse(C, P, R, self.used[piece])
        weighted = _T(C) @ inverse  # C' S^-1
        gain = (A @ P @ _T(C) + S) @ inverse
        F = A - gain @ C
        nu = self.innovation[piece][..., np.newaxis]
        r, first_r = _summed(F, weighted @ nu, later[0], both=False)
        M, first_M = _summed(F, weighted @ C, later[1])
        V = _T(F) @ M
        U = weighted - V @ gain
        noise = V @ S @ _T(U)
        N, first_N = _summed(F, U @ R @ _T(U) + V @ Q @ _T(V) + noise + _T(noise), later[2])
        cross = -P @ weighted @ _T(S)  # Cov(x, w | y)
        to_next = filtered @ _T(A) + cross
        gain = to_next @ M
        of_x, of_w = np.eye(A.shape[-1]) - gain @ A, -gain
        shared = of_x @ cross @ _T(of_w)
        covariance = of_x @ filtered @ _T(of_x) + shared + _T(shared)
        covariance += of_w @ (Q - S @ inverse @ _T(S)) @ _T(of_w) + to_next @ N @ _T(to_next)
        symmetric = (covariance + _T(covariance)) / 2.0
        return (to_next @ r, symmetric), (first_r, first_M, first_N)


def _T(matrices: Array) -> Array:
    return matrices.swapaxes(-1, -2)


def _updated(at: Snapshot) -> bool:
    """Whether the latest estimate of an instance is a filtered one."""
    return bool(getattr(at.layout.structure().from_buffer_copy(at.data), UPDATED))


def _inverse(C: Array, P: Array, R: Array, used: NDArray[np.bool_]) -> Array:
    """(C P C' + R)^-1 over the rows used, zero elsewhere; of a singular one the pseudoinverse."""
    S = C @ P @ _T(C) + R
    scale = np.sqrt(np.maximum(np.diagonal(S, axis1=-2, axis2=-1), 0.0))
    inverse = np.divide(1.0, scale, out=np.zeros_like(scale), where=used & (scale > 0.0))
    values, vectors = np.linalg.eigh(inverse[..., :, None] * S * inverse[..., None, :])
    kept = np.divide(1.0, values, out=np.zeros_like(values), where=values > NEGLIGIBLE)
    roots = inverse[..., :, None] * vectors
    found: Array = roots * kept[..., None, :] @ _T(roots)
    return found


def _summed(F: Array, source: Array, last: Array, *, both: bool = True) -> tuple[Array, Array]:
    """X[k] = source[k] + F[k]' X[k+1] F[k], or without the last factor: all X[k+1], and X[0].

    Samples are worked through in about sqrt(T) stretches side by side, of which each is first
    summed up from nothing; what the end of a stretch begins with is known then.
    """
    T, n = source.shape[0], F.shape[-1]
    length = max(1, round(T**0.5))
    count = -(-T // length)
    before = count * length - T  # samples that change nothing, ahead of the first
    F = np.concatenate([np.broadcast_to(np.eye(n), (before, n, n)), F])
    F = F.reshape(count, length, n, n)
    source = np.concatenate([np.zeros((before, *source.shape[1:])), source])
    source = source.reshape(count, length, *source.shape[1:])

    def step(X: Array, k: int) -> Array:
        moved = _T(F[:, k]) @ X
        return source[:, k] + (moved @ F[:, k] if both else moved)

    through, total = np.broadcast_to(np.eye(n), (count, n, n)), np.zeros_like(source[:, 0])
    for k in reversed(range(length)):
        total, through = step(total, k), _T(F[:, k]) @ through
    ends = np.empty_like(total)
    for i in reversed(range(count)):
        ends[i] = last
        moved = through[i] @ last
        last = total[i] + (moved @ through[i].T if both else moved)
    found, X = np.empty_like(source), ends
    for k in reversed(range(length)):
        found[:, k], X = X, step(X, k)
    return found.reshape(count * length, *source.shape[2:])[before:], last
