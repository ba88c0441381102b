"""Mistakes in the partial compression filter, by name: each is refused by its proof."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from mutants import proved, recursion, refusals, rewritten
from partial_plants import cpcf, dense, expected, record
from plants import distance, interpreted

from fkgen.estimators.gaussian.rank import thresholds
from fkgen.estimators.lmmse.kalman import by_rows, from_rows
from fkgen.estimators.windows import partial, window
from fkgen.estimators.windows.partial import Compressed, partial_state
from fkgen.symbolic.linalg import pack
from fkgen.symbolic.plant import plant_of

MOMENTS = "errors that are written out in the primitive noises"
OFF = "the rows contradict the host"
HOST = "the Kalman filter of its own rows"
CARE = pytest.mark.parametrize("maintenance", ["optimal", "paper"])


def plant(maintenance="optimal", m=1):
    """F11 is not 1, F is not symmetric, G has n rows, rows of the host come at every sample."""
    model, _, host = dense(21, 3, m, 1)
    return cpcf(model, host=host, window=3, maintenance=maintenance)


class Blocks:
    """F11, F12 e^2 = M e, T1 Q and the a posteriori moments, of the prediction of a recursion."""

    def __init__(self, whole):
        spec, symbols = whole.spec, whole.predict.symbols
        given, n = plant_of(spec), spec.model.nx
        partial = partial_state(spec, given)
        self.A, self.T1 = given.A, partial.T1
        self.F11 = partial.advance(given)
        self.M = partial.T1 @ given.A - self.F11 @ partial.T1
        self.noise = partial.T1 @ given.Q
        self.S = from_rows(symbols["compressed_cross_covariance"], len(spec.faults.soft.compressed))
        P = symbols["filtered_covariance"]
        index = [[max(i, j) * (max(i, j) + 1) // 2 + min(i, j) for j in range(n)] for i in range(n)]
        self.P = ca.vertcat(*[ca.horzcat(*[P[k] for k in row]) for row in index])

    def cross(self):
        """S of (43), as it should be."""
        return (self.F11 @ self.S - self.M @ self.P) @ self.A.T - self.noise


def mutated_cross(wrong):
    """The recursion whose prediction of S is another one."""

    def mutate(spec):
        whole = recursion(spec)
        blocks = Blocks(whole)
        name = "predicted_compressed_cross_covariance"
        return rewritten(whole, name, lambda *_: by_rows(wrong(blocks)), phase="predict")

    return mutate


def mutated_noise(added):
    """The recursion whose prediction of R has something added."""

    def mutate(spec):
        whole = recursion(spec)
        more = pack(added(Blocks(whole)))
        name = "predicted_compressed_noise"
        return rewritten(whole, name, lambda _, value, __: value + more, phase="predict")

    return mutate


def symmetric(matrix):
    return matrix + matrix.T


PREDICTIONS = {
    # Erratum 18: the cross terms of R without F11.
    "R without F11 in the cross terms": mutated_noise(
        lambda b: symmetric(b.F11 @ b.S @ b.M.T - b.S @ b.M.T)
    ),
    "R with cross terms of the other sign": mutated_noise(
        lambda b: 2 * symmetric(b.F11 @ b.S @ b.M.T)
    ),
    "R without process noise": mutated_noise(lambda b: -(b.noise @ b.T1.T)),
    "R without the part of e2": mutated_noise(lambda b: -(b.M @ b.P @ b.M.T)),
    # Erratum 19.
    "S with F not transposed": mutated_cross(lambda b: (b.F11 @ b.S - b.M @ b.P) @ b.A - b.noise),
    # Erratum 20: a 1 x 1 term that NumPy would broadcast.
    "S with G1 q G1'": mutated_cross(
        lambda b: b.cross() + b.noise - ca.repmat(b.noise @ b.T1.T, 1, b.A.shape[0])
    ),
    "S without process noise": mutated_cross(lambda b: b.cross() + b.noise),
    "S with the noise of the other sign": mutated_cross(lambda b: b.cross() + 2 * b.noise),
    "S without F11": mutated_cross(lambda b: (b.S - b.M @ b.P) @ b.A.T - b.noise),
    "S with P of the other sign": mutated_cross(
        lambda b: (b.F11 @ b.S + b.M @ b.P) @ b.A.T - b.noise
    ),
    "S not moved at all": mutated_cross(lambda b: b.S),
}


@CARE
@pytest.mark.parametrize("m", [1, 2])
def test_what_is_not_mutated_passes(m, maintenance):
    assert len(proved(recursion(plant(maintenance, m))).claims) == 4
    right = mutated_cross(Blocks.cross)(plant(maintenance, m))
    assert len(proved(right).claims) == 4


@CARE
@pytest.mark.parametrize("mistake", PREDICTIONS)
def test_mistake_in_the_propagation(mistake, maintenance):
    assert MOMENTS in refusals(PREDICTIONS[mistake](plant(maintenance)))


@CARE
def test_mistake_z_not_propagated(maintenance):
    name = "predicted_compressed_measurement"
    whole = recursion(plant(maintenance))
    mutant = rewritten(whole, name, lambda _, __, s: s["compressed_measurement"], phase="predict")
    assert MOMENTS in refusals(mutant)


# --------------------------------------------------------------------------------- maintenance


def changed_host(monkeypatch, change):
    right = partial._by_host

    def by_host(script, given, y, known):
        found, carried = right(script, given, y, known)
        return found, change(carried, known[1])

    monkeypatch.setattr(partial, "_by_host", by_host)


MAINTENANCE = {
    "no Z maintenance": lambda now, before: replace(now, measurement=before.measurement),
    "no S maintenance": lambda now, before: replace(now, cross=before.cross),
    "no maintenance": lambda _, before: before,
    "Z maintenance with the other sign": lambda now, before: replace(
        now, measurement=2 * before.measurement - now.measurement
    ),
}


@CARE
@pytest.mark.parametrize("mistake", MAINTENANCE)
def test_mistake_in_the_maintenance(mistake, maintenance, monkeypatch):
    changed_host(monkeypatch, MAINTENANCE[mistake])
    assert MOMENTS in refusals(recursion(plant(maintenance)))


def test_mistake_one_maintenance_for_the_other():
    for said, done in (("optimal", "paper"), ("paper", "optimal")):
        mutant = replace(recursion(plant(done)), spec=plant(said))
        assert MOMENTS in refusals(mutant)


def test_mistake_optimal_z_with_the_noise_of_the_paper(monkeypatch):
    changed_host(monkeypatch, lambda now, before: replace(now, noise=before.noise))
    assert MOMENTS in refusals(recursion(plant("optimal")))


# --------------------------------------------------------------------------------- compression


def a_priori(value, symbols):
    """The same with the prediction of the host in place of its corrected state."""
    mean, predicted = symbols["mean"], symbols["predicted_state"]
    before = ca.vertcat(predicted, mean[predicted.numel() :])
    return ca.substitute(value, mean, before)


@CARE
@pytest.mark.parametrize("where", ["innovation_compressed", "new_compressed_measurement"])
def test_mistake_z_formed_from_the_prediction(where, maintenance):
    whole = recursion(plant(maintenance))
    mutant = rewritten(whole, where, lambda _, value, symbols: a_priori(value, symbols))
    assert MOMENTS in refusals(mutant)


@CARE
def test_mistake_weights_exchanged(maintenance):
    whole = recursion(plant(maintenance))
    mutant = rewritten(whole, "update_gain_compressed", lambda _, value, __: 1 - value)
    assert MOMENTS in refusals(mutant)


@CARE
def test_mistake_s_not_compressed(maintenance, monkeypatch):
    right = partial.condition

    def without_gain(*args, **options):
        found = right(*args, **options)
        return found if found.gain is None else replace(found, gain=0 * found.gain)

    monkeypatch.setattr(partial, "condition", without_gain)
    assert MOMENTS in refusals(recursion(plant(maintenance)))


def test_mistake_a_start_that_remembers_s(monkeypatch):
    right = partial._first

    def remembering(script, partial, measurement):
        found = right(script, partial, measurement)
        return replace(found, cross=found.cross + 0.1)

    monkeypatch.setattr(partial, "_first", remembering)
    assert MOMENTS in refusals(recursion(plant()))


def test_mistake_a_silent_start_with_the_other_sign(monkeypatch):
    """Seen where the rows of a group begin one by one, which the records of a proof need not do."""
    right, spec = partial._silent, plant(m=2)
    y, u, params = record(spec, 4, missing=0.0)
    y[0, spec.faults.soft.compressed[1]] = np.nan

    def error():
        found = interpreted(spec, y, u, params)["filtered_covariance"]
        return distance(found, expected(spec, y, u, params)["filtered_covariance"])

    assert error() < 1e-12

    def wrong(partial, covariance):
        found = right(partial, covariance)
        return replace(found, cross=-found.cross)

    monkeypatch.setattr(partial, "_silent", wrong)
    assert error() > 1e-6


# -------------------------------------------------------------------------------- similarity


@pytest.mark.parametrize("what", ["first", "rest"])
def test_mistake_another_complement_of_the_measured_states(what, monkeypatch):
    right = partial.partial_state
    assert right is partial_state

    def wrong(*args):
        found = right(*args)
        return replace(found, **{what: getattr(found, what) * 1.01})

    monkeypatch.setattr(partial, "partial_state", wrong)
    assert MOMENTS in refusals(recursion(plant()))


def test_mistake_phi_forgotten(monkeypatch):
    model, parameters, host = dense(22, 3, 1, 1, varying=True)
    spec = cpcf(model, host=host, window=3, parameters=parameters)
    assert proved(recursion(spec))
    right = partial.partial_state

    def wrong(*args):
        return replace(right(*args), phi=ca.SX.eye(1))

    monkeypatch.setattr(partial, "partial_state", wrong)
    assert MOMENTS in refusals(recursion(spec))


# ------------------------------------------------------------------------------ end of a window


def test_mistake_in_the_gain_without_s(monkeypatch):
    """(47) with P H' alone: Z taken for a measurement with uncorrelated noise."""
    right = Compressed.joint

    def uncorrelated(self, covariance):
        return right(replace(self, cross=0 * self.cross), covariance)

    closing = partial._taken_over

    def wrong(script, given):
        with monkeypatch.context() as patch:
            patch.setattr(Compressed, "joint", uncorrelated)
            return closing(script, given)

    monkeypatch.setattr(partial, "_taken_over", wrong)
    text = refusals(recursion(plant()))
    assert MOMENTS in text
    assert OFF in text


def test_mistake_z_of_the_other_sign_at_the_end():
    whole = recursion(plant())
    mutant = rewritten(whole, "mean_taken", lambda _, value, __: -value, phase="closing")
    assert MOMENTS in refusals(mutant)


def test_mistake_a_compressed_measurement_used_twice():
    """Not discarded at the end of its window."""
    whole = recursion(plant())
    kept = rewritten(whole, "collecting", lambda *_: ca.SX(1), phase="closing")
    assert MOMENTS in refusals(kept)


def test_mistake_a_rejected_measurement_used_all_the_same():
    whole = recursion(plant())
    mutant = rewritten(whole, "accepted", lambda *_: ca.SX(1), phase="closing")
    assert OFF in refusals(mutant)


@pytest.mark.parametrize("shift", [-1, 1])
def test_mistake_windows_of_another_length(shift, monkeypatch):
    right = window.count_down

    def wrong(script, symbols, soft):
        return right(script, symbols, replace(soft, window=soft.window + shift))

    monkeypatch.setattr(window, "count_down", wrong)
    spec = plant()
    spec = replace(spec, faults=replace(spec.faults, soft=replace(spec.faults.soft, window=2)))
    assert MOMENTS in refusals(recursion(spec))


def test_mistake_the_threshold_of_another_probability(monkeypatch):
    def wrong(false_alarm, n):
        return [1e9 * value for value in thresholds(false_alarm, n)]

    monkeypatch.setattr(partial, "thresholds", wrong)
    assert OFF in refusals(recursion(plant()))


@pytest.mark.parametrize("letter", ["A", "C", "Q", "R", "P0"])
def test_an_error_of_a_thousandth_in_the_plant_is_refused(letter):
    right = plant()
    given = right.to_dict()
    given["model"][letter] = (1.001 * getattr(right.model, letter).values()).tolist()
    mutant = replace(recursion(type(right).from_dict(given)), spec=right)
    assert refusals(mutant)


def test_a_noise_of_the_compressed_measurement_scaled_by_a_thousandth_is_refused():
    whole = recursion(plant())
    mutant = rewritten(whole, "compressed_noise", lambda _, value, __: 1.001 * value)
    assert MOMENTS in refusals(mutant)
