"""Exact linear filter for a Markov gamma: the state split by mode, y^j = x 1{mode = j}.

Costa 1994, the reference [4] of Sigalov & Oshman: sec. V assumes Lemma 2, this form does not. With
known inputs the split state is (x, 1) 1{mode = j}, because what an input does then depends on a
random indicator. The covariance of the split process noise is written as the second moment of
indicators around their prediction, so nothing cancels.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from fkgen.errors import InternalError
from fkgen.spec import SensorFaults, Spec
from fkgen.spec.chain import visited
from fkgen.spec.linear_optimal import EQUAL
from fkgen.symbolic.conditioning import condition
from fkgen.symbolic.estimate import (
    bound,
    demand_finite,
    demand_positive,
    finite,
    measurement_of,
    update_form,
)
from fkgen.symbolic.fault_law import FaultLaw
from fkgen.symbolic.interface import Port, Role
from fkgen.symbolic.linalg import column, congruence, pack, sparse, unpack
from fkgen.symbolic.packing import triangle
from fkgen.symbolic.plant import Plant, plant_of
from fkgen.symbolic.ports import innovation_ports, prior_of, state_ports, symbols_of
from fkgen.symbolic.recursion import Phase, Recursion
from fkgen.symbolic.script import Script
from fkgen.symbolic.sequential import Form

Array = NDArray[np.float64]

#: What the prediction moves on and y[k] does not change.
_CARRIED = ("mode_second_moment", "mode_law")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Split:
    """The split state: N modes with the signal indicator of each, and its sizes."""

    spec: Spec
    plant: Plant
    law: FaultLaw
    symbols: dict[str, ca.SX]
    form: Form
    kernel: Array
    signal: tuple[int, ...]
    members: tuple[tuple[int, ...], ...]

    @property
    def count(self) -> int:
        """Number N of modes."""
        return len(self.signal)

    @property
    def width(self) -> int:
        """Length of (x, 1), or of x if nothing depends on an indicator alone."""
        return self.plant.nx + (1 if self.plant.nu else 0)

    def mode_law(self, law: ca.SX) -> list[ca.SX]:
        """Probability of each mode of the split from that of the four."""
        return [sum((law[i] for i in each[1:]), start=law[each[0]]) for each in self.members]


def augmented_filter(spec: Spec, source: str) -> Recursion:
    """Build the recursion of ``linear_optimal`` in its form ``augmented``."""
    plant, faults = plant_of(spec), spec.faults.sensor
    if faults is None or not faults.kernel:
        raise InternalError("the augmented form without a law")
    law = FaultLaw.of(spec, faults)
    kernel, signal, members = _modes(faults)
    form = update_form(spec, plant, augmented=False)
    width = plant.nx + (1 if plant.nu else 0)
    ports = (
        *state_ports(spec),
        *innovation_ports(spec),
        *_split_ports(plant, len(signal), width),
        *law.law_ports(),
    )
    split = _Split(
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
        initial=_start(split),
        update=_update(split),
        predict=_predict(split),
        notes=(f"covariance update: {form} form", f"state split by {split.count} modes"),
    )


def _modes(faults: SensorFaults) -> tuple[Array, tuple[int, ...], tuple[tuple[int, ...], ...]]:
    """Kernel, gamma and members of the modes: two if gamma alone is Markov, else four."""
    P = np.array(faults.kernel)
    signal_next = P[:, :2].sum(axis=1)
    reached = visited(P, faults.initial)
    groups = [[i for i in pair if reached[i]] for pair in ((0, 1), (2, 3))]
    if any(len(g) > 1 and np.ptp(signal_next[g]) > EQUAL for g in groups):
        return P, (1, 1, 0, 0), ((0,), (1,), (2,), (3,))
    rates = [float(signal_next[g[0]]) if g else 0.0 for g in groups]
    gamma = np.array([[rate, 1.0 - rate] for rate in rates])
    return gamma, (1, 0), ((0, 1), (2, 3))


def _split_ports(plant: Plant, count: int, width: int) -> tuple[Port, ...]:
    n, size = plant.nx, count * width
    what = "(x, 1) 1{mode}" if plant.nu else "x 1{mode}"
    square = (size, size)
    return (
        Port(
            name="augmented_state",
            shape=(size,),
            role=Role.STATE,
            meaning=f"estimate of {what} at k+1 given y[0..k], mode by mode",
        ),
        Port(
            name="augmented_covariance",
            shape=square,
            role=Role.STATE,
            symmetric=True,
            meaning="its error covariance",
        ),
        Port(
            name="augmented_filtered_state",
            shape=(size,),
            role=Role.STATE,
            meaning="the same at k given y[0..k]",
        ),
        Port(
            name="augmented_filtered_covariance",
            shape=square,
            role=Role.STATE,
            symmetric=True,
            meaning="its error covariance",
        ),
        *(
            Port(
                name=f"{prefix}mode_second_moment",
                shape=(count, width, width),
                role=Role.STATE,
                symmetric=True,
                meaning=f"second moment of {what} at {k}, unconditional",
            )
            for prefix, k in (("", "k"), ("predicted_", "k+1"))
        ),
        Port(
            name="state_second_moment",
            shape=(n, n),
            role=Role.OUTPUT,
            symmetric=True,
            meaning="E[x[k] x[k]'], unconditional",
        ),
    )


def _start(split: _Split) -> dict[str, tuple[float, ...]]:
    """Second moments of the prior, split by the law of the mode, and what the mean leaves."""
    x0, packed = prior_of(split.spec)
    P0, n, w = split.spec.model.P0.values(), split.plant.nx, split.width
    mean = np.append(x0, 1.0)[:w]
    second = np.outer(mean, mean)
    second[:n, :n] += P0
    law = np.array([sum(split.law.faults.initial[i] for i in each) for each in split.members])
    covariance = np.kron(np.diag(law), second) - np.kron(np.outer(law, law), np.outer(mean, mean))
    state = tuple(np.kron(law, mean).tolist())
    lower = tuple(float(covariance[i, j]) for i, j in triangle(len(covariance)))
    moments = tuple(float(p * second[i, j]) for p in law for i, j in triangle(w))
    return {
        **{f"{of}_state": x0 for of in ("predicted", "filtered")},
        **{f"{of}_covariance": packed for of in ("predicted", "filtered")},
        **{f"augmented_{of}state": state for of in ("", "filtered_")},
        **{f"augmented_{of}covariance": lower for of in ("", "filtered_")},
        "predicted_mode_second_moment": moments,
        **split.law.law_start(),
    }


def _update(split: _Split) -> Phase:
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


def _measured(split: _Split, plant: Plant) -> ca.SX:
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


def _whole(split: _Split, state: ca.SX, packed: ca.SX) -> tuple[ca.SX, ca.SX]:
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


def _moments(split: _Split, port: str) -> list[ca.SX]:
    """Second moment of the split state, mode by mode."""
    w = split.width
    parts = ca.vertsplit(split.symbols[port], w * (w + 1) // 2)
    return [unpack(part, w) for part in parts]


def _predict(split: _Split) -> Phase:
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


def _homogeneous(split: _Split, plant: Plant) -> tuple[ca.SX, ca.SX]:
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
