"""Records drawn from what a spec says: its plant, and the faults that its family is about."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from fkgen.faults import SensorFaults
from fkgen.oracle.exact.gaussian import Array
from fkgen.oracle.plants.actuator import LinearSystem, actuation_of, draw_patterns, simulate
from fkgen.oracle.plants.equations import is_nonlinear, system_of
from fkgen.oracle.plants.jump import JumpSystem, chain_of, draw_chain, simulate_jumps
from fkgen.oracle.plants.nonlinear import simulate_nonlinear
from fkgen.oracle.plants.sensor import (
    SensorLaw,
    draw_modes,
    factors_of,
    gamma_delta,
    simulate_sensor,
)
from fkgen.problem import Spec

#: All four modes equally often: for a genie-aided filter, which is told them and states no law.
UNIFORM = np.full((4, 4), 0.25)


def draw_record(
    spec: Spec,
    parameters: Mapping[str, Array],
    u: Array,
    rng: np.random.Generator,
    *,
    scale: float = 1.0,
) -> tuple[Array, dict[str, Array]]:
    """Draw y, NaN for a filter that knows what was lost, and parameters, (T,); u (T, q).

    ``scale``: of the start and the noises of a plant by equations, in deviations.
    """
    if is_nonlinear(spec):
        return _draw_nonlinear(spec, parameters, u, rng, scale)
    T, faults, jump = len(u), spec.faults.sensor, spec.faults.jump
    if jump is not None:
        record = simulate_jumps(JumpSystem.from_spec(spec, T, parameters), u, rng)
        if jump.arrival == "known":
            record.y[~record.arrived] = np.nan
        return record.y, {**parameters}
    if faults is None:
        system = LinearSystem.from_spec(spec, T, parameters, spec.first_rates)
        return simulate(system, u, rng), {**parameters}
    law = _law(spec, faults, T, parameters)
    y, modes = simulate_sensor(LinearSystem.from_spec(spec, T, parameters), law, u, rng)
    gamma, delta = gamma_delta(law, modes)
    told = {"gamma": gamma, "delta": delta} if spec.filter.traits.told else {}
    return y, {**parameters, **told}


def _draw_nonlinear(
    spec: Spec,
    parameters: Mapping[str, Array],
    u: Array,
    rng: np.random.Generator,
    scale: float,
) -> tuple[Array, dict[str, Array]]:
    """The same of a plant by equations: its mode, or what works of it, at every sample."""
    T, faults, jump = len(u), spec.faults.sensor, spec.faults.jump
    if jump is not None:
        chain = chain_of(spec, T, parameters)
        path = draw_chain(chain["transitions"], chain["initial"], T, rng)
        modes = [system_of(spec, T, parameters, mode) for mode in jump.modes]
        return simulate_nonlinear([modes[i] for i in path], u, rng, scale=scale)[0], {**parameters}
    system = system_of(spec, T, parameters)
    if faults is not None:
        law = _law(spec, faults, T, parameters)
        gamma, delta = gamma_delta(law, draw_modes(law, T, rng))
        sensed = system.told(faults.rows, gamma, delta)
        told = {"gamma": gamma, "delta": delta} if spec.filter.traits.told else {}
        return simulate_nonlinear(sensed, u, rng, scale=scale)[0], {**parameters, **told}
    rate, covariance = actuation_of(spec, T, parameters, spec.first_rates)
    effective = draw_patterns(rate, covariance, rng) * u
    return simulate_nonlinear(system, effective, rng, scale=scale)[0], {**parameters}


def informed(
    system: LinearSystem, faults: SensorFaults, gamma: Array, delta: Array
) -> LinearSystem:
    """The plant of one who knows gamma and delta of every sample, (T,)."""
    rows = list(faults.rows)
    signal, noise = np.ones((2, system.length, system.ny))
    signal[:, rows], noise[:, rows] = gamma[:, None], np.sqrt(delta)[:, None]
    return replace(
        system,
        C=signal[:, :, None] * system.C,
        D=signal[:, :, None] * system.D,
        d=signal * system.d,
        R=noise[:, :, None] * system.R * noise[:, None, :],
    )


def _law(spec: Spec, faults: SensorFaults, T: int, parameters: Mapping[str, Array]) -> SensorLaw:
    """The law of a spec; moments as independent samples."""
    if faults.kernel:
        return SensorLaw.over(spec, T, parameters)
    kernel, initial = UNIFORM, UNIFORM[0]
    if faults.moments is not None:
        g, d = faults.moments.gamma_rate, faults.moments.delta_nominal_rate
        initial = np.outer([g, 1.0 - g], [d, 1.0 - d]).ravel()
        kernel = np.tile(initial, (4, 1))
    return SensorLaw(
        kernel=kernel,
        initial=initial,
        noise_factor=faults.noise_factor,
        rows=faults.rows,
        factors=factors_of(spec, T, parameters),
    )
