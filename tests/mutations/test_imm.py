"""Mistakes that modes of the plant invite in imm: every one is refused before C is generated."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from imm_plants import PLANTS, plant
from mutants import proved, recursion, refusals

from fkgen.estimators.gaussian.actuation import certain
from fkgen.estimators.gaussian.estimate import Posterior, propagate
from fkgen.estimators.models import interacting, merge, modes, switching

TEXTBOOK = "matrix filters"
BAYES = "exact Bayes"
KNOWN = {"initial": np.eye(3)[1]}


@pytest.mark.parametrize("name", list(PLANTS))
def test_what_is_not_mutated_passes(name):
    assert len(proved(recursion(plant(name))).claims) == 3


def moved_before_mixing(builder, filtering, modes, law):
    """The step from x[k] to x[k+1] is that of mode k."""
    symbols, motions = filtering.symbols, modes.motions
    parts = filtering.filtered()
    left = []
    for i, (part, each) in enumerate(zip(parts, motions, strict=True)):
        inputs, own = certain(symbols["u"]), Posterior(*part)
        state, packed, _ = propagate(builder, each, inputs, own, f"_{i}")
        left.append((builder.define(f"left_{i}", state), builder.define(f"left_P_{i}", packed)))
    mixer = merge.Mixer(builder, "mixed", left, "double")
    mixed = [
        mixer.under(weights, f"_{at}", column)
        for at, (weights, column) in enumerate(zip(law.mixing, law.columns, strict=True))
    ]
    return mixed, list(law.group)


def test_mistake_the_mode_before_moves_the_state(monkeypatch):
    monkeypatch.setattr(interacting, "_moved", moved_before_mixing)
    assert TEXTBOOK in refusals(recursion(plant("dynamics")))
    failed = refusals(recursion(plant("dynamics", **KNOWN)))
    assert BAYES in failed
    assert TEXTBOOK in failed


def test_mistake_modes_move_as_their_neighbours(monkeypatch):
    right = modes.Modes.motions.fget
    turned = property(lambda each: (*right(each)[1:], right(each)[0]))
    monkeypatch.setattr(modes.Modes, "motions", turned)
    assert BAYES in refusals(recursion(plant("dynamics", **KNOWN)))


@pytest.mark.parametrize("name", ["dynamics", "process noise"])
def test_mistake_combined_prediction_weighted_with_the_mode_of_the_present(name, monkeypatch):
    right = interacting._combined

    def present(builder, filtering, motions, moved, _):
        return right(builder, filtering, motions, moved, filtering.symbols["mode_probability"])

    monkeypatch.setattr(interacting, "_combined", present)
    assert TEXTBOOK in refusals(recursion(plant(name)))


@pytest.mark.parametrize("where", ["mixed", "predicted", "combined"])
def test_mistake_no_spread_of_the_means(where, monkeypatch):
    class Flat(merge.Mixer):
        def under(self, given, *rest):
            mean, covariance = super().under(given, *rest)
            if self.name != where:
                return mean, covariance
            parts = zip(ca.vertsplit(given), self.parts, strict=True)
            return mean, sum(w * packed for w, (_, packed) in parts)

    monkeypatch.setattr(interacting, "Mixer", Flat)
    assert TEXTBOOK in refusals(recursion(plant("dynamics")))


def test_mistake_process_noise_of_the_first_mode_for_all(monkeypatch):
    monkeypatch.setattr(interacting, "mean_noise", lambda motions, _: motions[0].Q)
    assert TEXTBOOK in refusals(recursion(plant("process noise")))


@pytest.mark.parametrize(("letter", "name"), [("c", "offsets"), ("B", "inputs")])
def test_mistake_modes_taken_for_equal_that_differ(letter, name, monkeypatch):
    right = modes._identity
    monkeypatch.setattr(
        modes, "_identity", lambda each, letters: right(each, letters.replace(letter, ""))
    )
    failed = refusals(recursion(plant(name, **KNOWN)))
    assert BAYES in failed
    assert TEXTBOOK in failed


def test_mistake_offsets_forgotten(monkeypatch):
    def without(builder, each, *others):
        return propagate(builder, replace(each, c=0 * each.c), *others)

    monkeypatch.setattr(interacting, "propagate", without)
    assert BAYES in refusals(recursion(plant("offsets", **KNOWN)))


@pytest.mark.parametrize("letter", ["C", "D", "R"])
def test_mistake_every_mode_measures_as_the_first(letter, monkeypatch):
    right = switching.mode_plants

    def same(*given):
        plants = right(*given)
        first = getattr(plants[0], letter)
        return tuple(replace(each, **{letter: first}) for each in plants)

    monkeypatch.setattr(switching, "mode_plants", same)
    failed = refusals(recursion(plant("everything")))
    assert BAYES in failed
    assert TEXTBOOK in failed
