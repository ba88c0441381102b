"""The plant of a filter with one mean and one covariance, where its estimates are, as functions.

A smoother works through a record backwards; it needs A, C, Q, R and S of every sample. Inputs that
fail add to Q, R and S what their variance adds to x and y.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from fkgen.estimators.gaussian.actuation import actuation_of
from fkgen.problem import Spec
from fkgen.symbolic.lifting.equations import shifted, turned_by
from fkgen.symbolic.linalg import congruence, unpack
from fkgen.symbolic.plant import mode_plants, plant_of

Array = NDArray[np.float64]

#: Values for each of T samples, numbers in rows: predicted and filtered state, inputs, parameters.
Given = tuple[Array, Array, Array, Array]


@dataclass(frozen=True, slots=True)
class Linearised:
    """A plant along a record."""

    spec: Spec

    def matrices(self) -> Callable[[Given], dict[str, Array]]:
        """What gives A (T, n, n), C (T, p, n), Q (T, n, n), R (T, p, p) and S (T, n, p)."""
        spec, plant = self.spec, plant_of(self.spec)
        predicted, filtered = (ca.SX.sym(name, plant.nx) for name in ("predicted", "filtered"))
        u = ca.SX.sym("u", plant.nu)
        seen = plant
        if spec.faults.sensor is not None:
            (seen,) = mode_plants(spec, [spec.faults.sensor.told(spec.model)], plant)
        actuation = actuation_of(spec, plant, u)
        C, D = seen.C, seen.D
        A, B, Q = plant.A, plant.B, ca.SX(plant.Q)
        if plant.lifted is not None and seen.lifted is not None:
            at = [seen.lifted.x, seen.lifted.u], [predicted, actuation.mean]
            C, D = ca.substitute([seen.lifted.C, seen.lifted.D], *at)
            at = [plant.lifted.x, plant.lifted.u], [filtered, actuation.mean]
            A, B, G = ca.substitute([plant.lifted.A, plant.lifted.B, plant.lifted.G], *at)
            if plant.lifted.variances.numel():
                Q += unpack(congruence(G, ca.diag(plant.lifted.variances)), plant.ne)
        R, S = ca.SX(seen.R), ca.SX(plant.S)
        if actuation.size:
            through, variance = actuation.through, actuation.covariance
            Q += B @ through @ variance @ (B @ through).T
            R += D @ through @ variance @ (D @ through).T
            S += B @ through @ variance @ (D @ through).T
        inputs = predicted, filtered, u, ca.vertcat(ca.SX(0, 1), *plant.parameters.values())
        found = {"A": A, "C": C, "Q": Q, "R": R, "S": S}
        maps = {letter: over_samples(inputs, each) for letter, each in found.items()}
        return lambda given: {letter: each(given) for letter, each in maps.items()}

    def moved(self) -> tuple[Callable[[Given], Array], Callable[[Given], Array]]:
        """What moves states by errors, (T, n, 1), and what turns with them, (T, ne, ne).

        The errors take the place of filtered states.
        """
        plant = plant_of(self.spec)
        x, errors, none = ca.SX.sym("x", plant.nx), ca.SX.sym("d", plant.ne), ca.SX(0, 1)
        inputs = x, errors, none, none
        state = shifted(x, errors, plant.attitudes)
        turned = turned_by(plant.attitudes, errors)
        return over_samples(inputs, state), over_samples(inputs, turned)


def over_samples(inputs: tuple[ca.SX, ...], value: ca.SX) -> Callable[[Given], Array]:
    """What evaluates a matrix at all samples; one that never changes is evaluated once."""
    names = {each.name() for each in ca.symvar(value)}
    read = [any(each.name() in names for each in ca.symvar(given)) for given in inputs]
    function = ca.Function("values", list(inputs), [ca.densify(value)])
    rows, columns = value.shape

    def values(given: Given) -> Array:
        T = given[0].shape[1]
        own_read = [own for own, reads in zip(given, read, strict=True) if reads]
        varies = any(bool((own != own[:, :1]).any()) for own in own_read)
        if not varies:
            own = np.asarray(function(*(each[:, :1] for each in given)))
            return np.broadcast_to(own, (T, rows, columns))
        found = np.asarray(function.map(T)(*given))
        return np.ascontiguousarray(found.reshape(rows, T, columns).transpose(1, 0, 2))

    return values
