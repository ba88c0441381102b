"""The trials of examples/attitude: what the page says, and that it is the modes that do it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scripts import scripts_of

import fkgen

pytestmark = pytest.mark.compiled

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "attitude"


@pytest.fixture(scope="module")
def magnets():
    """The scripts, the records, and what two filters make of them."""
    with scripts_of("attitude", "prepare", "run") as (prepare, run):
        records = {trial: prepare.read(trial) for trial in prepare.TRIALS}
        filters = {"imm": fkgen.build(fkgen.load(EXAMPLE / "spec.toml"))}
        filters["ekf"] = fkgen.build(run.plain())
        outs = {
            name: {trial: run.run(each, record) for trial, record in records.items()}
            for name, each in filters.items()
        }
        yield SimpleNamespace(prepare=prepare, script=run, records=records, outs=outs)


def scores(magnets, name):
    return {
        trial: magnets.script.score(out, magnets.records[trial])
        for trial, out in magnets.outs[name].items()
    }


def test_imm_is_below_vqf_on_every_trial(magnets):
    for trial, score in scores(magnets, "imm").items():
        total, turned = magnets.script.VQF[trial]
        assert score.total < total
        assert score.turned < turned


@pytest.mark.parametrize("name", ["imm", "ekf"])
def test_the_numbers_of_the_page(magnets, name):
    text = (EXAMPLE / "README.md").read_text(encoding="utf-8")
    (line,) = [line for line in text.splitlines() if line.startswith(f"| {name}")][:1]
    found = scores(magnets, name)
    cells = [f"{each.total:.2f} / {each.turned:.2f}" for each in found.values()]
    assert line.split(" | ")[1:] == [*cells, f"{magnets.script.ratio(found):.2f} |"]


def test_the_offset_that_comes_goes_again(magnets):
    """The magnet of trial 32 is attached from 40 s to 95 s."""
    t, out = magnets.records[32].t, magnets.outs["imm"][32]
    offset = np.linalg.norm(out.filtered_state[:, 10:], axis=1)
    assert offset[t < 38.0].max() < 1.0
    assert (np.abs(offset[(t > 42.0) & (t < 95.0)] - 58.0) < 2.0).all()
    assert offset[t > 100.0].max() < 2.0
    moves = t[out.mode_probability[:, 1] > 0.5]
    assert moves.size >= 2
    assert (np.minimum(np.abs(moves - 38.5), np.abs(moves - 95.0)) < 1.0).all()


def test_quaternions_are_of_unit_length_with_a_part_that_is_not_negative(magnets):
    for out in magnets.outs["imm"].values():
        q = out.filtered_state[:, :4]
        np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, atol=1e-14)
        assert (q[:, 0] >= 0.0).all()


def test_the_score_is_that_of_the_benchmark(magnets):
    """By traces of matrices, and the best turn found on a grid of a thousandth of a degree."""
    record, out = magnets.records[30], magnets.outs["imm"][30]
    use = np.isfinite(record.truth[:, 0])
    found, true = (
        Rotation.from_quat(q[use][:, [1, 2, 3, 0]]).as_matrix()
        for q in (out.filtered_state[:, :4], record.truth)
    )
    error = found @ np.swapaxes(true, 1, 2)

    def rms(degrees):
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        turned = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ error
        cosine = (np.trace(turned, axis1=1, axis2=2) - 1.0) / 2.0
        return np.degrees(np.sqrt(np.mean(np.arccos(np.minimum(cosine, 1.0)) ** 2)))

    score = magnets.script.score(out, record)
    assert score.total == pytest.approx(rms(0.0), abs=1e-6)
    best = min(rms(turn) for turn in np.arange(-2.0, 2.0, 0.001))
    assert score.turned == pytest.approx(best, abs=1e-5)


def test_steps_that_are_integrated_lead_to_where_single_samples_lead(magnets):
    """A row of turns and pushes against one sample after the other, by quaternions."""
    rng = np.random.default_rng(3)
    gyro, force = rng.normal(0.0, 2.0, (61, 3)), rng.normal(0.0, 5.0, (61, 3))
    dt, found = 1 / 286.0, magnets.prepare.integrated(gyro, force, 1 / 286.0)
    turn, speed = Rotation.identity(), np.zeros(3)
    for i in range(30):
        speed = speed + dt * turn.as_matrix() @ force[30 + i]
        turn = turn * Rotation.from_rotvec(dt * gyro[31 + i])
    assert found.shape == (3, 6)
    np.testing.assert_allclose(found[1], [*turn.as_rotvec(), *speed], atol=1e-13)


def test_no_row_that_is_scored_is_called_a_rest(magnets):
    for record in magnets.records.values():
        rests = np.isfinite(record.y[:, 6])
        assert 0.35 < rests.mean() < 0.5
        assert not (rests & np.isfinite(record.truth[:, 0])).any()
