"""Linear optimal filter with uncertain observations: Sigalov & Oshman, eqs. (19)-(23).

It needs E[gamma_k], p11(k) = Pr(gamma_k = 1 | gamma_i = 1) and E[delta_k], sec. V-B. Probabilities
that the kernel does not change give constants; others are carried along with the state.

With w = (gamma - p11) C x + v the measurement is y = p11 C x + w, whose noise has covariance
(E[gamma] - p11) E[x x'] C' with the state. Conditioning (x, w) on it is (23) in covariance form: C
minus V is never formed, which cancels for an unstable plant. Rows that cannot fail have gamma = 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from fkgen.errors import InternalError
from fkgen.estimators.gaussian.actuation import certain
from fkgen.estimators.gaussian.estimate import (
    Posterior,
    bound,
    demand_finite,
    demand_positive,
    finite,
    measurement_of,
    propagate,
    update_form,
)
from fkgen.estimators.gaussian.sequential import Conditioned, Form, condition
from fkgen.estimators.lmmse.kalman import by_rows, from_rows
from fkgen.estimators.models.weights import TINY
from fkgen.faults import SensorFaults
from fkgen.faults.sensor import is_white
from fkgen.problem import Spec
from fkgen.symbolic.builder import Script
from fkgen.symbolic.interface import Port
from fkgen.symbolic.linalg import congruence, is_zero, pack, sparse, unpack
from fkgen.symbolic.packing import triangle
from fkgen.symbolic.plant import Plant, plant_of
from fkgen.symbolic.ports import (
    carried,
    innovation_ports,
    prior_of,
    shown,
    start_of,
    state_ports,
    symbols_of,
)
from fkgen.symbolic.recursion import Phase, Recursion

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

    def ports(self) -> tuple[Port, ...]:
        """Mode probabilities if they change, and what p11 follows from if gamma has a memory."""
        if self.stationary:
            meaning = "p11: Pr(gamma[k+1] = 1 | gamma[k] = 1)"
            return () if self.white else (carried("gamma_persistence", (), meaning),)
        laws = {"mode_law": "unconditional law of the mode (1,1) (1,C) (0,1) (0,C) at"}
        if not self.white:
            laws["signal_law"] = (
                "law of the mode given the last signal that was possible before, at"
            )
        return tuple(
            carried(f"{prefix}{name}", (4,), f"{meaning} {k}")
            for name, meaning in laws.items()
            for prefix, k in (("", "k"), ("predicted_", "k+1"))
        )

    def start(self) -> dict[str, tuple[float, ...]]:
        """Start values; at sample 0 nothing came before: E[gamma] takes the place of p11."""
        if self.stationary:
            return {} if self.white else {"gamma_persistence": (float(self.gamma({})),)}
        names = ["mode_law"] if self.white else ["mode_law", "signal_law"]
        return {f"predicted_{name}": self.faults.initial for name in names}

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
        return _scaled_noise(plant.R, self.faults.rows, own, cross)

    def advanced(self, symbols: dict[str, ca.SX]) -> dict[str, ca.SX]:
        """The ports of the law for the next sample."""
        if self.stationary:
            return {} if self.white else {"gamma_persistence": ca.SX(self._constant_persistence())}
        moved = ca.SX(self._kernel()).T @ symbols["mode_law"]
        result = {"predicted_mode_law": moved / ca.sum1(moved)}  # its rounding taken out
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


def _scaled_noise(R: ca.SX, rows: tuple[int, ...], own: ca.SX, cross: ca.SX) -> ca.SX:
    """R times ``own`` among the rows, times ``cross`` between them and the others."""
    result = ca.SX(R)
    for i in range(R.shape[0]):
        for j in range(R.shape[0]):
            faulty = (i in rows) + (j in rows)
            if faulty and not is_zero(R[i, j]):
                result[i, j] = R[i, j] * (own if faulty == 2 else cross)
    return result


def _whole(probability: float) -> float:
    """A sum of probabilities that rounding may have left beside 0 or 1."""
    nearest = float(round(probability))
    return nearest if abs(probability - nearest) <= STATIONARY else probability


#: Moments that the prediction moves on and y[k] does not change.
CARRIED = ("state_second_moment", "state_mean", "mode_law", "signal_law")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Design:
    spec: Spec
    plant: Plant
    law: FaultLaw
    symbols: dict[str, ca.SX]
    form: Form


def uncertain_filter(spec: Spec, source: str) -> Recursion:
    """Build the recursion of ``linear_optimal`` in its form ``lemma2``."""
    plant, faults = plant_of(spec), spec.faults.sensor
    if faults is None:
        raise InternalError("linear_optimal without sensor faults")
    law = FaultLaw.of(spec, faults)
    ports = (
        *state_ports(spec),
        *innovation_ports(spec),
        *_gain_ports(plant),
        *_moment_ports(plant),
        *law.ports(),
    )
    symbols = symbols_of(spec, plant, ports)
    form = update_form(spec, plant, augmented=False)
    design = _Design(spec=spec, plant=plant, law=law, symbols=symbols, form=form)
    return Recursion(
        spec=spec,
        source=source,
        ports=ports,
        initial=_start(spec, law),
        update=_update(design),
        predict=_predict(design),
        form=form,
    )


def _start(spec: Spec, law: FaultLaw) -> dict[str, tuple[float, ...]]:
    x0 = prior_of(spec)[0]
    n = spec.model.nx
    moment = spec.model.P0.values() + np.outer(x0, x0)
    second = tuple(float(moment[i, j]) for i, j in triangle(n))
    return {
        **start_of(spec),
        "predicted_state_second_moment": second,
        "transition": tuple(np.eye(n).ravel().tolist()),
        **({"predicted_state_mean": x0} if spec.model.nu else {}),
        **law.start(),
    }


def _gain_ports(plant: Plant) -> tuple[Port, ...]:
    n, p = plant.nx, plant.ny
    F1 = "F1: d x(k|k) / d x(k-1|k-1); at k = 0 d x(0|0) / d x0"
    F2 = "F2: d x(k|k) / d y[k]; columns of missing rows are 0"
    return (
        shown("state_gain", (n, n), F1),
        shown("measurement_gain", (n, p), F2, unit="x/y"),
        carried("transition", (n, n), "A of the prediction for this sample; 1 at sample 0"),
    )


def _moment_ports(plant: Plant) -> tuple[Port, ...]:
    n, ports = plant.nx, []
    for prefix, k in (("", "k"), ("predicted_", "k+1")):
        second = f"E[x[{k}] x[{k}]'], unconditional"
        name = f"{prefix}state_second_moment"
        ports.append(carried(name, (n, n), second, unit="xx", symmetric=True))
        if plant.nu:
            mean = f"E[x[{k}]], unconditional"
            ports.append(carried(f"{prefix}state_mean", (n,), mean, unit="x"))
    return tuple(ports)


def _update(design: _Design) -> Phase:
    symbols, n = design.symbols, design.plant.nx
    script = Script(symbols)
    demand_positive(script, symbols["predicted_covariance"], n)
    plant = bound(script, design.plant, "CDR")
    with script.titled("moments of the measurement"):
        pi, found, gain = _condition(script, design, plant)
    demand_finite(script, found.mean)
    with script.titled("results of the update"):
        F2 = script.name_entries("gain", gain)
        C = sparse(ca.diag(pi) @ plant.C)
        transition = from_rows(symbols["transition"], n)
        F1 = (ca.SX.eye(n) - F2 @ C) @ transition
        script.put(
            {
                "filtered_state": found.mean,
                "filtered_covariance": found.covariance,
                "innovation": found.innovation,
                "innovation_covariance": found.innovation_covariance,
                "nis": found.nis,
                "log_likelihood": found.log_likelihood,
                "measurement_gain": by_rows(F2),
                "state_gain": by_rows(F1),
                **{name: symbols[f"predicted_{name}"] for name in CARRIED if name in symbols},
            }
        )
    return script.phase()


def _condition(script: Script, design: _Design, plant: Plant) -> tuple[ca.SX, Conditioned, ca.SX]:
    """The p11 of every row, what conditioning on y = p11 C x + w gives, and its gain."""
    symbols, law, rows = design.symbols, design.law, list(design.law.faults.rows)
    n, p = plant.nx, plant.ny
    g, p11 = law.gamma(symbols), law.persistence(symbols)
    pi = ca.SX.ones(p)
    pi[rows] = p11
    second = unpack(symbols["predicted_state_second_moment"], n)
    noise = _noise(script, design, plant, _signal_moment(plant, symbols, second))
    C = sparse(ca.diag(pi) @ plant.C)
    state = symbols["predicted_state"]
    covariance = unpack(symbols["predicted_covariance"], n)
    if not law.white:
        cross = ca.SX(n, p)
        cross[:, rows] = (g - p11) * (second @ plant.C[rows, :].T)
        cross = script.name_entries("noise_cross", sparse(cross))
        state = ca.vertcat(state, ca.SX.zeros(p))
        covariance = sparse(ca.blockcat(covariance, cross, cross.T, noise))
        C, noise = ca.horzcat(C, ca.SX.eye(p)), ca.SX(p, p)
    measurement = measurement_of(
        plant,
        scalar=design.spec.code.scalar,
        y=symbols["y"],
        C=C,
        offset=ca.diag(pi) @ plant.D @ symbols["u"],
        R=noise,
    )
    found = condition(script, (state, covariance), measurement, form=design.form, with_gain=True)
    if found.gain is None:
        raise InternalError("a condition without a gain")
    P = unpack(found.covariance, state.numel())[:n, :n]
    return pi, replace(found, mean=found.mean[:n, 0], covariance=pack(P)), found.gain[:n, :]


def _noise(script: Script, design: _Design, plant: Plant, signal: ca.SX) -> ca.SX:
    """Cov(w): R E[delta] and E[(gamma - p11)^2] E[(C x)(C x)'] on the rows that can fail."""
    law, symbols, rows = design.law, design.symbols, design.law.faults.rows
    g, p11 = law.gamma(symbols), law.persistence(symbols)
    R = law.noise(plant, symbols)
    excess = script.let("signal_variance_share", g * (1 - p11) + p11 * (p11 - g))
    for i in rows:
        for j in rows:
            if j <= i and not (is_zero(excess) or is_zero(signal[i, j])):
                R[i, j] = R[j, i] = R[i, j] + excess * signal[i, j]
    return _named(script, R)


def _named(script: Script, R: ca.SX) -> ca.SX:
    """A symmetric matrix whose entries are computed once."""
    p = R.shape[0]
    lower = script.name_entries("noise", sparse(ca.tril(R)))
    result = ca.SX(lower)
    for i in range(p):
        for j in range(i):
            if not is_zero(lower[i, j]):
                result[j, i] = lower[i, j]
    return result


def _signal_moment(plant: Plant, symbols: dict[str, ca.SX], second: ca.SX) -> ca.SX:
    """Second moment of C x + D u."""
    moment = unpack(congruence(plant.C, second), plant.ny)
    if not plant.D.nnz():
        return moment
    direct = plant.D @ symbols["u"]
    common = plant.C @ symbols["predicted_state_mean"] @ direct.T
    return moment + common + common.T + direct @ direct.T


def _predict(design: _Design) -> Phase:
    symbols, n = design.symbols, design.plant.nx
    script = Script(symbols)
    plant = bound(script, design.plant, "ABQ")
    inputs = certain(symbols["u"])
    filtered = Posterior(symbols["filtered_state"], symbols["filtered_covariance"])
    state, covariance, _ = propagate(plant, inputs, filtered)
    second = unpack(symbols["state_second_moment"], n)
    moved = congruence(plant.A, second) + pack(plant.Q)
    assign = {
        "predicted_state": state,
        "predicted_covariance": covariance,
        "transition": by_rows(plant.A),
        **design.law.advanced(symbols),
    }
    if plant.nu:
        mean, forced = plant.A @ symbols["state_mean"], plant.B @ symbols["u"]
        common = mean @ forced.T
        moved += pack(common + common.T + forced @ forced.T)
        assign["predicted_state_mean"] = mean + forced
    assign["predicted_state_second_moment"] = moved
    with script.titled("prediction of the next sample"):
        script.put(assign, [finite(state, covariance), finite(state, moved)])
    return script.phase()
