"""The GPS failure of examples/gps_glitch: caught by imm, followed by kf."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scripts import scripts_of

import fkgen

pytestmark = pytest.mark.compiled

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "gps_glitch"
NAMES = ("prepare", "run")  # other examples call their scripts so, too


@pytest.fixture(scope="module")
def glitch():
    """The scripts of the example, its flight, and what two filters make of it."""
    with scripts_of("gps_glitch", *NAMES) as (prepare, run):
        yield flown(prepare, run)


def flown(prepare, run):
    flight = prepare.read()
    results = {
        family: run.run(fkgen.build(run.specification(family)), flight) for family in run.FAMILIES
    }
    verdicts = {family: run.judge(flight, result) for family, result in results.items()}
    return SimpleNamespace(
        prepare=prepare, script=run, flight=flight, results=results, verdicts=verdicts
    )


def test_at_most_one_percent_is_declared_faulty_before_the_failure(glitch):
    assert glitch.verdicts["imm"].false <= 0.01


def test_at_least_three_quarters_are_declared_faulty_during_the_failure(glitch):
    assert glitch.verdicts["imm"].found >= 0.75


def test_imm_stays_within_four_metres_of_the_barometer(glitch):
    assert glitch.verdicts["imm"].farthest <= 4.0


def test_kf_with_the_same_noise_goes_beyond_ten_metres(glitch):
    assert glitch.verdicts["kf"].farthest > 10.0


def test_the_numbers_of_the_page(glitch):
    imm, one_step, kf = (glitch.verdicts[name] for name in ("imm", "one_step", "kf"))
    assert (imm.false, one_step.false) == (4 / 576, 3 / 576)
    assert (imm.found, one_step.found) == (222 / 242, 224 / 242)
    farthest = [verdict.farthest for verdict in (imm, one_step, kf)]
    np.testing.assert_allclose(farthest, [2.591, 2.054, 38.802], atol=1e-3)


def test_only_the_glitch_explains_the_failure(glitch):
    """No receiver that reports zeros: the modes with gamma = 0 get nothing."""
    assert glitch.results["imm"].probability[:, 2:].max() < 1e-4


def test_the_noise_is_twice_the_scatter_of_ordinary_flight(glitch):
    noise = np.sqrt(np.diag(np.array(glitch.script.content()["model"]["R"])))
    np.testing.assert_allclose(noise / glitch.prepare.scatter(glitch.flight), 2.0, rtol=0.15)


def test_the_requirement_is_refused_where_it_is_missed(glitch):
    verdict = glitch.script.Verdict
    assert not glitch.script.missed(verdict(0.01, 0.75, 4.0))
    assert len(glitch.script.missed(verdict(0.011, 0.74, 4.1))) == 3
