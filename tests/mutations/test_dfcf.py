"""Mistakes in host and compression filters, by name: each shows in x, P or the statistic.

First those that the paper invites, put into its printed form, then some in the recursion itself.
"""

from __future__ import annotations

import dataclasses

import casadi as ca
import numpy as np
import pytest
from mutants import proved, recursion, refusals, rewritten
from plants import interpreted, random_model, system_of
from scipy.stats import chi2
from soft_plants import expected, soft

import fkgen
from fkgen.estimators.windows import compression
from fkgen.oracle.textbook.compression import PrintedCompression
from fkgen.oracle.theorems.compression import COMPRESSION_IDENTITIES
from fkgen.symbolic.interpreter import Interpreter
from fkgen.symbolic.linalg import pack

#: Parts of the claims that a mistake contradicts.
WINDOWS, CONTRADICTED = "joint distribution of each window", "contradict the host"

#: What two inversions of F and P per sample leave of double precision in these records.
PRINTED = 1e-8

SEEDS = range(8)
WINDOW = 6


def record(seed):
    """A plant on which nothing hides: n > m, y^h between y^c, Q and F full, F not symmetric."""
    rng = np.random.default_rng(seed)
    model = random_model(seed, 3, 2)
    model["Q"] = (0.1 * np.array(model["Q"])).tolist()
    spec = soft(model, window=WINDOW, test=False)
    y = 2.0 * rng.standard_normal((WINDOW + 1, 2))
    y[[1, 4], 1] = np.nan
    y[3, 0] = np.nan
    return spec, y


def printed(spec, y, kind=PrintedCompression):
    """x, P and the statistic at the end of the window from the printed form."""
    system = system_of(spec, len(y))
    found = kind.start(system, spec.faults.soft)
    for k, row in enumerate(y):
        found.step(k, row)
    statistic, dof = found.close()
    return found.x, found.P, statistic, dof


def difference(spec, y, kind=PrintedCompression):
    """Errors of x, P and the statistic relative to the recursion, and whether dof agree."""
    x, P, statistic, dof = printed(spec, y, kind)
    run = interpreted(spec, y, np.zeros((len(y), 0)))
    state, covariance = run["filtered_state"][WINDOW], run["filtered_covariance"][WINDOW]
    zeta = run["test_statistic"][WINDOW]
    return (
        np.abs(x - state).max(),
        np.abs(P - covariance).max(),
        abs(statistic - zeta) / (1.0 + zeta),
        dof == run["test_dof"][WINDOW],
    )


class NoiseOfTheSampleBefore(PrintedCompression):
    """Hhat of k instead of k + 1 in R: (31) as printed."""

    def noise_map(self, before, after):
        del after
        return before


class NeverDecorrelated(PrintedCompression):
    def decorrelate(self, Q, P):
        pass


class DecorrelatedAPosteriori(PrintedCompression):
    """Pbar of the same sample in (32): P after the update with y^h."""

    def step(self, k, y):
        if k:
            self.propagate(k - 1)
        before, later = self.x, dataclasses.replace(self)
        later.update(k, y)
        if k:
            self.decorrelate(self.system.Q[k - 1], later.P)
        self.maintain(*self.update(k, y))
        self.take(k, y, before)


class MaintainedBeforeDecorrelation(PrintedCompression):
    def step(self, k, y):
        if k:
            self.propagate(k - 1)
        before, prior = self.x, self.P
        self.maintain(*self.update(k, y))
        if k:
            self.decorrelate(self.system.Q[k - 1], prior)
        self.take(k, y, before)


class NeverMaintained(PrintedCompression):
    def maintain(self, K, z):
        pass


class ComparedWithThePrior(PrintedCompression):
    """z^c = y^c - h xhat in place of xbar: (34)."""

    def reference(self, posterior, prior):
        del posterior
        return prior


MISTAKES = [
    NoiseOfTheSampleBefore,
    NeverDecorrelated,
    DecorrelatedAPosteriori,
    MaintainedBeforeDecorrelation,
    NeverMaintained,
    ComparedWithThePrior,
]


@pytest.mark.parametrize("seed", SEEDS)
def test_the_printed_form_with_its_misprints_corrected_agrees(seed):
    x, P, statistic, same = difference(*record(seed))
    assert max(x, P, statistic) < PRINTED
    assert same


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda kind: kind.__name__)
def test_mistake(mistake):
    indefinite = 0
    for seed in SEEDS:
        try:
            errors = difference(*record(seed), mistake)[:3]
        except np.linalg.LinAlgError:  # R is no covariance any more: seen, too
            indefinite += 1
        else:
            assert max(errors) > 1e4 * PRINTED, (mistake, seed)
    assert indefinite < len(SEEDS)


@pytest.mark.parametrize("identity", COMPRESSION_IDENTITIES, ids=lambda each: each.claim)
def test_identity(identity):
    assert identity.holds()


def plant(**options):
    return soft(random_model(31, 3, 3, 1, direct=True), host=[1], window=50, **options)


def test_what_is_not_mutated_passes():
    assert len(proved(recursion(plant())).claims) == 4


def closing(whole, name, change):
    """Change what the end of a window assigns to a variable."""
    return rewritten(whole, name, lambda _, value, s: change(value, s), phase="closing")


def test_mistake_compression_filter_without_the_rows_of_the_host(monkeypatch):
    def rows(soft, subset):
        return tuple(row for group in subset for row in soft.groups[group])

    monkeypatch.setattr(compression, "_rows", rows)
    assert WINDOWS in refusals(recursion(plant()))


def test_mistake_deviation_from_the_host_before_its_rows(monkeypatch):
    right = compression._host

    def uncorrected(*arguments):
        found = right(*arguments)
        return dataclasses.replace(found, mean=0 * found.mean)

    monkeypatch.setattr(compression, "_host", uncorrected)
    assert WINDOWS in refusals(recursion(plant()))


def test_mistake_no_process_noise_in_the_compression_filter(monkeypatch):
    whole = recursion(plant())
    name = "predicted_compression_covariance"
    n = whole.spec.model.nx
    Q = pack(ca.SX(ca.DM(whole.spec.model.Q.values())))
    assert Q.numel() == n * (n + 1) // 2
    mutant = rewritten(whole, name, lambda _, value, __: value - Q, phase="predict")
    assert WINDOWS in refusals(mutant)


@pytest.mark.parametrize("port", ["compression_deviation", "compression_covariance"])
def test_mistake_compression_filter_not_discarded(port):
    whole = recursion(plant())
    mutant = closing(whole, port, lambda value, s: value + s[port])
    assert WINDOWS in refusals(mutant)


def test_mistake_state_taken_over_with_the_wrong_sign():
    def turned(value, symbols):
        x, d = symbols["filtered_state"], symbols["compression_deviation"]
        return x - d if depends(value, d) else value

    assert WINDOWS in refusals(closing(recursion(plant()), "closed_state", turned))


def test_mistake_statistic_of_the_host_alone():
    def alone(value, symbols):
        P = symbols["filtered_covariance"]
        return P if depends(value, P) else value

    assert WINDOWS in refusals(closing(recursion(plant()), "difference_0", alone))


def depends(value, symbol):
    return any(ca.depends_on(value, symbol[i]) for i in range(symbol.numel()))


def test_mistake_verdict_the_other_way_round():
    mutant = closing(recursion(plant()), "faulty_0", lambda value, _: 1 - value)
    assert CONTRADICTED in refusals(mutant)


def test_mistake_threshold_of_one_degree_of_freedom_fewer(monkeypatch):
    spec, y = record(0)
    run = interpreted(spec, y, np.zeros((len(y), 0)))
    statistic, dof = run["test_statistic"][WINDOW], int(run["test_dof"][WINDOW])
    alarm = float(chi2.sf(1.001 * statistic, dof))  # just not rejected
    table = spec.to_dict()
    table["filter"]["test"], table["faults"]["soft"]["false_alarm"] = True, alarm
    spec = fkgen.Spec.from_dict(table)
    assert not np.any(interpreted(spec, y, np.zeros((len(y), 0)))["fault_declared"])
    assert not np.any(expected(spec, y)["fault_declared"])
    right = compression.thresholds
    monkeypatch.setattr(compression, "thresholds", lambda a, n: [right(a, 1)[0], *right(a, n)[:-1]])
    assert np.any(Interpreter(recursion(spec)).run(y, np.zeros((len(y), 0)), {})["fault_declared"])


def test_mistake_window_that_ends_one_sample_late():
    whole = recursion(plant())
    shifted = rewritten(whole, "window_left", lambda _, value, __: value + 1)
    assert WINDOWS in refusals(shifted)
