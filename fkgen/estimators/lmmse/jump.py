"""The LMMSE filter of a jumping plant, with a gain that follows the moments.

Costa 1994; Costa, Fragoso & Marques 2005, sec. 5.4; Nahi 1969 for arrivals of which only the rate
is known; Sun & Zhao & Yin for samples that a test rejects.

Moments of a jumping plant, and the covariance of its split noise: Lemma 3 and what follows.

Written as second moments of indicators around their prediction, so that nothing cancels; the rows
of x itself hold the plant's own noise only.

Prediction of the split state: every mode's step, then the mixing by the chain.

F = (P' (x) I) diag(A_i) is never formed. With u = A_N x + sum (A_i - A_N) z^i, which is the next x
but for noise, and t^i = A_i z^i, the next part j is p_Nj u + sum_i (p_ij - p_Nj) t^i.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import casadi as ca

from fkgen.estimators.gaussian.conditioning import Conditioned, condition
from fkgen.estimators.gaussian.estimate import (
    bound_all,
    demand_finite,
    demand_positive,
    finite,
    measurement_of,
    update_form,
)
from fkgen.estimators.gaussian.sequential import Form
from fkgen.estimators.lmmse.jumping import Jumping, law_ports, measured, split_ports, split_start
from fkgen.estimators.lmmse.loss_tests import LossTest, Verdict, loss_outcomes, loss_ports
from fkgen.problem import Spec
from fkgen.symbolic.builder import Script
from fkgen.symbolic.linalg import column, congruence, outer_lower, pack, sparse, total, unpack
from fkgen.symbolic.packing import triangle
from fkgen.symbolic.plant import Plant
from fkgen.symbolic.ports import innovation_ports, prior_of, state_ports, symbols_of
from fkgen.symbolic.recursion import Phase, Recursion


@dataclass(frozen=True, slots=True)
class Moments:
    """E[x x' 1{mode}], E[x 1{mode}] and Pr(mode), mode by mode; no first moments if not needed."""

    second: tuple[ca.SX, ...]
    first: tuple[ca.SX, ...]
    law: ca.SX


def moments_of(split: Jumping, symbols: dict[str, ca.SX], prefix: str) -> Moments:
    """The moments that are carried along, as matrices and columns."""
    n = split.base.nx
    second = ca.vertsplit(symbols[f"{prefix}mode_second_moment"], n * (n + 1) // 2)
    first: tuple[ca.SX, ...] = ()
    if split.means:
        first = tuple(ca.vertsplit(symbols[f"{prefix}mode_first_moment"], n))
    law = split.law(symbols) if prefix else _carried_law(split, symbols)
    return Moments(tuple(unpack(each, n) for each in second), first, law)


def _carried_law(split: Jumping, symbols: dict[str, ca.SX]) -> ca.SX:
    return split.law(symbols) if split.settled else symbols["mode_law"]


def next_law(split: Jumping, law: ca.SX) -> ca.SX:
    """Law of the mode one sample later, its rounding taken out of the sum."""
    if split.settled:
        return law
    moved = ca.SX(ca.DM(split.kernel)).T @ law
    return moved / ca.sum1(moved)


def shared(matrices: list[ca.SX], weights: list[ca.SX]) -> ca.SX:
    """Weighted sum; weights of a matrix that several modes have in common are added first."""
    distinct: dict[int, tuple[ca.SX, ca.SX]] = {}
    for matrix, weight in zip(matrices, weights, strict=True):
        known = distinct.get(id(matrix))
        distinct[id(matrix)] = (matrix, weight if known is None else known[1] + weight)
    return total([weight * matrix for matrix, weight in distinct.values()])


def offset_of(plant: Plant, u: ca.SX) -> ca.SX:
    """What is known and added to the state: B u + c."""
    return plant.B @ u + plant.c


def moved_moments(
    script: Script, split: Jumping, plants: tuple[Plant, ...], now: Moments, u: ca.SX
) -> list[ca.SX]:
    """Second moment of (A x + b, 1) 1{mode}, or of A x 1{mode}, mode by mode."""
    n, result = split.base.nx, []
    for i, plant in enumerate(plants):
        if split.ones:
            last = ca.horzcat(ca.SX(1, n), ca.SX(1))
            through = sparse(ca.vertcat(ca.horzcat(plant.A, offset_of(plant, u)), last))
            q = now.first[i]
            before = ca.blockcat(now.second[i], q, q.T, now.law[i])
        else:
            through, before = plant.A, now.second[i]
        moved = script.let(f"moved_moment_{i}", congruence(through, before))
        result.append(unpack(moved, split.width))
    return result


def plant_noise(split: Jumping, plants: tuple[Plant, ...], law: ca.SX) -> list[ca.SX]:
    """sum_i p_ij pi_i Q_i: what the plant's own noise adds in the step to each mode."""
    P = split.kernel
    return [
        shared([p.Q for p in plants], [float(P[i, j]) * law[i] for i in range(split.modes)])
        for j in range(split.modes)
    ]


def later_moments(
    split: Jumping, moved: list[ca.SX], noise: list[ca.SX]
) -> tuple[list[ca.SX], list[ca.SX]]:
    """Packed second and first moments one sample later."""
    P, n, N = split.kernel, split.base.nx, split.modes
    mixed = [
        total([float(P[i, j]) * moved[i] for i in range(N) if P[i, j]] or [0 * moved[0]])
        for j in range(N)
    ]
    second = [pack(mixed[j][:n, :n] + noise[j]) for j in range(N)]
    return second, [ca.densify(each[:n, n]) for each in mixed] if split.ones else []


def split_noise(split: Jumping, moved: list[ca.SX], noise: list[ca.SX]) -> ca.SX:
    """Covariance of the noise of the split state, as a matrix of which the lower half counts."""
    P, w, n = split.transition, split.width, split.base.nx
    count = split.parts
    parts = [share * moment for share in split.shares for moment in moved]
    own = [share * each for share in split.shares for each in noise]
    W = ca.SX(split.size, split.size)
    for j in range(count - 1):
        at = slice(j * w, j * w + n)
        W[split.own, at] = own[j]
        for k in range(j + 1):
            shares = [P[i, j] * ((1.0 - P[i, j]) if j == k else -P[i, k]) for i in range(count)]
            terms = [float(s) * part for s, part in zip(shares, parts, strict=True) if s]
            block = total(terms) if terms else ca.SX(w, w)
            if j == k:
                block[:n, :n] = block[:n, :n] + own[j]
            W[j * w : j * w + w, k * w : k * w + w] = block
    W[split.own, split.own] = total(noise)
    return sparse(W)


def unconditional(split: Jumping, now: Moments) -> tuple[ca.SX, ca.SX]:
    """Mean and packed covariance of the split state without any measurement."""
    n, w = split.base.nx, split.width
    mean = ca.SX(split.size, 1)
    X = ca.SX(split.size, split.size)
    means, seconds = [], []
    for share in split.shares:
        for i in range(split.modes):
            q, pi = share * now.first[i], share * now.law[i]
            Z = share * now.second[i]
            means.append(ca.vertcat(q, pi) if split.ones else q)
            seconds.append(ca.blockcat(Z, q, q.T, pi) if split.ones else Z)
    for i in range(split.parts - 1):
        mean[i * w : (i + 1) * w] = means[i]
        X[i * w : (i + 1) * w, i * w : (i + 1) * w] = seconds[i]
        X[split.own, i * w : (i + 1) * w] = seconds[i][:n, :]
    mean[split.own] = total([each[:n] for each in means])
    X[split.own, split.own] = total([each[:n, :n] for each in seconds])
    spread = outer_lower(mean, mean)
    lower = [X[i, j] for i, j in triangle(split.size)]
    return mean, ca.densify(ca.vertcat(*lower)) - spread


def steps(split: Jumping, plants: tuple[Plant, ...], u: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Matrix and constant of (t, u): what every mode makes of the split state."""
    w, n, last = split.width, split.base.nx, split.plant(plants, split.parts - 1)
    G = ca.SX(split.size, split.size)
    known = offset_of(last, u)
    for i in range(split.parts - 1):
        plant, at = split.plant(plants, i), slice(i * w, i * w + n)
        G[at, at] = plant.A
        G[split.own, at] = plant.A - last.A
        if split.ones:
            one = i * w + n
            G[at, one] = offset_of(plant, u)
            G[one, one] = 1
            G[split.own, one] = offset_of(plant, u) - known
    G[split.own, split.own] = last.A
    constant = ca.SX(split.size, 1)
    constant[split.own] = known
    return sparse(G), sparse(constant)


def mixing(split: Jumping) -> tuple[ca.SX, ca.SX]:
    """Matrix and constant that make the next split state of (t, u)."""
    P, w, n, last = split.transition, split.width, split.base.nx, split.parts - 1
    M, constant = ca.SX(split.size, split.size), ca.SX(split.size, 1)
    for j in range(last):
        to = slice(j * w, j * w + w)
        M[slice(j * w, j * w + n), split.own] = float(P[last, j]) * ca.SX.eye(n)
        for i in range(last):
            share = float(P[i, j] - P[last, j])
            M[to, slice(i * w, i * w + w)] = share * ca.SX.eye(w)
        if split.ones:
            constant[j * w + n] = float(P[last, j])
    M[split.own, split.own] = ca.SX.eye(n)
    return sparse(M), sparse(constant)


def lean_congruence(M: ca.SX, P: ca.SX) -> ca.SX:
    """Packed ``M P M'``, the second product of each entry along the emptier of its two rows."""
    T = M @ P
    rows = [sparse(M[i, :].T) for i in range(M.shape[0])]
    entries = []
    for i, j in triangle(len(rows)):
        a, b = (i, j) if rows[j].nnz() <= rows[i].nnz() else (j, i)
        entries.append(ca.mtimes(T[a, :], rows[b]))
    return column(entries)


def predict_split(split: Jumping, symbols: dict[str, ca.SX]) -> Phase:
    """The phase ``predict`` of a gain that follows the moments."""
    script, n = Script(symbols), split.base.nx
    u = symbols["u"]
    plants = bound_all(script, split.plants, "ABQc")
    now = moments_of(split, symbols, "")
    with script.titled("second moments, mode by mode"):
        moved = moved_moments(script, split, plants, now, u)
        law = next_law(split, now.law)
        noise = [
            unpack(script.let(f"plant_noise_{j}", pack(each)), n)
            for j, each in enumerate(plant_noise(split, plants, now.law))
        ]
        second, first = later_moments(split, moved, noise)
        if split.restarts and not split.ones:
            first = moved_means(split, plants, now.first, now.law)
        results = {"predicted_mode_second_moment": ca.vertcat(*second)}
        if split.means:
            results["predicted_mode_first_moment"] = ca.vertcat(*first)
        if not split.settled:
            results["predicted_mode_law"] = law
    with script.titled("every mode's step"):
        G, known = steps(split, plants, u)
        moved_state = script.let("moved_state", G @ symbols["augmented_filtered_state"] + known)
        filtered = unpack(symbols["augmented_filtered_covariance"], split.size)
        packed = script.let("moved_covariance", lean_congruence(G, filtered))
    with script.titled("mixing by the chain"):
        M, constant = mixing(split)
        state = M @ moved_state + constant
        covariance = lean_congruence(M, unpack(packed, split.size))
        covariance += pack(split_noise(split, moved, noise))
    with script.titled("prediction of the next sample"):
        results |= {"augmented_state": state, "augmented_covariance": covariance}
        results |= whole(split, state, covariance, "predicted")
        guards = [finite(state, covariance)]
        guards += [finite(column([each[0]]), each) for each in second]
        script.put(results, guards)
    return script.phase()


def moved_means(
    split: Jumping, plants: tuple[Plant, ...], means: tuple[ca.SX, ...], law: ca.SX
) -> list[ca.SX]:
    """E[x 1{mode}] one sample later, without inputs."""
    each = [plant.A @ means[i] + law[i] * plant.c for i, plant in enumerate(plants)]
    mixed = ca.SX(ca.DM(split.kernel)).T @ ca.horzcat(*each).T
    return [ca.densify(mixed[j, :].T) for j in range(split.modes)]


def whole(split: Jumping, state: ca.SX, packed: ca.SX, prefix: str) -> dict[str, ca.SX]:
    """State and covariance of x, which the split state ends with."""
    X = unpack(packed, split.size)
    return {
        f"{prefix}_state": state[split.own],
        f"{prefix}_covariance": pack(X[split.own, split.own]),
    }


def jump_filter(spec: Spec, source: str) -> Recursion:
    """Build the recursion with a gain that follows the moments."""
    split = Jumping.of(spec)
    ports = (
        *state_ports(spec),
        *innovation_ports(spec),
        *loss_ports(spec),
        *law_ports(split),
        *split_ports(split, covariances=True),
    )
    symbols = symbols_of(spec, split.base, ports)
    form = update_form(spec, noisy(split), augmented=False)
    x0, packed = prior_of(spec)
    start = split_start(split)
    start |= {f"{of}_state": x0 for of in ("predicted", "filtered")}
    start |= {f"{of}_covariance": packed for of in ("predicted", "filtered")}
    return Recursion(
        spec=spec,
        source=source,
        ports=ports,
        initial={port.name: start[port.name] for port in ports if port.name in start},
        update=_update(split, symbols, form),
        predict=predict_split(split, symbols),
        form=form,
        notes=notes_of(split),
        outcomes=loss_outcomes(spec),
    )


def noisy(split: Jumping) -> Plant:
    """A plant with the names of the rows, and whether a mode may measure without noise."""
    return replace(split.base, noise_free=any(plant.noise_free for plant in split.plants))


def notes_of(split: Jumping) -> tuple[str, ...]:
    """What the header says about modes and arrivals."""
    options, faults = split.spec.filter.options, split.faults
    notes = [f"state split by {split.parts} modes"]
    if options.detector != "none":
        notes.append(
            f"a sample that the test {options.detector} rejects is replaced by its prediction;"
            f" status LOCKED_OUT from {options.lock_out} in a row on"
        )
    elif faults.arrival == "unknown":
        law = "a Markov chain" if faults.arrival_chain else f"the rate {faults.arrival_rate:g}"
        notes.append(f"of arrivals only {law} is known")
    return tuple(notes)


def mean_noise(script: Script, split: Jumping, plants: tuple[Plant, ...], law: ca.SX) -> ca.SX:
    """sum_i pi_i R_i, its computed entries named."""
    weights = [law[i] for i in range(split.modes)]
    return script.name_entries("mean_noise", sparse(shared([p.R for p in plants], weights)))


def signal_moment(plants: tuple[Plant, ...], now: Moments, u: ca.SX) -> ca.SX:
    """Packed E[s s'] of the signal s = C x + D u; modes that measure alike are added first."""
    groups: dict[tuple[int, int], list[int]] = {}
    for i, plant in enumerate(plants):
        groups.setdefault((id(plant.C), id(plant.D)), []).append(i)
    terms = []
    for members in groups.values():
        plant = plants[members[0]]
        second = total([now.second[i] for i in members])
        if plant.D.nnz():
            first = total([now.first[i] for i in members])
            law = total([now.law[i] for i in members])
            whole_moment = ca.blockcat(second, first, first.T, law)
            terms.append(congruence(ca.horzcat(plant.C, plant.D @ u), whole_moment))
        else:
            terms.append(congruence(plant.C, second))
    return total(terms)


def _update(split: Jumping, symbols: dict[str, ca.SX], form: Form) -> Phase:
    script, u = Script(symbols), symbols["u"]
    demand_positive(script, symbols["augmented_covariance"], split.size)
    plants = bound_all(script, split.plants, "CDR")
    now = moments_of(split, symbols, "predicted_")
    noise = mean_noise(script, split, plants, now.law)
    prior = (symbols["augmented_state"], unpack(symbols["augmented_covariance"], split.size))
    L, offset = measured(split, plants, u)
    measurement = measurement_of(
        noisy(split),
        scalar=split.spec.code.scalar,
        y=symbols["y"],
        C=sparse(split.rate * L),
        offset=split.rate * offset,
        R=_with_doubt(script, split, noise, lambda: signal_moment(plants, now, u)),
    )
    found = condition(script, prior, measurement, form=form)
    demand_finite(script, found.mean)
    state, covariance, results = found.mean, found.covariance, {}
    if split.spec.filter.options.detector != "none":
        test = LossTest(script, symbols, split.spec)
        verdict = test.verdict(found, measurement, noise)
        state, covariance = _kept(script, split, symbols, (found, verdict, test), now)
        results = verdict.results
    results |= {
        "augmented_filtered_state": state,
        "augmented_filtered_covariance": covariance,
        **whole(split, state, covariance, "filtered"),
        **innovation_results(found),
        **carried(split, symbols),
    }
    with script.titled("results of the update"):
        script.put(results)
    return script.phase()


def _with_doubt(script: Script, split: Jumping, noise: ca.SX, moment: Callable[[], ca.SX]) -> ca.SX:
    """R, and p (1 - p) E[s s'] where nobody knows whether y holds the signal s: Nahi 1969."""
    doubt = split.rate * (1.0 - split.rate)
    if not doubt:
        return noise
    p = split.base.ny
    signal = unpack(script.let("signal_moment", moment()), p)
    return script.name_entries("noise_and_doubt", sparse(noise + doubt * signal))


def _kept(
    script: Script,
    split: Jumping,
    symbols: dict[str, ca.SX],
    judged: tuple[Conditioned, Verdict, LossTest],
    now: Moments,
) -> tuple[ca.SX, ca.SX]:
    """The corrected estimate, its prediction if the sample was rejected, or a new start."""
    found, verdict, test = judged
    state = script.local("kept_state", split.size)
    covariance = script.local("kept_covariance", found.covariance.numel())
    names = ("kept_state", "kept_covariance")
    prior = symbols["augmented_state"], symbols["augmented_covariance"]
    with script.titled("a rejected sample is replaced by its prediction"):
        script.put(dict(zip(names, (found.mean, found.covariance), strict=True)))
        with script.when(None, verdict.excess):
            script.put(dict(zip(names, prior, strict=True)))
    if split.restarts:
        with script.titled("after too many rejections in a row: a new start"):
            locked = ca.fmin(test.locked(verdict.rejections), verdict.excess)
            with script.when(None, locked):
                script.put(dict(zip(names, unconditional(split, now), strict=True)))
    return state, covariance


def innovation_results(found: Conditioned) -> dict[str, ca.SX]:
    """The ports about the innovation."""
    return {
        "innovation": found.innovation,
        "innovation_covariance": found.innovation_covariance,
        "nis": found.nis,
        "log_likelihood": found.log_likelihood,
    }


def carried(split: Jumping, symbols: dict[str, ca.SX]) -> dict[str, ca.SX]:
    """What y[k] does not change: unconditional moments."""
    names = [name for name in ("mode_second_moment", "mode_first_moment") if name in symbols]
    return {name: symbols[f"predicted_{name}"] for name in names} | {"mode_law": split.law(symbols)}
