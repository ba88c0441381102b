"""A family that fkgen does not know: a Luenberger observer of one output, its gain an option."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from fkgen.families.family import Family, Proof
from fkgen.oracle.claims.claim import ClosedForm
from fkgen.problem.filter import Options
from fkgen.problem.table.section import as_list, as_number
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.linalg import congruence, pack, unpack
from fkgen.symbolic.plant import plant_of
from fkgen.symbolic.ports import innovation_ports, prior_of, state_ports, symbols_of
from fkgen.symbolic.recursion import Recursion


@dataclass(frozen=True, slots=True)
class Gain(Options):
    gain: tuple[float, ...]

    @classmethod
    def read(cls, section, _, model):
        place = section.place.entry("gain")
        expected = f"a list of {model.nx} numbers, one per state"
        entries = as_list(section.require("gain", expected), place, expected)
        if len(entries) != model.nx:
            raise place.error(f"{len(entries)} numbers", expected)
        return cls(tuple(as_number(entry, place, expected) for entry in entries))


def build(spec):
    plant = plant_of(spec)
    ports = (*state_ports(spec), *innovation_ports(spec))
    symbols = symbols_of(spec, plant, ports)
    x0, packed = prior_of(spec)
    initial = {f"{of}_state": x0 for of in ("predicted", "filtered")}
    initial |= {f"{of}_covariance": packed for of in ("predicted", "filtered")}
    return Recursion(
        spec=spec,
        source="Luenberger 1971, IEEE Trans. Automatic Control 16(6), sec. II",
        ports=ports,
        initial=initial,
        update=corrected(plant, symbols, ca.SX(list(spec.filter.options.gain))),
        predict=moved(plant, symbols),
    )


def corrected(plant, symbols, K):
    builder = PhaseBuilder(symbols)
    x, P = symbols["predicted_state"], unpack(symbols["predicted_covariance"], plant.nx)
    seen = builder.local("seen", 1, 0.0)
    off = builder.local("off", 1, 0.0)
    S = builder.define("S", plant.C @ P @ plant.C.T + plant.R)
    with builder.if_present(row=0):
        builder.assign({"seen": ca.SX(1.0), "off": symbols["y"] - plant.C @ x})
    rest = ca.SX.eye(plant.nx) - seen * K @ plant.C
    builder.assign(
        {
            "filtered_state": x + K * off,
            "filtered_covariance": congruence(rest, P) + congruence(seen * K, plant.R),
            "innovation": off,
            "innovation_covariance": S,
            "nis": off * off / S,
            "log_likelihood": -0.5 * (off * off / S + seen * ca.log(2.0 * np.pi * S)),
        }
    )
    return builder.phase()


def moved(plant, symbols):
    builder = PhaseBuilder(symbols)
    P = unpack(symbols["filtered_covariance"], plant.nx)
    builder.assign(
        {
            "predicted_state": plant.A @ symbols["filtered_state"],
            "predicted_covariance": congruence(plant.A, P) + pack(plant.Q),
        }
    )
    return builder.phase()


def in_numpy(spec, record):
    A, C, Q, R = (getattr(spec.model, letter).values() for letter in "ACQR")
    K, x, P = np.array([spec.filter.options.gain]).T, spec.model.x0.values(), record.P0
    states, covariances = [], []
    for y in record.y:
        if np.isfinite(y).all():
            x = x + K @ (y[:, None] - C @ x)
            P = (np.eye(len(A)) - K @ C) @ P @ (np.eye(len(A)) - K @ C).T + K @ R @ K.T
        states.append(x.ravel())
        covariances.append(P)
        x, P = A @ x, A @ P @ A.T + Q
    return {"filtered_state": np.array(states), "filtered_covariance": np.array(covariances)}


LOOP = ClosedForm(
    claim="estimate and error covariance are those of the observer written in matrices",
    source="x + K (y - C x); (I - K C) P (I - K C)' + K R K'",
    tolerance=lambda *_: 1e-12,  # some ten roundings of numbers of one size
    expected=in_numpy,
)

FAMILY = Family(
    name="observer",
    title="Luenberger observer with a given gain",
    build=build,
    proof=lambda: Proof((LOOP,)),
    options=Gain,
)

NO_FAMILY = 3
