"""Mistakes that are made with filters by hand, each refused before any C is written."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import pytest
from mutants import proved, recursion, refusals
from nonlinear_specs import spec_of

from fkgen.estimators.gaussian import estimate
from fkgen.estimators.lmmse import kalman
from fkgen.estimators.nonlinear import iterated, unscented
from fkgen.estimators.nonlinear.unscented import Points
from fkgen.symbolic import plant as plants
from fkgen.symbolic.lifting.linearise import moved_from, seen_from

FAMILIES = ("ekf", "iekf", "ukf")
DERIVED = ("ekf", "iekf")


def lifted_as(monkeypatch, change):
    """Every plant with something else in place of what was derived."""
    original = plants.lift_equations

    def lift(*given):
        return change(original(*given))

    monkeypatch.setattr(plants, "lift_equations", lift)


def both(monkeypatch, name, changed):
    for module in (kalman, iterated, unscented):
        if hasattr(module, name):
            monkeypatch.setattr(module, name, changed)


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("case", ["polynomial", "circle", "pendulum", "attitude"])
def test_without_a_mistake_it_is_proved(family, case):
    assert proved(recursion(spec_of(case, family))).claims


@pytest.mark.parametrize("family", DERIVED)
@pytest.mark.parametrize("letter", ["A", "C"])
def test_a_transposed_jacobian_is_caught(family, letter, monkeypatch):
    lifted_as(monkeypatch, lambda each: replace(each, **{letter: getattr(each, letter).T}))
    assert refusals(recursion(spec_of("polynomial", family)))


@pytest.mark.parametrize("family", DERIVED)
def test_f_linearised_at_the_prediction_is_caught(family, monkeypatch):
    def moved(builder, each, _, u, *tag):
        return moved_from(builder, each, [builder.symbol("predicted_state")], u, *tag)

    both(monkeypatch, "moved_from", moved)
    assert refusals(recursion(spec_of("polynomial", family)))


@pytest.mark.parametrize("family", DERIVED)
def test_h_linearised_beside_the_prediction_is_caught(family, monkeypatch):
    def seen(builder, each, states, u, *tag):
        (right,) = seen_from(builder, each, states, u, *tag)
        (wrong,) = seen_from(builder, each, [1.01 * states[0]], u, "_wrong")
        return (replace(right, C=wrong.C),)

    both(monkeypatch, "seen_from", seen)
    assert refusals(recursion(spec_of("polynomial", family)))


@pytest.mark.parametrize("family", DERIVED)
def test_g_at_the_prediction_is_caught(family, monkeypatch):
    def moved(builder, each, states, u, *tag):
        (right,) = moved_from(builder, each, states, u, *tag)
        wrong = moved_from(builder, each, [builder.symbol("predicted_state")], u, "_wrong")
        return (replace(right, spread=wrong[0].spread),)

    both(monkeypatch, "moved_from", moved)
    assert refusals(recursion(spec_of("polynomial", family)))


@pytest.mark.parametrize("family", FAMILIES)
def test_an_innovation_that_is_not_wrapped_is_caught(family, monkeypatch):
    lifted_as(monkeypatch, lambda each: replace(each, wraps=()))
    assert refusals(recursion(spec_of("circle", family)))


def test_points_of_an_angle_that_are_not_wrapped_are_caught(monkeypatch):
    """Where f turns by a half on the way the points come out on both sides of the cut."""
    lifted_as(monkeypatch, lambda each: replace(each, angles=()))
    cut = {"f": {"phi": "atan2(sin(phi + w), cos(phi + w))", "psi": "psi", "l": "l + v"}}
    assert refusals(recursion(spec_of("circle", "ukf", model=cut)))


@pytest.mark.parametrize("family", FAMILIES)
def test_a_covariance_that_keeps_the_axes_of_before_is_caught(family, monkeypatch):
    for module in (estimate, iterated, unscented):
        monkeypatch.setattr(module, "turned_by", lambda _, errors: ca.SX.eye(errors.numel()))
    assert refusals(recursion(spec_of("attitude", family)))


@pytest.mark.parametrize("change", ["always", "never", "the prior counts too much"])
def test_steps_of_iekf_that_are_taken_wrongly_are_caught(change, monkeypatch):
    square = iterated.Search._square
    factor = {"always": 0.0, "never": 1e9, "the prior counts too much": 1.0}[change]
    if change == "the prior counts too much":
        monkeypatch.setattr(iterated, "total", lambda each: 1e3 * sum(each))
        monkeypatch.setattr(iterated.Search, "_square", _sum)
    else:
        first = []

        def changed(self, rows):
            first.append(rows)
            return square(self, rows) * (1.0 if len(first) % 3 == 1 else factor)

        monkeypatch.setattr(iterated.Search, "_square", changed)
    far = {
        "R": [[1e-4, 0.0], [0.0, 1e-4]],
        "P0": [[0.5, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 2.0]],
    }
    assert refusals(recursion(spec_of("circle", "iekf", model=far, iterations=2)))


def _sum(search, rows):
    weights = zip(ca.vertsplit(rows), search.independent.inverses, strict=True)
    return sum(r * r * w for r, w in weights)


@pytest.mark.parametrize("change", ["spread", "centre", "rows"])
def test_points_in_wrong_places_are_caught(change, monkeypatch):
    of = Points.of

    def changed(builder, root, kappa):
        if change == "spread":  # that of N points in place of N + kappa
            points = of(builder, root, 0.0)
            return Points(points.columns, kappa)
        if change == "centre":
            points = of(builder, root, kappa)
            return Points(points.columns, 0.0)
        return of(builder, root.T, kappa)

    monkeypatch.setattr(Points, "of", changed)
    assert refusals(recursion(spec_of("circle", "ukf", kappa=1.5)))
