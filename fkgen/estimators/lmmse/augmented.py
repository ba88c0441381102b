"""Exact linear filter for a Markov gamma: the state split by mode, y^j = x 1{mode = j}.

Costa 1994, the reference [4] of Sigalov & Oshman: sec. V assumes Lemma 2, this form does not. With
known inputs the split state is (x, 1) 1{mode = j}, because what an input does then depends on a
random indicator. The covariance of the split process noise is written as the second moment of
indicators around their prediction, so nothing cancels.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from fkgen.errors import InternalError
from fkgen.estimators.gaussian.conditioning import condition
from fkgen.estimators.gaussian.estimate import (
    bound,
    demand_finite,
    demand_positive,
    finite,
    measurement_of,
    update_form,
)
from fkgen.estimators.lmmse.lemma2 import FaultLaw
from fkgen.estimators.lmmse.split import Split, split_modes, split_ports, split_start
from fkgen.problem import Spec
from fkgen.symbolic.builder import Script
from fkgen.symbolic.linalg import column, congruence, pack, sparse, unpack
from fkgen.symbolic.plant import Plant, plant_of
from fkgen.symbolic.ports import innovation_ports, state_ports, symbols_of
from fkgen.symbolic.recursion import Phase, Recursion

Array = NDArray[np.float64]

#: What the prediction moves on and y[k] does not change.
_CARRIED = ("mode_second_moment", "mode_law")


def augmented_filter(spec: Spec, source: str) -> Recursion:
    """Build the recursion of ``linear_optimal`` in its form ``augmented``."""
    plant, faults = plant_of(spec), spec.faults.sensor
    if faults is None or not faults.kernel:
        raise InternalError("the augmented form without a law")
    law = FaultLaw.of(spec, faults)
    kernel, signal, members = split_modes(faults)
    form = update_form(spec, plant, augmented=False)
    width = plant.nx + (1 if plant.nu else 0)
    ports = (
        *state_ports(spec),
        *innovation_ports(spec),
        *split_ports(plant, len(signal), width),
        *law.law_ports(),
    )
    split = Split(
        spec=spec,
        plant=plant,
        law=law,
        symbols=symbols_of(spec, plant, ports),
        form=form,
        kernel=kernel,
        signal=signal,
        members=members,
    )
    return Recursion(
        spec=spec,
        source=source,
        ports=ports,
        initial=split_start(split),
        update=_update(split),
        predict=_predict(split),
        form=form,
        notes=(f"state split by {split.count} modes",),
    )


def _update(split: Split) -> Phase:
    symbols, n, size = split.symbols, split.plant.nx, split.count * split.width
    script = Script(symbols)
    demand_positive(script, symbols["augmented_covariance"], size)
    plant = bound(script, split.plant, "CDR")
    measurement = measurement_of(
        plant,
        scalar=split.spec.code.scalar,
        y=symbols["y"],
        C=_measured(split, plant),
        offset=ca.SX(plant.ny, 1),
        R=split.law.noise(plant, symbols),
    )
    prior = (symbols["augmented_state"], unpack(symbols["augmented_covariance"], size))
    found = condition(script, prior, measurement, form=split.form)
    state, covariance = _whole(split, found.mean, found.covariance)
    demand_finite(script, found.mean)
    moments = _moments(split, "predicted_mode_second_moment")
    carried = [name for name in _CARRIED if name in symbols]
    with script.titled("results of the update"):
        script.put(
            {
                "augmented_filtered_state": found.mean,
                "augmented_filtered_covariance": found.covariance,
                "filtered_state": state,
                "filtered_covariance": covariance,
                "innovation": found.innovation,
                "innovation_covariance": found.innovation_covariance,
                "nis": found.nis,
                "log_likelihood": found.log_likelihood,
                "state_second_moment": pack(_sum(moments)[:n, :n]),
                **{name: symbols[f"predicted_{name}"] for name in carried},
            }
        )
    return script.phase()


def _measured(split: Split, plant: Plant) -> ca.SX:
    """What y measures of the split state: C (and D u) where there is a signal."""
    signal = ca.horzcat(plant.C, plant.D @ split.symbols["u"]) if plant.nu else plant.C
    blocks = []
    for gamma in split.signal:
        block = ca.SX(signal)
        if not gamma:
            for row in split.law.faults.rows:
                block[row, :] = 0
        blocks.append(block)
    return sparse(ca.horzcat(*blocks))


def _whole(split: Split, state: ca.SX, packed: ca.SX) -> tuple[ca.SX, ca.SX]:
    """X and its covariance: the sum over the modes."""
    n, w = split.plant.nx, split.width
    P = unpack(packed, split.count * w)
    starts = range(0, split.count * w, w)
    blocks = [P[a : a + n, b : b + n] for a in starts for b in starts]
    return _sum([state[a : a + n] for a in starts]), pack(_sum(blocks))


def _sum(matrices: list[ca.SX]) -> ca.SX:
    total = matrices[0]
    for matrix in matrices[1:]:
        total = total + matrix
    return total


def _moments(split: Split, port: str) -> list[ca.SX]:
    """Second moment of the split state, mode by mode."""
    w = split.width
    parts = ca.vertsplit(split.symbols[port], w * (w + 1) // 2)
    return [unpack(part, w) for part in parts]


def _predict(split: Split) -> Phase:
    symbols, w, N = split.symbols, split.width, split.count
    script, P = Script(symbols), split.kernel
    plant = bound(script, split.plant, "ABQ")
    transition, noise = _homogeneous(split, plant)
    with script.titled("second moments, mode by mode"):
        moved = [
            unpack(script.let(f"moved_moment_{i}", congruence(transition, moment)), w)
            for i, moment in enumerate(_moments(split, "mode_second_moment"))
        ]
        law = split.mode_law(split.law.next_law(symbols))
        later = [
            script.let(
                f"next_moment_{j}",
                pack(_sum([float(P[i, j]) * moved[i] for i in range(N)]) + law[j] * noise),
            )
            for j in range(N)
        ]
    with script.titled("prediction of the split state"):
        F = sparse(ca.kron(ca.SX(ca.DM(P.T)), transition))
        added = _added_noise(moved, [law[j] * noise for j in range(N)], P)
        state = script.let("moved_state", F @ symbols["augmented_filtered_state"])
        filtered = unpack(symbols["augmented_filtered_covariance"], N * w)
        covariance = script.let("moved_covariance", congruence(F, filtered) + pack(added))
    x, Px = _whole(split, state, covariance)
    with script.titled("prediction of the next sample"):
        script.put(
            {
                "augmented_state": state,
                "augmented_covariance": covariance,
                "predicted_mode_second_moment": ca.vertcat(*later),
                "predicted_state": x,
                "predicted_covariance": Px,
                **{k: v for k, v in split.law.advanced(symbols).items() if k in symbols},
            },
            [finite(x, Px), *(finite(column([m[0]]), m) for m in later)],
        )
    return script.phase()


def _homogeneous(split: Split, plant: Plant) -> tuple[ca.SX, ca.SX]:
    """Transition and noise of (x, 1), or of x."""
    if not plant.nu:
        return plant.A, plant.Q
    n = plant.nx
    top = ca.horzcat(plant.A, plant.B @ split.symbols["u"])
    transition = ca.vertcat(top, ca.horzcat(ca.SX(1, n), ca.SX(1)))
    return sparse(transition), ca.diagcat(plant.Q, ca.SX(1, 1))


def _added_noise(moved: list[ca.SX], noise: list[ca.SX], P: Array) -> ca.SX:
    """Covariance of the split noise: indicators around their prediction, and the plant's own.

    Block (j, l) is sum_i (p_ij 1{j = l} - p_ij p_il) A X_i A' + 1{j = l} pi_j Q.
    """
    N, w = len(moved), moved[0].shape[0]
    result = ca.SX(N * w, N * w)
    for j in range(N):
        for k in range(N):
            block = ca.SX(w, w)
            for i in range(N):
                share = float(P[i, j]) * ((1.0 - float(P[i, j])) if j == k else -float(P[i, k]))
                if share:
                    block = block + share * moved[i]
            if j == k:
                block = block + noise[j]
            result[j * w : (j + 1) * w, k * w : (k + 1) * w] = block
    return sparse(result)
