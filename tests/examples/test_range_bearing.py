"""The robot of examples/range_bearing: the pages say what the script finds."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scripts import EXAMPLES, scripts_of

pytestmark = pytest.mark.compiled

EXAMPLE = EXAMPLES / "range_bearing"


@pytest.fixture(scope="module")
def robot():
    """The script, its filters and its drives."""
    with scripts_of("range_bearing", "run") as (run,):
        filters, drives = run.filters(("imm", "ekf")), run.simulated()
        found = run.table(filters, drives)
        yield SimpleNamespace(script=run, filters=filters, drives=drives, found=found)


def test_the_numbers_of_the_page(robot):
    text = (EXAMPLE / "README.md").read_text(encoding="utf-8")
    rows = {line.split(" | ")[0]: line for line in text.splitlines()}
    for name, (distance, behind, nees) in robot.found.items():
        start = f"| {name} | {distance:.2f} m | {behind:.2f} m | {nees:.2f} |"
        assert rows[f"| {name}"].startswith(start)


def test_imm_knows_how_good_it_is_and_ekf_does_not(robot):
    assert robot.found["imm"][2] == pytest.approx(1.0, abs=0.05)
    assert robot.found["ekf"][2] > 100.0
    assert robot.found["imm"][0] < 0.4 * robot.found["ekf, without the range"][0]


def test_the_compass_passes_pi_and_wrapping_carries_over(robot):
    jumps = np.abs(np.diff(robot.drives.y[0, :, 2])) > 5.0
    assert jumps.sum() >= 2
    plain = [{"name": row} for row in ("range", "bearing", "compass")]
    unwrapped = robot.script.built("imm", outputs=plain)
    distance, _ = robot.script.errors(robot.script.run(unwrapped, robot.drives), robot.drives)
    assert np.sqrt(np.mean(distance**2)) > 5.0


def test_without_a_compass_an_ekf_is_sure_of_a_wrong_place(robot):
    found = {(unsure, compass): nees for unsure, compass, nees, _ in robot.script.limits()}
    for unsure in robot.script.UNSURE:
        assert found[unsure, True] == pytest.approx(1.0, abs=0.15)
    assert found[0.3, False] > 30.0


def test_the_readme_shows_the_spec_of_the_example():
    spec = (EXAMPLE / "spec.toml").read_text(encoding="utf-8")
    model = spec[spec.index("[model]") :]
    for page in ("README.md", "docs/equations.md"):
        text = (Path(__file__).resolve().parents[2] / page).read_text(encoding="utf-8")
        assert model in text
