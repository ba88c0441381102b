"""First and second moments of sensor faults over a record: all that a linear filter can see."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import accumulate
from typing import Self

import numpy as np

from fkgen.errors import DataError
from fkgen.oracle.exact.gaussian import Array, square_root
from fkgen.oracle.plants.sensor import GAMMA, SAME_PROBABILITY, SensorLaw, factors_of
from fkgen.problem import Spec

#: Samples over which Lemma 2 is examined. The condition on neighbours i and i + 1 is a quadratic
#: form in the law of four modes, and those have ten dimensions: by then it holds for ever.
LEMMA_HORIZON = 24

#: A variance of gamma below this is the rounding of zero: gamma is certain.
CERTAIN = 1e-14

#: Relative size of a negative eigenvalue that no rounding explains.
INDEFINITE = 1e-9


@dataclass(frozen=True, eq=False, kw_only=True)
class FaultMoments:
    """Moments of gamma, delta; y = G (C x + D u) + v, Cov v = T R T: Sigalov & Oshman, sec. V."""

    gamma: Array  # (T,): E[gamma_k]
    gamma_pair: Array  # (T, T): E[gamma_k gamma_i]
    delta: Array  # (T,): E[delta_k]
    #: (T,): E[sqrt(delta_k)]: the covariance of a faulty row's noise with a healthy one's
    root_delta: Array
    rows: tuple[int, ...]  # Rows of y that are subject to faults

    @classmethod
    def from_law(cls, law: SensorLaw, T: int) -> Self:
        """Follow a chain of modes through T samples."""
        steps = law.steps(T)[: max(0, T - 1)]
        laws = np.array(list(accumulate(steps, np.matmul, initial=law.initial)))
        if law.kernels is None:
            # Pr(gamma = 1 after `lag` steps | mode), and Pr(gamma_i = 1, gamma_(i + lag) = 1).
            again = (laws * GAMMA) @ _laws(GAMMA, law.kernel.T, T).T
            sample = np.arange(T)
            earlier = np.minimum(sample[:, None], sample)
            pair = again[earlier, np.abs(sample[:, None] - sample)]
        else:
            pair = np.zeros((T, T))
            for i in range(T):
                ways = accumulate(steps[i:], np.matmul, initial=laws[i] * GAMMA)
                pair[i, i:] = pair[i:, i] = [way @ GAMMA for way in ways]
        factor = law.noise_factor if law.factors is None else law.factors
        nominal = laws[:, 0] + laws[:, 2]
        noisier = laws[:, 1] + laws[:, 3]
        return cls(
            gamma=laws @ GAMMA,
            gamma_pair=pair,
            delta=nominal + noisier * factor,
            root_delta=nominal + noisier * np.sqrt(factor),
            rows=law.rows,
        )

    @classmethod
    def from_rates(
        cls,
        gamma_rate: Array | float,
        gamma_persistence: Array | float,
        delta_nominal_rate: Array | float,
        *,
        T: int,
        rows: tuple[int, ...],
        noise_factor: Array | float = 1.0,
    ) -> Self:
        """Take Lemma 2 for granted: E[gamma_k gamma_i] = p11(k) E[gamma_i] for all i < k."""
        gamma, persistence, nominal = (
            np.array(np.broadcast_to(np.asarray(rate, dtype=float), (T,)))
            for rate in (gamma_rate, gamma_persistence, delta_nominal_rate)
        )
        earlier = np.tril(np.outer(persistence, gamma), -1)
        return cls(
            gamma=gamma,
            gamma_pair=earlier + earlier.T + np.diag(gamma),
            delta=nominal + (1.0 - nominal) * noise_factor,
            root_delta=nominal + (1.0 - nominal) * np.sqrt(noise_factor),
            rows=rows,
        )

    @classmethod
    def from_spec(
        cls, spec: Spec, T: int, params: Mapping[str, Array | float] | None = None
    ) -> Self:
        """Take the moments from the section ``faults.sensor`` of a spec, chain or numbers."""
        faults = spec.faults.sensor
        if faults is None or faults.moments is None:
            return cls.from_law(SensorLaw.over(spec, T, params), T)
        factors = factors_of(spec, T, params)
        return cls.from_rates(
            faults.moments.gamma_rate,
            faults.moments.gamma_persistence,
            faults.moments.delta_nominal_rate,
            T=T,
            rows=faults.rows,
            noise_factor=faults.noise_factor if factors is None else factors,
        )

    @property
    def length(self) -> int:
        """Number of samples, T."""
        return int(self.gamma.shape[0])

    @property
    def persistence(self) -> Array:
        """p11(k) = Pr(gamma_k = 1 | gamma_i = 1) of the last i < k where that is defined, (T,).

        E[gamma_k] where no measurement before k can carry a signal, so in p11(0).
        """
        p11 = self.gamma.copy()
        for k in range(1, self.length):
            seen = np.flatnonzero(self.gamma[:k] > SAME_PROBABILITY)
            if seen.size:
                p11[k] = self.gamma_pair[k, seen[-1]] / self.gamma[seen[-1]]
        return p11

    @property
    def gamma_root(self) -> Array:
        """Square root of the covariance of gamma_0, ..., gamma_{T-1}, (T, T)."""
        variance = self.gamma * (1.0 - self.gamma)
        random = variance > CERTAIN
        covariance = np.where(
            np.outer(random, random), self.gamma_pair - np.outer(self.gamma, self.gamma), 0.0
        )
        lowest = float(np.linalg.eigvalsh(covariance).min(initial=0.0))
        if lowest < -INDEFINITE * variance.sum():
            raise DataError(
                "moments of gamma",
                given=f"a covariance with the eigenvalue {lowest:.6g}",
                expected="those of a sequence of zeros and ones",
            )
        return square_root(covariance)

    def faulty(self, p: int) -> Array:
        """Ones at the rows subject to faults, zeros elsewhere, (p,)."""
        mask = np.zeros(p)
        mask[list(self.rows)] = 1.0
        return mask

    def gains(self, p: int) -> Array:
        """E[diag G_k], (T, p)."""
        faulty = self.faulty(p)
        return self.gamma[:, None] * faulty + (1.0 - faulty)

    def noise(self, R: Array) -> Array:
        """E[T_k R_k T_k], (T, p, p), from R of that shape."""
        faulty = self.faulty(R.shape[-1])
        both, none = np.outer(faulty, faulty), np.outer(1.0 - faulty, 1.0 - faulty)
        delta, root = self.delta[:, None, None], self.root_delta[:, None, None]
        return np.asarray(R * (delta * both + none + root * (1.0 - both - none)))


def satisfies_lemma_2(
    kernel: Array, initial: Array, *, horizon: int = LEMMA_HORIZON
) -> tuple[bool, float]:
    """Whether Pr(gamma_k = 1 | gamma_i = 1) does not depend on i < k, as Lemma 2 asks.

    Not of samples i at which gamma = 1 has no probability; kernel, initial (4, 4), (4,).
    """
    laws, returns = _laws(initial, kernel, horizon), _laws(GAMMA, kernel.T, horizon)
    given = [i for i in range(horizon) if laws[i] @ GAMMA > SAME_PROBABILITY]
    conditionals = (
        [(laws[i] * GAMMA) @ returns[k - i] / (laws[i] @ GAMMA) for i in given if i < k]
        for k in range(1, horizon)
    )
    largest = max((float(np.ptp(row)) for row in conditionals if row), default=0.0)
    return largest <= SAME_PROBABILITY, largest


def _laws(initial: Array, kernel: Array, T: int) -> Array:
    """Law of the mode at each of T samples, (T, 4)."""
    start = np.asarray(initial, dtype=float)
    return np.array(list(accumulate([kernel] * (T - 1), np.matmul, initial=start)))
