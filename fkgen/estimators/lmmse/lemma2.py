"""Linear optimal filter with uncertain observations: Sigalov & Oshman, eqs. (19)-(23).

It needs E[gamma_k], p11(k) = Pr(gamma_k = 1 | gamma_i = 1) and E[delta_k], sec. V-B. Probabilities
that the kernel does not change give constants; others are carried along with the state.

With w = (gamma - p11) C x + v the measurement is y = p11 C x + w, whose noise has covariance
(E[gamma] - p11) E[x x'] C' with the state. Conditioning (x, w) on it is (23) in covariance form: C
minus V is never formed, which cancels for an unstable plant. Rows that cannot fail have gamma = 1.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np

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
from fkgen.estimators.gaussian.sequential import Conditioned, condition
from fkgen.estimators.lmmse.jump import STATIONARY, is_settled
from fkgen.estimators.lmmse.kalman import innovation_results
from fkgen.estimators.models.start import first_law
from fkgen.estimators.models.weights import TINY
from fkgen.faults.sensor import is_white
from fkgen.problem import Spec
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.domain import law_of
from fkgen.symbolic.interface import Kind, Port, Status
from fkgen.symbolic.lifting.expressions import lift_expression
from fkgen.symbolic.linalg import (
    by_rows,
    congruence,
    from_rows,
    is_zero,
    outer_lower,
    pack,
    sparse,
    unpack,
)
from fkgen.symbolic.plant import Plant, plant_of
from fkgen.symbolic.ports import (
    carried,
    innovation_ports,
    prior_symbols,
    shown,
    state_ports,
    symbols_of,
)
from fkgen.symbolic.recursion import Phase, Recursion

#: Moments that the prediction moves on and y[k] does not change.
CARRIED = ("state_second_moment", "state_mean", "mode_law", "signal_law")


class UncertainFilter:
    """What the phases are written from: the plant, the law of its faults, and its moments."""

    def __init__(self, spec: Spec) -> None:
        faults = spec.faults.sensor
        if faults is None:
            raise InternalError("linear_optimal without sensor faults")
        self.spec, self.faults, self.plant = spec, faults, plant_of(spec)
        self.white = is_white(faults)  # gamma does not depend on its past
        #: The law never changes, or each sample has its own: nothing of it is carried along
        self.stationary = (
            faults.moments is not None
            or faults.independent
            or ((faults.law or faults.first) is None and is_settled(faults.initial, faults.kernel))
        )
        ports = *state_ports(spec), *innovation_ports(spec), *_ports(self.plant)
        self.ports = (*ports, *_law_ports(white=self.white, stationary=self.stationary))
        self.symbols = symbols_of(spec, self.plant, self.ports)
        self.form = update_form(spec, self.plant, augmented=False)

    def start(self) -> Phase:
        """The moments of the prior; without a constant term its mean has to be 0."""
        prior = prior_symbols(self.plant)
        builder, x = PhaseBuilder({**self.symbols, **prior}), prior["x"]
        if not self.white:
            squares = [-x[i] * x[i] for i in range(self.plant.nx)]
            builder.demand(Kind.NONNEGATIVE, squares, Status.PARAMETER_OUT_OF_RANGE)
        results = {"predicted_state_second_moment": prior["P"] + outer_lower(x, x)}
        if has_mean(self.plant):
            results["predicted_state_mean"] = x
        if self.faults.first is not None:
            chain, parameters = self.faults.chain(self.spec.model), self.plant.parameters
            law = first_law(builder, self.spec, chain, parameters)
            names = ("predicted_mode_law", "predicted_signal_law")
            results |= {name: law for name in names if name in self.symbols}
        builder.assign(results)
        return builder.phase()

    def initial(self) -> dict[str, tuple[float, ...]]:
        """Start values; at sample 0 nothing came before: E[gamma] takes the place of p11."""
        n, law = self.plant.nx, self.faults.initial
        start = {
            "transition": tuple(np.eye(n).ravel().tolist()),
        }
        if self.faults.first is None:
            start |= {"predicted_mode_law": law, "predicted_signal_law": law}
        if self.stationary and not self.white:
            start["gamma_persistence"] = (float(self.gamma()),)
        return {port.name: start[port.name] for port in self.ports if port.name in start}

    def gamma(self) -> ca.SX:
        """E[gamma_k]."""
        moments = self.faults.moments
        return self._either(1) if moments is None else ca.SX(moments.gamma_rate)

    def nominal(self) -> ca.SX:
        """Pr(delta_k = 1)."""
        moments = self.faults.moments
        return self._either(2) if moments is None else ca.SX(moments.delta_nominal_rate)

    def _either(self, other: int) -> ca.SX:
        """Probability of the modes 0 and ``other`` at the sample that is corrected."""
        if self.faults.law is not None and self.faults.independent:
            own = law_of(self.faults.law, self.plant.parameters)
            return own[0, 0] + own[0, other]
        if self.stationary:
            return ca.SX(_whole(self.faults.initial[0] + self.faults.initial[other]))
        law = self.symbols["predicted_mode_law"]
        return law[0] + law[other]

    def persistence(self) -> ca.SX:
        """p11(k); E[gamma_k] if gamma does not depend on its past."""
        if self.white:
            return self.gamma()
        if self.stationary:
            return self.symbols["gamma_persistence"]
        law = self.symbols["predicted_signal_law"]
        return law[0] + law[1]

    def noise(self, plant: Plant) -> ca.SX:
        """Mean covariance of the measurement noise: R E[delta] on the rows that can fail."""
        nominal, factor = self.nominal(), ca.SX(self.faults.noise_factor)
        if self.faults.factor is not None:
            factor = lift_expression(self.faults.factor, self.plant.parameters)
        own = nominal + (1 - nominal) * factor
        cross = nominal + (1 - nominal) * ca.sqrt(factor)
        R = ca.SX(plant.R)
        for i in range(plant.ny):
            for j in range(plant.ny):
                faulty = (i in self.faults.rows) + (j in self.faults.rows)
                if faulty and not is_zero(R[i, j]):
                    R[i, j] = R[i, j] * (own if faulty == 2 else cross)
        return R

    def advanced(self) -> dict[str, ca.SX]:
        """The ports of the law for the next sample."""
        if self.stationary:
            return {} if self.white else {"gamma_persistence": ca.SX(self._constant_persistence())}
        P, law = ca.SX(np.array(self.faults.kernel)), self.symbols["mode_law"]
        if self.faults.law is not None:
            P = law_of(self.faults.law, self.plant.parameters)
        moved = P.T @ law
        result = {"predicted_mode_law": moved / ca.sum1(moved)}  # its rounding taken out
        if not self.white:
            tiny = TINY[self.spec.code.scalar]
            signal = ca.vertcat(law[:2], ca.SX.zeros(2)) + tiny * self.symbols["signal_law"]
            result["predicted_signal_law"] = P.T @ signal / (law[0] + law[1] + tiny)
        return result

    def _constant_persistence(self) -> float:
        if self.faults.moments is not None:
            return self.faults.moments.gamma_persistence
        law, P = np.array(self.faults.initial[:2]), np.array(self.faults.kernel)
        return _whole(float(law @ P[:2, :2].sum(axis=1) / law.sum()))


def _whole(probability: float) -> float:
    """A sum of probabilities that rounding may have left beside 0 or 1."""
    nearest = float(round(probability))
    return nearest if abs(probability - nearest) <= STATIONARY else probability


def uncertain_filter(spec: Spec, source: str) -> Recursion:
    """Build the recursion of ``linear_optimal`` in its form ``lemma2``."""
    design = UncertainFilter(spec)
    return Recursion(
        spec=spec,
        source=source,
        ports=design.ports,
        start=design.start(),
        initial=design.initial(),
        update=_update(design),
        predict=_predict(design),
        form=design.form,
    )


def _law_ports(*, white: bool, stationary: bool) -> tuple[Port, ...]:
    """Mode probabilities if they change, and what p11 follows from if gamma has a memory."""
    if stationary:
        meaning = "p11: Pr(gamma[k+1] = 1 | gamma[k] = 1)"
        return () if white else (carried("gamma_persistence", (), meaning),)
    laws = {"mode_law": "unconditional law of the mode (1,1) (1,C) (0,1) (0,C) at"}
    if not white:
        laws["signal_law"] = "law of the mode given the last signal that was possible before, at"
    return tuple(
        carried(f"{prefix}{name}", (4,), f"{meaning} {k}")
        for name, meaning in laws.items()
        for prefix, k in (("", "k"), ("predicted_", "k+1"))
    )


def has_mean(plant: Plant) -> bool:
    """Whether the mean of the state is carried along: something known is added to it, or to y."""
    return bool(plant.nu or plant.c.nnz() or plant.d.nnz())


def _ports(plant: Plant) -> tuple[Port, ...]:
    """Gains and unconditional moments."""
    n, p = plant.nx, plant.ny
    F1 = "F1: d x(k|k) / d x(k-1|k-1); at k = 0 d x(0|0) / d x0"
    F2 = "F2: d x(k|k) / d y[k]; columns of missing rows are 0"
    ports = [
        shown("state_gain", (n, n), F1),
        shown("measurement_gain", (n, p), F2, unit="x/y"),
        carried("transition", (n, n), "A of the prediction for this sample; 1 at sample 0"),
    ]
    for prefix, k in (("", "k"), ("predicted_", "k+1")):
        second, name = f"E[x[{k}] x[{k}]'], unconditional", f"{prefix}state_second_moment"
        ports.append(carried(name, (n, n), second, unit="xx", symmetric=True))
        if has_mean(plant):
            mean = f"E[x[{k}]], unconditional"
            ports.append(carried(f"{prefix}state_mean", (n,), mean, unit="x"))
    return tuple(ports)


def _update(design: UncertainFilter) -> Phase:
    symbols, n = design.symbols, design.plant.nx
    builder = PhaseBuilder(symbols)
    demand_positive(builder, symbols["predicted_covariance"])
    plant = bound(builder, design.plant, "CDRd")
    with builder.titled("moments of the measurement"):
        C, found, gain = _condition(builder, design, plant)
    demand_finite(builder, found.mean)
    with builder.titled("results of the update"):
        F2 = builder.name_entries("gain", gain)
        F1 = (ca.SX.eye(n) - F2 @ C) @ from_rows(symbols["transition"], n)
        builder.assign(
            {
                "filtered_state": found.mean,
                "filtered_covariance": found.covariance,
                **innovation_results(found),
                "measurement_gain": by_rows(F2),
                "state_gain": by_rows(F1),
                **{name: symbols[f"predicted_{name}"] for name in CARRIED if name in symbols},
            }
        )
    return builder.phase()


def _condition(
    builder: PhaseBuilder, design: UncertainFilter, plant: Plant
) -> tuple[ca.SX, Conditioned, ca.SX]:
    """p11 C of every row, what conditioning on y = p11 C x + w gives, and its gain."""
    symbols, rows, n, p = design.symbols, list(design.faults.rows), plant.nx, plant.ny
    g, p11 = design.gamma(), design.persistence()
    pi = ca.SX.ones(p)
    pi[rows] = p11
    second = unpack(symbols["predicted_state_second_moment"], n)
    noise = _noise(builder, design, plant, _signal_moment(plant, symbols, second))
    C = measured = sparse(ca.diag(pi) @ plant.C)
    state = symbols["predicted_state"]
    covariance = unpack(symbols["predicted_covariance"], n)
    if not design.white:
        cross = ca.SX(n, p)
        cross[:, rows] = (g - p11) * (second @ plant.C[rows, :].T)
        cross = builder.name_entries("noise_cross", sparse(cross))
        state = ca.vertcat(state, ca.SX.zeros(p))
        covariance = sparse(ca.blockcat(covariance, cross, cross.T, noise))
        C, noise = ca.horzcat(C, ca.SX.eye(p)), ca.SX(p, p)
    measurement = measurement_of(
        plant,
        y=symbols["y"],
        C=C,
        offset=ca.diag(pi) @ (plant.D @ symbols["u"] + plant.d),
        R=noise,
    )
    found = condition(builder, (state, covariance), measurement, form=design.form, with_gain=True)
    if found.gain is None:
        raise InternalError("a condition without a gain")
    P = unpack(found.covariance, state.numel())[:n, :n]
    return measured, replace(found, mean=found.mean[:n, 0], covariance=pack(P)), found.gain[:n, :]


def _noise(builder: PhaseBuilder, design: UncertainFilter, plant: Plant, signal: ca.SX) -> ca.SX:
    """Cov(w): R E[delta] and E[(gamma - p11)^2] E[(C x)(C x)'] on the rows that can fail."""
    g, p11, rows = design.gamma(), design.persistence(), design.faults.rows
    R = design.noise(plant)
    excess = builder.define("signal_variance_share", g * (1 - p11) + p11 * (p11 - g))
    for i in rows:
        for j in rows:
            if j <= i and not (is_zero(excess) or is_zero(signal[i, j])):
                R[i, j] = R[j, i] = R[i, j] + excess * signal[i, j]
    return ca.tril2symm(builder.name_entries("noise", sparse(ca.tril(R))))


def _signal_moment(plant: Plant, symbols: dict[str, ca.SX], second: ca.SX) -> ca.SX:
    """Second moment of C x + D u."""
    moment = unpack(congruence(plant.C, second), plant.ny)
    if not (plant.D.nnz() or plant.d.nnz()):
        return moment
    direct = plant.D @ symbols["u"] + plant.d
    common = plant.C @ symbols["predicted_state_mean"] @ direct.T
    return moment + common + common.T + direct @ direct.T


def _predict(design: UncertainFilter) -> Phase:
    symbols, n = design.symbols, design.plant.nx
    builder = PhaseBuilder(symbols)
    plant = bound(builder, design.plant, "ABQc")
    inputs = certain(symbols["u"])
    filtered = Posterior(symbols["filtered_state"], symbols["filtered_covariance"])
    state, covariance, _ = propagate(builder, plant, inputs, filtered)
    second = unpack(symbols["state_second_moment"], n)
    moved = congruence(plant.A, second) + pack(plant.Q)
    assign = {
        "predicted_state": state,
        "predicted_covariance": covariance,
        "transition": by_rows(plant.A),
        **design.advanced(),
    }
    if has_mean(plant):
        mean, forced = plant.A @ symbols["state_mean"], plant.B @ symbols["u"] + plant.c
        common = mean @ forced.T
        moved += pack(common + common.T + forced @ forced.T)
        assign["predicted_state_mean"] = mean + forced
    assign["predicted_state_second_moment"] = moved
    with builder.titled("prediction of the next sample"):
        builder.assign(assign, [finite(state, covariance), finite(state, moved)])
    return builder.phase()
