"""The simulation of Lee & Lee through the compiled filters: exact figures, and some runs of it."""

from __future__ import annotations

import csv
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scripts import scripts_of

import fkgen

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "soft_fault"
PRINTED = 1e-11  # figures with twelve decimals; those with six below
SIX = 6e-7
FOUR = 6e-5

#: P11 at 300, 600 and 690 s with every window accepted, and at 990 s with none after 690 s.
VARIANCES = {
    "KF": (0.469836809501, 0.447696469109, 0.446821047466, 1.046820144940),
    "DFCF": (0.469836809501, 0.447696469109, 0.446821047466, 1.046820144940),
    "PAPER": (0.504362804015, 0.478521535122, 0.477346166915, 1.077345252247),
}
DRIFT = (-0.091221, -0.530114, -1.290706, -2.332490, -3.620103, -6.813139, -12.790743)

#: Non-centrality at 720, 750, 780 and 810 s if nothing faulty was accepted; power; all accepted.
NON_CENTRAL = {
    "DFCF": (
        (0.154067, 3.330958, 11.034009, 23.019342),
        (0.0618, 0.3530, 0.8538, 0.9937),
        (0.154067, 3.218911, 9.637739, 18.075169),
    ),
    "PAPER": (
        (0.129391, 2.977521, 9.852791, 20.551864),
        (0.0650, 0.4074, 0.8808, 0.9950),
        (0.129391, 2.873176, 8.641625, 16.300431),
    ),
}
DOF = {"DFCF": 2, "PAPER": 1, "CPCF": 1}
SIGMAS = 4.0


@pytest.fixture(scope="module")
def example():
    """The modules of the example."""
    names = ("simulation", "outcome", "noiseless", "reproduce")
    with scripts_of("soft_fault", *names) as (sim, outcome, noiseless, reproduce):
        quiet = dict(zip(("DFCF", "CPCF", "PAPER"), sim.NO_TEST, strict=True)) | {"KF": sim.KF}
        yield SimpleNamespace(
            sim=sim, outcome=outcome, noiseless=noiseless, reproduce=reproduce, quiet=quiet
        )


@pytest.fixture(scope="module")
def outcomes(example):
    """A batch of 360 runs, as many as the paper has, through every filter."""
    return example.reproduce.batch(100)


@pytest.mark.parametrize("name", VARIANCES)
def test_variances_with_everything_and_with_nothing_accepted(name, example):
    exact, own = example.noiseless, example.quiet[name]
    kept = exact.variances([own], (300, 600, 690), exact.record())[own]
    lost = exact.variances([own], (990,), exact.record(until=690))[own]
    np.testing.assert_allclose([*kept, *lost], VARIANCES[name], atol=PRINTED, rtol=0.0)


def test_the_mean_error_of_a_kalman_filter_without_a_test(example):
    np.testing.assert_allclose(example.noiseless.drift(), DRIFT, atol=SIX)


@pytest.mark.parametrize("name", NON_CENTRAL)
def test_non_centrality_and_power_at_the_ends_of_windows(name, example):
    exact, own = example.noiseless, example.quiet[name]
    refusing, chances, accepting = NON_CENTRAL[name]
    found = exact.non_centrality(own, accepting=False)
    np.testing.assert_allclose(found, refusing, atol=SIX)
    np.testing.assert_allclose(exact.power(found, DOF[name]), chances, atol=FOUR)
    np.testing.assert_allclose(exact.non_centrality(own, accepting=True), accepting, atol=SIX)


def test_a_window_of_one_sample_is_a_kalman_filter_that_tests_each_position(example):
    """Against a filter in NumPy that tests y before it uses it."""
    sim = example.sim
    runs = sim.simulate(40, 7, samples=1001)
    run = fkgen.build(sim.specifications()[sim.KF_TEST]).run_batch(runs.measured)
    x, P = np.zeros((40, 2)), np.broadcast_to(np.diag([1.0, 0.01]), (40, 2, 2)).copy()
    A = np.array([[1.0, sim.STEP], [0.0, 1.0]])
    G = np.array([sim.STEP**2 / 2, sim.STEP])
    threshold = example.noiseless.chi2.isf(sim.FALSE_ALARM, 1)

    def use(row, noise, y, allowed=True):
        s = P[:, row, row] + noise
        K = P[:, :, row] / s[:, None]
        z = y - x[:, row]
        used = (z**2 / s <= threshold) | (not allowed)
        x[used] += (K * z[:, None])[used]
        P[used] -= (K[:, :, None] * P[:, None, row, :])[used]
        return ~used

    for k in range(1001):
        use(1, 0.01, runs.measured[:, k, 1], allowed=False)
        if k % sim.EVERY == 0 and k:
            rejected = use(0, 100.0, runs.measured[:, k, 0])
            np.testing.assert_array_equal(run.fault_declared[:, k], rejected)
        elif k == 1:  # sample 0 ends no window: its position is tested one sample later
            x[:], P[:] = run.filtered_state[:, k], run.filtered_covariance[:, k]
        if k:
            np.testing.assert_allclose(run.filtered_state[:, k], x, atol=1e-9)
            np.testing.assert_allclose(run.filtered_covariance[:, k], P, atol=1e-11)
        x[:] = x @ A.T
        P[:] = A @ P @ A.T + 25.0 * np.outer(G, G)


@pytest.mark.parametrize("name", DOF)
def test_without_fault_and_rejections_the_filters_say_what_they_are(name, example, outcomes):
    found = example.reproduce.honesty(outcomes[example.quiet[name]], DOF[name])
    for what, value in {"mean zeta": DOF[name], "false alarms": 0.05, "ratio": 1.0}.items():
        assert abs(found[what].value - value) < SIGMAS * found[what].error, what


def test_with_the_fault_every_statement_of_the_page_holds(example, outcomes):
    assert example.reproduce.violations(outcomes) == []


def test_windows_are_rejected_as_often_as_the_non_centrality_says(example, outcomes):
    """The first window with the fault: nothing faulty was accepted before it, but false alarms
    have changed some hosts."""
    sim = example.sim
    for name, chance in ((sim.DFCF, 0.0618), (sim.CPCF, 0.0650), (sim.PAPER, 0.0650)):
        found = outcomes[name].rejected([720])
        assert abs(found.value - chance) < SIGMAS * found.error + 0.01
    assert outcomes[sim.KF_TEST].rejected(slice(901, 991)).value == pytest.approx(0.466, abs=0.02)


def test_the_page_quotes_its_tables(example):
    page, tables = ((EXAMPLE / name).read_text("utf-8") for name in ("README.md", "tables.md"))
    assert len(re.findall(r"\d+\.\d{3,}", page)) > 20
    assert example.reproduce.unsupported(page, tables) == []
    rows = list(csv.reader((EXAMPLE / "tables.csv").read_text("utf-8").splitlines()))
    assert {row[0] for row in rows} == set(re.findall(r"^## (.*)$", tables, re.MULTILINE))


def test_exact_tables_are_current(example):
    tables = (EXAMPLE / "tables.md").read_text("utf-8")
    for rows in example.reproduce.exact_tables().values():
        for row in rows:
            assert "| " + " | ".join(row) + " |" in tables
