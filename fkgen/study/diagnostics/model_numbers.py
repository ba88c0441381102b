"""The plant of a spec as numbers at the default parameters, and where its filter comes to rest."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fkgen.oracle import LinearSystem, constant_input_noise, stationary_prediction
from fkgen.problem import Spec

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """A filter that has come to rest.

    Attributes
    ----------
    predicted, filtered : (n, n) ndarray
        Error covariance before and after the measurement.
    innovation : (p, p) ndarray
        Covariance of the innovation.
    gain, filtered_gain : (n, p) ndarray
        K of x(k+1|k) and Kf of x(k|k).
    radius : float
        Spectral radius of A - K C.
    """

    predicted: Array
    filtered: Array
    innovation: Array
    gain: Array
    filtered_gain: Array
    radius: float


@dataclass(frozen=True, eq=False)
class Figures:
    """A spec with its matrices at the default parameters; for ``mme``, at the first hypothesis."""

    spec: Spec

    @cached_property
    def system(self) -> LinearSystem:
        """One sample of the plant."""
        return LinearSystem.from_spec(self.spec, 1, None, self.spec.first_rates)

    @property
    def A(self) -> Array:
        """(n, n)."""
        return np.asarray(self.system.A[0])

    @property
    def B(self) -> Array:
        """(n, q)."""
        return np.asarray(self.system.B[0])

    @property
    def C(self) -> Array:
        """(p, n)."""
        return np.asarray(self.system.C[0])

    @property
    def D(self) -> Array:
        """(p, q)."""
        return np.asarray(self.system.D[0])

    @property
    def Q(self) -> Array:
        """(n, n)."""
        return np.asarray(self.system.Q[0])

    @property
    def R(self) -> Array:
        """(p, p)."""
        return np.asarray(self.system.R[0])

    @property
    def P0(self) -> Array:
        """(n, n)."""
        return self.system.P0

    @property
    def states(self) -> list[str]:
        """Names of the states."""
        return [signal.name for signal in self.spec.model.states]

    @property
    def outputs(self) -> list[str]:
        """Names of the measurements."""
        return [signal.name for signal in self.spec.model.outputs]

    @property
    def has_faults(self) -> bool:
        """Whether inputs fail."""
        return self.spec.faults.actuator is not None

    @property
    def is_float(self) -> bool:
        """Whether the C code computes in float."""
        return self.spec.code.scalar == "float"

    def noise(self, *, driven: bool) -> tuple[Array, Array, Array]:
        """Q, R and their cross covariance (n, p), with u = 0 or every input at 1."""
        u = np.full(self.spec.model.nu, float(driven))
        return constant_input_noise(self.system, u)

    @cached_property
    def rest(self) -> Rest | None:
        """Where the filter comes to rest at u = 0, if it does."""
        return self.rest_at(np.zeros(self.spec.model.nu))

    def rest_at(self, u: Array) -> Rest | None:
        """Where the filter comes to rest at constant inputs u (q,), if it does."""
        Q, R, S = constant_input_noise(self.system, u)
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore"
            )  # what is ill-conditioned fails the tests of the solution
            found = stationary_prediction(self.A, self.C, Q, R, S)
        if found is None:
            return None
        P, radius = found
        Om = self.C @ P @ self.C.T + R
        inverse = np.linalg.pinv(Om, hermitian=True)
        gain, own = (self.A @ P @ self.C.T + S) @ inverse, P @ self.C.T @ inverse
        filtered = P - own @ Om @ own.T
        return Rest(P, 0.5 * (filtered + filtered.T), Om, gain, own, radius)


def listed(names: list[str]) -> str:
    """Names in a sentence."""
    if len(names) < 2:
        return "".join(names)
    return f"{', '.join(names[:-1])} and {names[-1]}"
