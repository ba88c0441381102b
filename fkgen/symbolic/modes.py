"""The plant of every mode of a jumping plant, as CasADi matrices."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca

from fkgen.errors import InternalError
from fkgen.spec import JumpFaults, Matrix, Spec
from fkgen.spec.covariance import is_singular
from fkgen.symbolic.plant import Plant, lift, plant_of


@dataclass(frozen=True, slots=True)
class JumpModes:
    """A plant with several modes.

    Attributes
    ----------
    base : Plant
        The plant of ``[model]``: parameters and names; all modes share them.
    plants : tuple of Plant
        Mode by mode, with matrices of its own.
    offsets : tuple of (n, 1) SX
        c of every mode.
    """

    base: Plant
    plants: tuple[Plant, ...]
    offsets: tuple[ca.SX, ...]


def jump_faults_of(spec: Spec) -> JumpFaults:
    """The jump faults of a spec that has some."""
    if spec.faults.jump is None:
        raise InternalError(f"{spec.filter.family} without jump faults")
    return spec.faults.jump


def jump_modes_of(spec: Spec) -> JumpModes:
    """Lift the modes of a spec to CasADi; they share the symbols of the parameters.

    Matrices that modes have in common are the same object.
    """
    base, faults = plant_of(spec), jump_faults_of(spec)
    known: dict[tuple[str, Matrix], ca.SX] = {}
    plants = []
    for mode in faults.modes:
        lifted: dict[str, Any] = {}
        for letter in ("A", "B", "C", "D", "Q", "R", "c"):
            key = letter, getattr(mode, letter)
            if key not in known:
                known[key] = lift(key[1], base.parameters)
            lifted[letter] = known[key]
        exact = mode.R.is_constant and is_singular(mode.R.values())
        plants.append(replace(base, noise_free=exact, **lifted))
    return JumpModes(base, tuple(plants), tuple(plant.c for plant in plants))
