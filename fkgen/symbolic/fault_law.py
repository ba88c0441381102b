"""What the linear filters need of the law of (gamma, delta): first moments, sample by sample.

Sigalov & Oshman, sec. V-B: E[gamma_k], p11(k) = Pr(gamma_k = 1 | gamma_i = 1) and E[delta_k]. A law
that the kernel does not change gives constants; another one is carried along with the state.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from fkgen.spec import SensorFaults, Spec
from fkgen.spec.linear_optimal import is_white
from fkgen.symbolic.interface import Port, Role
from fkgen.symbolic.plant import Plant
from fkgen.symbolic.sensing import scaled_noise
from fkgen.symbolic.weights import TINY

#: Largest change by one step of a law that counts as stationary.
STATIONARY = 1e-13


@dataclass(frozen=True, slots=True)
class FaultLaw:
    """The law of a spec: ports that it needs, and its moments in terms of them."""

    faults: SensorFaults
    scalar: str
    stationary: bool
    white: bool

    @classmethod
    def of(cls, spec: Spec, faults: SensorFaults) -> FaultLaw:
        """Decide what is constant."""
        stationary = faults.moments is not None
        if not stationary:
            law, P = np.array(faults.initial), np.array(faults.kernel)
            stationary = bool(np.abs(law @ P - law).max() <= STATIONARY)
        return cls(faults, spec.code.scalar, stationary, is_white(faults))

    def law_ports(self) -> tuple[Port, ...]:
        """The unconditional law of the mode, if it changes."""
        if self.stationary:
            return ()
        meaning = "unconditional law of the mode (1,1) (1,C) (0,1) (0,C) at"
        return tuple(
            Port(name=f"{prefix}mode_law", shape=(4,), role=Role.STATE, meaning=f"{meaning} {k}")
            for prefix, k in (("", "k"), ("predicted_", "k+1"))
        )

    def law_start(self) -> dict[str, tuple[float, ...]]:
        """Start value of `law_ports`."""
        return {} if self.stationary else {"predicted_mode_law": self.faults.initial}

    def persistence_ports(self) -> tuple[Port, ...]:
        """What p11 of the coming sample follows from; nothing if gamma ignores its past."""
        if self.white:
            return ()
        if self.stationary:
            meaning = "p11: Pr(gamma[k+1] = 1 | gamma[k] = 1)"
            return (Port(name="gamma_persistence", shape=(), role=Role.STATE, meaning=meaning),)
        meaning = "law of the mode given the last signal that was possible before, at"
        return tuple(
            Port(name=f"{prefix}signal_law", shape=(4,), role=Role.STATE, meaning=f"{meaning} {k}")
            for prefix, k in (("", "k"), ("predicted_", "k+1"))
        )

    def persistence_start(self) -> dict[str, tuple[float, ...]]:
        """At sample 0 nothing came before: E[gamma] takes the place of p11."""
        if self.white:
            return {}
        if self.stationary:
            return {"gamma_persistence": (float(self.gamma({})),)}
        return {"predicted_signal_law": self.faults.initial}

    def law(self, symbols: dict[str, ca.SX]) -> ca.SX:
        """Law of the mode at the sample that is corrected, (4,)."""
        constant = ca.SX(list(self.faults.initial))
        return constant if self.stationary else symbols["predicted_mode_law"]

    def gamma(self, symbols: dict[str, ca.SX]) -> ca.SX:
        """E[gamma_k]."""
        if self.faults.moments is not None:
            return ca.SX(self.faults.moments.gamma_rate)
        if self.stationary or not symbols:
            return ca.SX(_whole(self.faults.initial[0] + self.faults.initial[1]))
        law = self.law(symbols)
        return law[0] + law[1]

    def nominal(self, symbols: dict[str, ca.SX]) -> ca.SX:
        """Pr(delta_k = 1)."""
        if self.faults.moments is not None:
            return ca.SX(self.faults.moments.delta_nominal_rate)
        law = self.law(symbols)
        if self.stationary:
            return ca.SX(_whole(float(law[0] + law[2])))
        return law[0] + law[2]

    def persistence(self, symbols: dict[str, ca.SX]) -> ca.SX:
        """p11(k); E[gamma_k] if gamma does not depend on its past."""
        if self.white:
            return self.gamma(symbols)
        if self.stationary:
            return symbols["gamma_persistence"]
        return symbols["predicted_signal_law"][0] + symbols["predicted_signal_law"][1]

    def noise(self, plant: Plant, symbols: dict[str, ca.SX]) -> ca.SX:
        """Mean covariance of the measurement noise: R E[delta] on the rows that can fail."""
        nominal, factor = self.nominal(symbols), self.faults.noise_factor
        own = nominal + (1 - nominal) * factor
        cross = nominal + (1 - nominal) * math.sqrt(factor)
        return scaled_noise(plant.R, self.faults.rows, own, cross)

    def next_law(self, symbols: dict[str, ca.SX]) -> ca.SX:
        """Law of the mode one sample later, its rounding taken out of the sum."""
        if self.stationary:
            return self.law(symbols)
        moved = ca.SX(self._kernel()).T @ symbols["mode_law"]
        return moved / ca.sum1(moved)

    def advanced(self, symbols: dict[str, ca.SX]) -> dict[str, ca.SX]:
        """The ports of the law for the next sample."""
        if self.stationary:
            return {} if self.white else {"gamma_persistence": ca.SX(self._constant_persistence())}
        result = {"predicted_mode_law": self.next_law(symbols)}
        if "signal_law" in symbols:
            law, tiny = symbols["mode_law"], TINY[self.scalar]
            signal = ca.vertcat(law[:2], ca.SX.zeros(2)) + tiny * symbols["signal_law"]
            moved = ca.SX(self._kernel()).T @ signal
            result["predicted_signal_law"] = moved / (law[0] + law[1] + tiny)
        return result

    def _constant_persistence(self) -> float:
        if self.faults.moments is not None:
            return self.faults.moments.gamma_persistence
        law, P = np.array(self.faults.initial[:2]), self._kernel()
        return _whole(float(law @ P[:2, :2].sum(axis=1) / law.sum()))

    def _kernel(self) -> NDArray[np.float64]:
        return np.array(self.faults.kernel)


def _whole(probability: float) -> float:
    """A sum of probabilities that rounding may have left beside 0 or 1."""
    nearest = float(round(probability))
    return nearest if abs(probability - nearest) <= STATIONARY else probability
