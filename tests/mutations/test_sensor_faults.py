"""Named mistakes that the paper invites: every one of them is refused before C is generated.

Where the closed forms cannot see a mistake on an ordinary record, another comparison here does.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from mutants import proved, read_instead, recursion, refusals, rewritten, started
from plants import random_model
from sensor_specs import DENSE, MATCHED, centred, chain, plane, product, sensed

from fkgen.estimators.gaussian.estimate import propagate
from fkgen.estimators.models import merge, modes, one_step, switching, weights
from fkgen.faults import SensorFaults
from fkgen.symbolic.interpreter import Interpreter
from fkgen.symbolic.linalg import unpack, weighted_sum

SHARE = [[0.8, 0.2], [0.8, 0.2]]
ANY = chain(DENSE, [0.4, 0.1, 0.2, 0.3])
KNOWN = chain(DENSE, [0.0, 1.0, 0.0, 0.0])
SURE = chain(np.eye(4), [1.0, 0.0, 0.0, 0.0])
LUMPABLE = product([[0.8, 0.2], [0.3, 0.7]], SHARE, initial=(0.6, 0.8))

TEXTBOOK = "matrix filters"
BAYES = "exact Bayes"


def scalar(law, which):
    return sensed(centred(random_model(81, 2, 1)), law, family=which)


@pytest.mark.parametrize(
    ("law", "which"),
    [(law, which) for law in (ANY, KNOWN, SURE, LUMPABLE) for which in MATCHED],
)
def test_what_is_not_mutated_passes(law, which):
    assert proved(recursion(scalar(law, which))).claims


# ------------------------------------------------------------------------------- one-step filter


def without_a(law):
    """H xhat_(k-1) for H A xhat_(k-1), with two rows so that sample 1 has one to look at."""
    whole = recursion(sensed(plane(), law, family="one_step"))
    return read_instead(whole, "innovation_m", "predicted_state", "filtered_state")


def test_mistake_zhat_without_a():
    assert TEXTBOOK in refusals(without_a(ANY))


def test_mistake_zhat_without_a_contradicts_bayes_rule_only_if_the_first_mode_is_known():
    assert BAYES in refusals(without_a(KNOWN))
    assert BAYES not in refusals(without_a(ANY))  # sample 0 has no A


def gaussian(nu, S):
    return -0.5 * (nu * nu / S + ca.log(2.0 * np.pi * S))


def density_with(whole, variance):
    """log N(y; yhat_j, S) with another S; ``variance(mode, symbols)``."""

    def change(name, _, symbols):
        mode = int(name[-1])
        return gaussian(symbols[f"innovation_m{mode}_0"], variance(mode, symbols))

    return rewritten(whole, "log_density_m", change)


def signal(mode):
    return 1.0 if mode < 2 else 0.0


def true_variance(plant, mode, P):
    C, R = (getattr(plant.model, m).values() for m in "CR")
    seen = signal(mode) * ca.DM(C)
    noise = float(R[0, 0]) * (plant.faults.sensor.noise_factor if mode % 2 else 1.0)
    return ca.mtimes([seen, unpack(P, 2), seen.T]) + noise


def test_the_density_that_these_mutants_change_is_the_right_one():
    plant = scalar(ANY, "one_step")
    prior = "predicted_covariance"
    whole = density_with(recursion(plant), lambda m, s: true_variance(plant, m, s[prior]))
    assert proved(whole)


def test_mistake_posterior_p_in_s():
    plant = scalar(ANY, "one_step")

    def posterior(mode, symbols):
        after = symbols.get(f"covariance_m{mode}", symbols["predicted_covariance"])
        return true_variance(plant, mode, after)

    failed = refusals(density_with(recursion(plant), posterior))
    assert BAYES in failed
    assert TEXTBOOK in failed


def test_mistake_delta_dropped_in_s():
    plant = scalar(ANY, "one_step")

    def nominal(mode, symbols):
        return true_variance(plant, mode - mode % 2, symbols["predicted_covariance"])

    assert BAYES in refusals(density_with(recursion(plant), nominal))


@pytest.mark.parametrize("which", MATCHED)
def test_mistake_nominal_noise_in_the_mode_without_signal_and_with_noise(which, monkeypatch):
    right = switching.mode_plants
    monkeypatch.setattr(
        switching, "mode_plants", lambda *a: ((p := right(*a))[0], p[1], p[2], p[2])
    )
    assert BAYES in refusals(recursion(scalar(ANY, which)))


def without_spread(w, parts, *_):
    return weighted_sum(w, [packed for _, packed in parts])


def test_mistake_missing_spread_term_in_one_step(monkeypatch):
    monkeypatch.setattr(one_step, "mixture_covariance", without_spread)
    assert BAYES in refusals(recursion(scalar(ANY, "one_step")))


@pytest.mark.parametrize("which", MATCHED)
def test_mistake_transposed_kernel(which, monkeypatch):
    def transposed(builder, kernel, *rest, **options):
        return weights.advance(builder, tuple(zip(*kernel, strict=True)), *rest, **options)

    monkeypatch.setattr(modes, "advance", transposed)
    assert TEXTBOOK in refusals(recursion(scalar(ANY, which)))
    assert BAYES in refusals(recursion(scalar(KNOWN, which)))


@pytest.mark.parametrize("which", MATCHED)
def test_mistake_mu0_propagated_before_the_first_sample(which):
    law = np.array(ANY["initial"]) @ np.array(DENSE)
    mutant = started(
        recursion(scalar(ANY, which)),
        predicted_mode_probability=tuple(law),
        predicted_log_weight=tuple(np.log(law)),
    )
    assert BAYES in refusals(mutant)


@pytest.mark.parametrize("which", MATCHED)
def test_mistake_probability_floor(which, monkeypatch):
    def floored(builder, held, logs, _, kind):
        return weights.reweigh(builder, held, logs, 1e-12, kind)

    monkeypatch.setattr(switching, "reweigh", floored)
    mutant = recursion(scalar(SURE, which))
    assert TEXTBOOK in refusals(mutant)
    # Known modes have to stay known: a floor breaks that in the first sample.
    found = Interpreter(mutant).run(np.zeros((1, 1)), np.zeros((1, 0)), {})
    assert found["mode_probability"][0, 1:].all()


def without_logarithms(builder, held, logs, _, __):
    """Bayes' rule with densities themselves."""
    probability, _ = held
    n = len(logs)
    result = weights.Weights(
        builder.local("weight", n),
        builder.local("log_weight_now", n),
        builder.local("evidence", 1, 0.0),
    )
    builder.assign({"weight": probability, "log_weight_now": held[1]})
    with builder.if_present(None):
        joint = ca.vertcat(*(probability[i] * ca.exp(logs[i]) for i in range(n)))
        total = ca.sum1(joint)
        builder.assign(
            {
                "weight": joint / total,
                "log_weight_now": ca.log(joint / total),
                "evidence": ca.log(total),
            }
        )
    return result


@pytest.mark.parametrize("which", MATCHED)
def test_mistake_no_log_sum_exp(which, monkeypatch):
    far = np.array([[1e8]])
    nothing = np.zeros((1, 0))
    plant = scalar(ANY, which)
    right = Interpreter(recursion(plant)).run(far, nothing, {})
    monkeypatch.setattr(switching, "reweigh", without_logarithms)
    mutant = recursion(plant)
    assert proved(mutant)  # ordinary records do not show it
    instance = Interpreter(mutant)
    used = instance.step(far[0], nothing[0], {})
    assert np.isfinite(right["filtered_state"]).all()
    assert right["mode_probability"].sum() == pytest.approx(1.0, abs=1e-15)
    assert not (used and np.isfinite(instance.values["mode_probability"]).all())


# --------------------------------------------------------------------------- interacting filters


def flat(name):
    """A mixer that forgets the spread of the means of one merge."""

    class Flat(merge.Mixer):
        def under(self, given, *rest):
            mean, covariance = super().under(given, *rest)
            if self.name != name:
                return mean, covariance
            parts = zip(ca.vertsplit(given), self.parts, strict=True)
            return mean, sum(w * packed for w, (_, packed) in parts)

    return Flat


@pytest.mark.parametrize("name", ["mixed", "combined"], ids=["in mixing", "in the output"])
def test_mistake_no_spread(name, monkeypatch):
    monkeypatch.setattr("fkgen.estimators.models.interacting.Mixer", flat(name))
    failed = refusals(recursion(scalar(ANY, "imm")))
    assert TEXTBOOK in failed
    assert (BAYES in failed) is (name == "combined")


def normalised_over_j(builder, kernel, now, *rest, **options):
    right = weights.advance(builder, kernel, now, *rest, **options)
    columns = zip(*kernel, strict=True)
    # p_ij mu_i / sum_j p_ij mu_i
    mixing = tuple(ca.SX(list(entries)) * now[0] / (now[0] + 1e-290) for entries in columns)
    count = len(kernel)
    return replace(right, mixing=mixing, columns=(None,) * count, group=tuple(range(count)))


def of_the_present(builder, kernel, now, *rest, **options):
    right = weights.advance(builder, kernel, now, *rest, **options)
    return replace(right, probability=now[0], logarithm=now[1])


@pytest.mark.parametrize(
    ("mistake", "law"),
    [(normalised_over_j, ANY), (of_the_present, ANY), (of_the_present, KNOWN)],
    ids=["mixing normalised over j", "mu in place of c", "mu in place of c, known start"],
)
def test_mistake_in_the_chain(mistake, law, monkeypatch):
    monkeypatch.setattr("fkgen.estimators.models.modes.advance", mistake)
    failed = refusals(recursion(scalar(law, "imm")))
    assert TEXTBOOK in failed
    assert (BAYES in failed) is (law is KNOWN)


@pytest.mark.parametrize("law", [ANY, LUMPABLE], ids=["four modes", "three modes"])
def test_mistake_m3_not_propagated(law, monkeypatch):
    right, calls = propagate, []

    def stuck(builder, plant, inputs, posterior, *tag):
        calls.append(posterior)
        moved = right(builder, plant, inputs, posterior, *tag)
        if len(calls) == len(law.get("kernel", [0] * 3)):  # the last mode before the whole
            return posterior.state, posterior.covariance, moved[2]
        return moved

    modes = 4 if law is ANY else 3
    plant = sensed(centred(random_model(82, 2, 1)), law, modes=modes)
    assert proved(recursion(plant))
    monkeypatch.setattr("fkgen.estimators.models.interacting.propagate", stuck)
    assert TEXTBOOK in refusals(recursion(plant))


@pytest.mark.parametrize("shares", [(1.0, 0.0), (0.0, 1.0)], ids=["N(z; 0, R)", "N(z; 0, R C)"])
def test_mistake_one_gaussian_for_m3(shares, monkeypatch):
    plant = sensed(centred(random_model(83, 2, 1)), LUMPABLE, modes=3)
    assert proved(recursion(plant))
    right = SensorFaults.lumped

    def one(faults):
        found = right(faults)
        return replace(found, shares=(*found.shares[:2], shares))

    monkeypatch.setattr(SensorFaults, "lumped", one)
    failed = refusals(recursion(plant))
    assert TEXTBOOK in failed
    assert BAYES in failed  # the law can be lumped: three modes have to be as good as four
