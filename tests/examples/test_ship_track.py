"""The recorded ships of examples/ship_track: what the modes are good for, and what they are not."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scripts import scripts_of

import fkgen

pytestmark = pytest.mark.compiled

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "ship_track"
NAMES = ("prepare", "figure", "run")  # other examples call their scripts so, too


@pytest.fixture(scope="module")
def ships():
    """The scripts of the example, and its filters."""
    with scripts_of("ship_track", *NAMES) as (prepare, _, run):
        yield SimpleNamespace(prepare=prepare, script=run, specs=run.filters())


def table(title):
    text = (EXAMPLE / "tables.md").read_text(encoding="utf-8")
    part = text.split(f"## {title}\n")[1].split("\n## ")[0]
    return [row.strip("|").split(" | ") for row in part.splitlines() if row.startswith("|")]


def test_a_minute_without_reports_is_predicted_honestly_by_imm_and_not_by_kf(ships):
    ship = ships.prepare.record("A")
    imm, kf = (
        ships.script.misses(ships.specs[name], ship, 60.0)
        for name in (ships.script.IMM, ships.script.KF)
    )
    np.testing.assert_allclose(imm.nees.mean(), 0.93, atol=0.01)
    np.testing.assert_allclose(kf.nees.mean(), 1.44, atol=0.01)
    assert imm.log_density.mean() > kf.log_density.mean()
    # The page says that the errors are the same, and how large.
    errors = [ships.script.rms(each.error) for each in (imm, kf)]
    np.testing.assert_allclose(errors, [80.2, 80.1], atol=0.1)


def test_imm_is_the_best_at_the_next_report():
    head, *rows = table("The next report, and a minute without reports")
    for at in (i for i, name in enumerate(head) if "next report" in name):
        best = max(rows[1:], key=lambda row: float(row[at]))
        assert rows[1][0].strip() == "imm"
        assert best is rows[1]


def test_reports_that_hold_nothing_are_told_from_others(ships):
    ship = ships.prepare.record("A")
    bad, lost = ships.script.corrupted(ship, 0)
    assert 40 < lost.sum() < 80
    name = ships.script.MODE
    verdict = ships.script.declared(name, ships.script.run(ships.specs[name], bad))
    np.testing.assert_array_equal(verdict, lost)


def test_instants_lie_close_enough_and_hold_every_report(ships):
    for track, reports in {"A": 1138, "B": 1011, "C": 606, "D": 187, "E": 195}.items():
        ship = ships.prepare.record(track)
        assert ship.reported.sum() == reports
        # Stamps are rounded to a millisecond.
        assert ship.dt.max() <= ships.prepare.LONGEST + 1e-3
        assert (ship.dt[:-1] > 0.0).all()
        np.testing.assert_allclose(np.diff(ship.t), ship.dt[:-1], atol=1e-9)


def test_the_record_is_made_of_the_reports(ships, tmp_path):
    ship = ships.prepare.record("A")
    kept = ship.without(ships.prepare.stretches(ship.t))
    ships.prepare.write(tmp_path / "record.csv", kept)
    made, there = (place / "record.csv" for place in (tmp_path, EXAMPLE))
    assert made.read_bytes() == there.read_bytes()


def test_every_row_of_the_page_stands_in_the_tables(ships):
    page = (EXAMPLE / "README.md").read_text(encoding="utf-8")
    tables = (EXAMPLE / "tables.md").read_text(encoding="utf-8")
    assert ships.script.unsupported(page, tables) == []
    assert ships.script.unsupported("| x | 1.5 |\n", tables) == ["| x | 1.5 |"]


def test_the_cost_of_the_page_is_that_of_the_code(ships):
    page = (EXAMPLE / "README.md").read_text(encoding="utf-8")
    program = fkgen.generate(fkgen.validate(fkgen.load(EXAMPLE / "spec.toml"))).program
    assert re.search(rf"{program.flops} operations", page)
    calls = {op.name: n for op, n in program.operations.items()}
    assert calls["SIN"] == calls["COS"] == 1
