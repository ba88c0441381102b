"""Measurements that may carry no signal or more noise: Sigalov & Oshman, eq. (2), as plants.

A plant whose sensor is in a known condition is a plant again, with other C, D and R; so a filter
matched to a mode is the usual correction.
"""

from __future__ import annotations

import math
from dataclasses import replace

import casadi as ca

from fkgen.faults import SensorFaults
from fkgen.symbolic.builder import Script
from fkgen.symbolic.interface import Kind, Status
from fkgen.symbolic.linalg import is_zero, sparse
from fkgen.symbolic.plant import Plant


def with_indicators(plant: Plant, rows: tuple[int, ...], gamma: ca.SX, delta: ca.SX) -> Plant:
    """The plant whose ``rows`` of y have signal ``gamma`` and noise variance R ``delta``.

    Noise that is correlated with that of a healthy row stays so: its deviation grows with the
    square root of delta.
    """
    signal = ca.SX.ones(plant.ny)
    for row in rows:
        signal[row] = gamma
    C = sparse(ca.diag(signal) @ plant.C)
    D = sparse(ca.diag(signal) @ plant.D)
    return replace(plant, C=C, D=D, R=scaled_noise(plant.R, rows, delta, _square_root(delta)))


def scaled_noise(R: ca.SX, rows: tuple[int, ...], own: ca.SX, cross: ca.SX) -> ca.SX:
    """R times ``own`` among the rows, times ``cross`` between them and the others."""
    result = ca.SX(R)
    for i in range(R.shape[0]):
        for j in range(R.shape[0]):
            faulty = (i in rows) + (j in rows)
            if faulty and not is_zero(R[i, j]):
                result[i, j] = R[i, j] * (own if faulty == 2 else cross)
    return result


def _square_root(value: ca.SX) -> ca.SX:
    return ca.SX(math.sqrt(float(value))) if value.is_constant() else ca.sqrt(value)


def mode_plants(plant: Plant, faults: SensorFaults) -> list[Plant]:
    """The plant in the four modes (1,1) (1,C) (0,1) (0,C) of (gamma, delta)."""
    return [
        with_indicators(plant, faults.rows, ca.SX(gamma), ca.SX(delta))
        for gamma in (1, 0)
        for delta in (1.0, faults.noise_factor)
    ]


def mode_titles(faults: SensorFaults) -> list[str]:
    """How the generated code calls the four modes."""
    noisy = f"noise x {faults.noise_factor:g}"
    return [f"{signal}, {noise}" for signal in ("signal", "no signal") for noise in ("R", noisy)]


def is_entangled(plant: Plant, rows: tuple[int, ...]) -> bool:
    """Whether R correlates rows that can fail with rows that cannot."""
    healthy = [i for i in range(plant.ny) if i not in rows]
    return any(not is_zero(plant.R[i, j]) for i in rows for j in healthy)


def observed(plant: Plant, faults: SensorFaults) -> Plant:
    """The plant under the indicators that are given at run time, for ``genie``."""
    gamma, delta = plant.parameters["gamma"], plant.parameters["delta"]
    return with_indicators(plant, faults.rows, gamma, delta)


def demand_indicators(script: Script, plant: Plant, faults: SensorFaults) -> None:
    """Refuse a gamma that is neither 0 nor 1, and a delta that is neither 1 nor C."""
    gamma, delta = plant.parameters["gamma"], plant.parameters["delta"]
    for value, other in ((gamma, ca.SX(0)), (delta, ca.SX(faults.noise_factor))):
        zero = (value - 1) * (value - other)
        script.demand(Kind.NONNEGATIVE, [zero, -zero], Status.PARAMETER_OUT_OF_RANGE)
