"""The LMMSE filter of a jumping plant, with a gain that follows the moments.

Costa 1994; Costa, Fragoso & Marques 2005, sec. 5.4; Nahi 1969 for arrivals of which only the rate
is known; Sun & Zhao & Yin for samples that a test rejects.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import casadi as ca

from fkgen.spec import Spec
from fkgen.symbolic.conditioning import Conditioned, condition
from fkgen.symbolic.estimate import (
    bound_all,
    demand_finite,
    demand_positive,
    measurement_of,
    update_form,
)
from fkgen.symbolic.jump_moments import Moments, moments_of, shared, total, unconditional
from fkgen.symbolic.jump_prediction import predict_split, whole
from fkgen.symbolic.jumping import Jumping, law_ports, measured, split_ports, split_start
from fkgen.symbolic.linalg import congruence, sparse, unpack
from fkgen.symbolic.loss_tests import LossTest, Verdict, loss_outcomes, loss_ports
from fkgen.symbolic.plant import Plant
from fkgen.symbolic.ports import innovation_ports, prior_of, state_ports, symbols_of
from fkgen.symbolic.recursion import Phase, Recursion
from fkgen.symbolic.script import Script
from fkgen.symbolic.sequential import Form


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
        notes=(f"covariance update: {form} form", *notes_of(split)),
        outcomes=loss_outcomes(spec),
    )


def noisy(split: Jumping) -> Plant:
    """A plant with the names of the rows, and whether a mode may measure without noise."""
    return replace(split.base, noise_free=any(plant.noise_free for plant in split.plants))


def notes_of(split: Jumping) -> tuple[str, ...]:
    """What the header says about modes and arrivals."""
    options, faults = split.spec.filter, split.faults
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
    if split.spec.filter.detector != "none":
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
