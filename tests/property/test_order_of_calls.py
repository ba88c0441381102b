"""Updates, predictions, steps and refused calls in any order, against the oracle of every family.

What several updates of one sample take is one row of a record for the oracle, and a sample without
an update is a row that is missing. Oracles know neither calls nor an instance.
"""

from __future__ import annotations

import copy
import pickle
from dataclasses import dataclass
from functools import cache

import numpy as np
import partial_plants
import pytest
import random_equations
import sensor_specs
import soft_plants
import spread
from imm_plants import ALIKE, any_modes, jumping
from jump_plants import EXAMPLE_A, EXAMPLE_S, random_table, spec_of
from plants import PARAMETERS, VARYING, built, independent, random_model, spec
from scipy.stats import chi2
from toolchain import needs_compiler

from fkgen.errors import StepRefused
from fkgen.families import family
from fkgen.oracle.claims.claim import Record
from fkgen.oracle.plants.equations import system_of
from fkgen.oracle.textbook.nonlinear import Extended

pytestmark = needs_compiler()

T = 9
#: Two double computations: roundings of 1e-16 that exponents of some ten multiply.
TOLERANCE = 1e-10

#: Rows 0 and 2 have noises of their own; those of 1 and 3 are correlated.
FOUR = random_model(301, 3, 4, 1, direct=True)
FOUR["R"][1][3] = FOUR["R"][3][1] = 0.1
DIAGONAL = random_model(302, 2, 3, 1, direct=True)
UNDRIVEN = random_model(303, 3, 3, 1)  # y says nothing of the input
STAGES = ("filtered", "predicted")
GATE = 0.9
#: Random plants by equations: a second update of a sample linearises anew, so it is no part of one.
BY_EQUATIONS = ("ekf_attitude", "mkf", "mkf_attitude", "mme_attitude", "mme_sensed", "imm_jump")
BY_EQUATIONS += ("imm_attitude", "imm_three", "one_step_attitude", "genie_attitude")
LAW = sensor_specs.PROBLEMS["4"] | {"rows": [0, 1]}


def hand_made(table, y, u, params):
    """The Kalman filter of matrices at once, with missing rows cut out: what a textbook says."""
    numbers = {name: [] for name in ("filtered", "predicted")}
    ll, nis = np.zeros(len(y)), np.zeros(len(y))
    A, B, C, D, Q, R, x, P = (np.asarray(table[key]) for key in (*"ABCDQR", "x0", "P0"))
    for k, row in enumerate(y):
        here = np.isfinite(row)
        if here.any():
            H, e = C[here], (row - C @ x - D @ u[k])[here]
            S = H @ P @ H.T + R[np.ix_(here, here)]
            K = np.linalg.solve(S, H @ P).T
            x, P = x + K @ e, P - K @ S @ K.T
            nis[k] = e @ np.linalg.solve(S, e)
            ll[k] = -0.5 * (nis[k] + np.linalg.slogdet(2.0 * np.pi * S)[1])
        numbers["filtered"].append((x, P))
        x, P = A @ x + B @ u[k], A @ P @ A.T + Q
        numbers["predicted"].append((x, P))
    return {"log_likelihood": ll, "nis": nis} | stacked(numbers)


def hand_gated(table, y, u):
    """The Kalman filter row by row, R diagonal; a row outside of 90 % of its law is left out."""
    A, B, C, D, Q, R, x, P = (np.asarray(table[key]) for key in (*"ABCDQR", "x0", "P0"))
    limit, found = chi2.ppf(GATE, 1), {"rejected": np.zeros(y.shape, bool)}
    ll, nis = np.zeros(len(y)), np.zeros(len(y))
    numbers = {name: [] for name in STAGES}
    for k, i in np.ndindex(y.shape):
        s, e = C[i] @ P @ C[i] + R[i, i], y[k, i] - C[i] @ x - D[i] @ u[k]
        found["rejected"][k, i] = e * e > limit * s
        if e * e <= limit * s:
            x, P = x + P @ C[i] * e / s, P - np.outer(P @ C[i], P @ C[i]) / s
            nis[k] += e * e / s
            ll[k] -= 0.5 * (e * e / s + np.log(2.0 * np.pi * s))
        if i == y.shape[1] - 1:
            numbers["filtered"].append((x, P))
            x, P = A @ x + B @ u[k], A @ P @ A.T + Q
            numbers["predicted"].append((x, P))
    return found | {"log_likelihood": ll, "nis": nis} | stacked(numbers)


def stacked(numbers):
    """Ports from pairs of means and covariances."""
    return {
        f"{of}_{name}": np.array(values)
        for of, pairs in numbers.items()
        for name, values in zip(("state", "covariance"), zip(*pairs, strict=True), strict=True)
    }


#: Covariances that are carried as U D U'.
FACTORED = {"update": "ud"}


@cache
def plants():
    """Specs by name."""
    modes = any_modes(3, 2, 2, 1, letters="ABCDQRc")
    for mode in modes[1:]:
        mode["R"] = np.diag(np.diag(mode["R"]))
    jumps = random_model(304, 2, 2, 1, direct=True)
    bank = {"actuator": {"dependence": "common"}, "hypotheses": [0.2, 0.5, 0.9]}
    return {
        "kf": spec(FOUR, family="kf"),
        "kf_joseph": spec(FOUR, family="kf", code={"update": "joseph"}),
        "kf_ud": spec(FOUR, family="kf", code=FACTORED),
        "kf_gated": spec(DIAGONAL, family="kf", gate=GATE),
        "kf_functions": spec(VARYING, family="kf", parameters=PARAMETERS),
        "mkf": spec(UNDRIVEN, family="mkf", actuator={"success_rate": 0.7}),
        "mkf_sensed": spec(spread.TWO_ALONE, family="mkf", actuator=independent([0.7, 0.4])),
        "mkf_ud": spec(
            spread.TWO_ALONE, family="mkf", actuator=independent([0.7, 0.4]), code=FACTORED
        ),
        "mme": spec(UNDRIVEN, family="mme", weight_floor=1e-3, **bank),
        "mme_ud": spec(UNDRIVEN, family="mme", weight_floor=1e-3, code=FACTORED, **bank),
        "mme_no_floor": spec(UNDRIVEN, family="mme", weight_floor=0.0, **bank),
        "mme_sensed": spec(spread.TWO_ALONE, family="mme", **bank),
        "genie": sensor_specs.sensed(FOUR, {"rows": [0, 1]}, family="genie"),
        "imm": sensor_specs.sensed(DIAGONAL, LAW, family="imm"),
        "imm_ud": sensor_specs.sensed(DIAGONAL, LAW, family="imm", code=FACTORED),
        "imm_jump": jumping(jumps, modes, transition=ALIKE),
        "imm_lumped": sensor_specs.sensed(
            DIAGONAL, sensor_specs.PROBLEMS["3"] | {"rows": [0, 1]}, family="imm", modes=3
        ),
        "one_step": sensor_specs.sensed(DIAGONAL, LAW, family="one_step"),
        "one_step_paper": sensor_specs.sensed(DIAGONAL, LAW, family="one_step", covariance="paper"),
        "linear_optimal": sensor_specs.sensed(
            DIAGONAL, sensor_specs.PROBLEMS["1"], family="linear_optimal"
        ),
        "augmented": sensor_specs.every()["augmented"],
        "mjls_lmmse": spec_of(random_table(7, 3, 2, 2, q=1, offsets=True)),
        "mjls_tested": spec_of(EXAMPLE_A, arrival_rate=0.6, detector="energy", window=3),
        "mjls_stationary": spec_of(EXAMPLE_S, gain="stationary"),
        "dfcf": soft_plants.soft(spread.TWO_ALONE, host=[1], window=2),
        "dfcf_groups": soft_plants.soft(
            spread.THREE_ALONE, window=3, groups=[[2], [1]], reacquire=2
        ),
        "compression_full": soft_plants.soft(
            spread.TWO, family="compression_full", host=[], window=3
        ),
        "cpcf": soft_plants.soft(spread.TWO_ALONE, family="cpcf", host=[1], window=2),
    } | {f"nonlinear_{case}": random_equations.spec(case) for case in BY_EQUATIONS}


#: Plants that take several updates of one sample; the others refuse the second one.
TAKES = {"kf", "kf_joseph", "kf_functions", "mkf", "mme", "mme_no_floor", "genie", "imm"}
TAKES |= {"imm_jump", "kf_gated", "kf_ud", "mme_ud", "imm_ud"}
TAKES |= {f"nonlinear_{case}" for case in BY_EQUATIONS} - {
    f"nonlinear_{case}" for case in ("mkf_attitude", "mme_sensed", "imm_three", "one_step_attitude")
}
#: Rows of y that only one of several updates may take, together.
TOGETHER = {name: [{1, 3}] for name in ("kf", "kf_joseph", "kf_ud", "genie")} | {
    "kf_functions": [{0, 1}]
}


def oracle(plant, y, u, params):
    """Ports by name as the first closed form of the family about all samples gives them."""
    if plant.filter.family == "cpcf":
        return partial_plants.expected(plant, y, u, params)
    if plant.filter.traits.windows != "none":
        return soft_plants.expected(plant, y, u, params)
    given = Record(y=y, u=u, parameters=params, P0=plant.model.P0.values())
    for form in family(plant.filter.family).closed_forms:
        found = None if form.steady or form.start else form.expected(plant, given)
        if found and all(len(found.get(f"{of}_state", ())) == len(y) for of in STAGES):
            return found
    raise AssertionError(plant.filter.family)


NAMES = tuple(plants())


@dataclass
class Sample:
    """What is done at one sample: rows of each update, or one step."""

    parts: list[list[int]]
    step: bool


def planned(name, rng):
    """A sequence: steps, predictions alone, one update, several, with rows left out."""
    p, plan = plants()[name].model.ny, []
    for _ in range(T):
        kind = rng.choice(["step", "predict", "update", "updates"])
        rows = [i for i in range(p) if rng.random() < 0.7]
        parts = {"step": [rows], "predict": [], "update": [rows]}.get(kind)
        if parts is None and name in TAKES and not name.startswith("nonlinear_"):
            where = rng.integers(0, 3, p)
            if name == "kf_gated":  # which rows it rejects depends on their order
                where.sort()
            for group in TOGETHER.get(name, ()):
                where[list(group)] = where[min(group)]
            parts = [[i for i in rows if where[i] == part] for part in range(3)]
        plan.append(Sample([rows] if parts is None else parts, kind == "step"))
    return plan


def data(plant, rng):
    """A full record, inputs and parameters, unless the family is told something: that as well."""
    p, q = plant.model.ny, plant.model.nu
    y, u = 2.0 * rng.standard_normal((T, p)), rng.standard_normal((T, q))
    if plant.filter.traits.told:
        factor = plant.faults.sensor.noise_factor
        told = {"gamma": rng.integers(0, 2, T), "delta": np.where(rng.random(T) < 0.5, 1.0, factor)}
        return y, u, {key: np.asarray(value, float) for key, value in told.items()}
    return y, u, {key: v * rng.uniform(0.9, 1.1, T) for key, v in plant.defaults.items()}


class Player:
    """One instance that is called, and copied, saved and restored on the way."""

    def __init__(self, name, rng):
        self.name, self.rng, self.plant = name, rng, plants()[name]
        self.found = copy.copy(built(self.plant))
        self.found.reset()

    def refused(self, status, call, *arguments):
        before = self.found.snapshot()
        with pytest.raises(StepRefused) as caught:
            getattr(self.found, call)(*arguments)
        assert caught.value.name == f"{self.found.name.upper()}_{status}"
        assert self.found.snapshot() == before

    def disturb(self, u, params):
        """Calls that C refuses, and moves to another instance."""
        if self.rng.random() < 0.3:
            wild = np.full(self.plant.model.ny, np.inf)
            self.refused("INPUT_NOT_FINITE", "update", wild, u, params)
        if u is not None and self.rng.random() < 0.2:
            self.refused("INPUT_NOT_FINITE", "predict", np.full(len(u), np.nan), params)
        if self.rng.random() < 0.2:
            saved = self.found.snapshot()
            again = [copy.copy, copy.deepcopy, lambda f: pickle.loads(pickle.dumps(f))]  # noqa: S301
            self.found = again[self.rng.integers(3)](self.found)
            assert self.found.snapshot() == saved
            self.found.reset()
            self.found.restore(pickle.loads(pickle.dumps(saved)))  # noqa: S301

    def sample(self, sample, y, u, params):
        """Do what a sample asks for; snapshots after the updates and after the prediction."""
        found, told = self.found, []
        part = np.full((max(1, len(sample.parts)), len(y)), np.nan)
        for i, rows in enumerate(sample.parts):
            part[i, rows] = y[rows]
        if sample.step:
            last = found.step(part[0], u, params)
            return [last], last
        for row in part[: len(sample.parts)]:
            self.disturb(u, params)
            told.append(self.found.update(row, u, params))
        if told and (self.name not in TAKES or self._breaks(sample)):
            self.refused("WRONG_ORDER", "update", y, u, params)
        self.disturb(u, params)
        return told, self.found.predict(u, params)

    def _breaks(self, sample):
        used = {row for part in sample.parts for row in part}
        return any(used & group for group in TOGETHER.get(self.name, ()))


class Judge:
    """What the oracles say of the record that a sequence of calls makes."""

    def __init__(self, player, record, u, params):
        self.plant = player.plant
        self.windows = self.plant.filter.traits.windows != "none"
        self.sums = ("log_likelihood", "nis")[: 1 + self.plant.filter.traits.linear]
        if player.name == "kf_gated":
            self.sources = [hand_gated(DIAGONAL, record, u)]
        else:
            self.sources = [oracle(self.plant, record, u, params)]
        if player.name in {"kf", "kf_joseph", "kf_ud"}:
            self.sources.append(hand_made(FOUR, record, u, params))

    def same(self, k, snapshot, chosen):
        """The chosen ports are what an oracle says."""
        for source in self.sources:
            for port in (name for name in source if name in snapshot.ports and chosen(name)):
                allowed = TOLERANCE * np.nanmax(np.abs(source[port]), initial=1.0)
                assert np.nanmax(np.abs(snapshot[port] - source[port][k])) <= allowed, (port, k)

    def updated(self, k, told):
        """Several updates of one sample are one with all of their rows."""
        self.same(k, told[-1], is_filtered)
        for rejected in (each["rejected"][k] for each in self.sources if "rejected" in each):
            shown = np.any([each["rejected"] for each in told], axis=0)
            np.testing.assert_array_equal(shown, rejected)
        for source in (each for each in self.sources if "log_likelihood" in each):
            for port in self.sums:
                total = sum(float(each[port]) for each in told)
                assert total == pytest.approx(source[port][k], rel=1e-9, abs=1e-9)

    def passed(self, k, last, before):
        """A sample without an update: all stays that is about the last one, but for a window."""
        closed = self.windows and before.predicted_window_left == 0
        if closed:
            self.same(k, last, is_filtered)
            np.testing.assert_array_equal(last.fault_declared, self.sources[0]["fault_declared"][k])
        kept = ("innovation", "innovation_covariance", "nis", "log_likelihood")
        for port in kept if closed else (*kept, "filtered_state", "filtered_covariance"):
            np.testing.assert_array_equal(last[port], before[port])


def is_predicted(port):
    return port.startswith("predicted_") or port in {"mode_state", "mode_covariance"}


def is_filtered(port):
    return port.startswith(("filtered_s", "filtered_c", "mode_")) and not is_predicted(port)


def assert_follows(name, seed):
    rng = np.random.default_rng([seed, NAMES.index(name)])
    player, plan = Player(name, rng), planned(name, rng)
    y, u, params = data(player.plant, rng)
    record = np.full_like(y, np.nan)
    for k, sample in enumerate(plan):
        rows = [row for part in sample.parts for row in part]
        record[k, rows] = y[k, rows]
    judge, before = Judge(player, record, u, params), player.found.snapshot()
    for k, sample in enumerate(plan):
        now = {key: float(value[k]) for key, value in params.items()}
        told, last = player.sample(sample, y[k], u[k] if u.size else None, now or None)
        judge.same(k, last, is_predicted)
        if told:
            judge.updated(k, told)
        else:
            judge.passed(k, last, before)
        for each in () if sample.step else told:
            for port in (port for port in last.ports if port.startswith("predicted_")):
                np.testing.assert_array_equal(each[port], before[port])
        before = last


@pytest.mark.parametrize("name", NAMES)
def test_calls_in_any_order_are_the_record_that_they_make(name):
    for seed in range(12):
        assert_follows(name, seed)


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", NAMES)
def test_three_hundred_orders_of_calls_a_family_are_the_records_that_they_make(name):
    kin = [each for each in plants().values() if each.filter.family == plants()[name].filter.family]
    for seed in range(100, 100 + -(-300 // len(kin))):
        assert_follows(name, seed)


SENSORS = {"ekf_attitude": 1, "imm_jump": 3, "imm_attitude": 3}


@pytest.mark.parametrize("case", SENSORS)
def test_sensors_of_one_sample_linearise_one_after_the_other(case):
    """Each mode is corrected twice, at its own estimate; its weight keeps the density of both."""
    model = random_equations.spec(case).model
    diagonal = np.diag(np.diag(model.R.values({"gain": 0.8}))).tolist()
    plant = random_equations.spec(case, R=diagonal)
    record = random_equations.record(plant, seed=3)
    faults = plant.faults.jump
    modes = [None] if faults is None else faults.modes
    systems = [system_of(plant, 8, record.parameters, mode) for mode in modes]
    prior = np.ones(1) if faults is None else np.array(faults.initial)
    found, now = built(plant), {name: float(v[0]) for name, v in record.parameters.items()}
    found.reset()
    held, logs = [(each.space.normal(each.x0), each.P0) for each in systems], np.log(prior)
    for row in range(plant.model.ny):
        y = np.full(plant.model.ny, np.nan)
        y[row] = record.y[0, row] if np.isfinite(record.y[0, row]) else 0.3
        told = found.update(y, record.u[0], now)
        for i, each in enumerate(systems):
            one = Extended(system=each)
            corrected = one.update(0, held[i], y, record.u[0])
            held[i] = one.filtered(held[i], corrected)
            logs[i] += corrected.agreement[1]
        weights = np.exp(logs - np.logaddexp.reduce(logs))
        x, P = systems[0].space.mixture(
            weights, *(np.array(each) for each in zip(*held, strict=True))
        )
        np.testing.assert_allclose(told.filtered_state, x, atol=1e-12)
        np.testing.assert_allclose(told.filtered_covariance, P, atol=1e-12)
        if len(prior) > 1:
            np.testing.assert_allclose(told.mode_probability, weights, atol=1e-12)
