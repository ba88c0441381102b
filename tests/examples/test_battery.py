"""The cell of examples/battery: within 2 % in spite of drop-outs, and what the page says."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator
from scripts import scripts_of

pytestmark = pytest.mark.compiled

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "battery"


@pytest.fixture(scope="module")
def cell():
    """The scripts, the record, and the filters of the page."""
    with scripts_of("battery", "prepare", "run") as (prepare, run):
        record, filters = prepare.read(), run.filters(("imm", "ekf"))
        found = run.table(filters, record)
        yield SimpleNamespace(
            prepare=prepare, script=run, record=record, filters=filters, found=found
        )


def test_imm_is_within_two_percent_after_half_an_hour_with_every_seed(cell):
    assert cell.script.content()["model"]["x0"][0] == cell.record.soc[0] - 0.3
    assert cell.found["imm"][:, 0].max() <= 2.0
    assert cell.found["ekf"][:, 0].min() > 4.0


def test_the_numbers_of_the_page(cell):
    text = (EXAMPLE / "README.md").read_text(encoding="utf-8")
    for name, each in cell.found.items():
        low, high = each[:, 0].min(), each[:, 0].max()
        line = f"| {name} | {low:.2f} to {high:.2f} % | {each[:, 1].mean():.2f} % |"
        assert line in text.splitlines()
    for wrong, largest in cell.script.starts(cell.filters["imm"], cell.record).items():
        line = f"| {100 * wrong:+.0f} % | {largest.min():.2f} to {largest.max():.2f} % |"
        assert line in text.splitlines()


def test_drop_outs_are_found_where_current_flows(cell):
    out = cell.script.run(cell.filters["imm"], cell.record, 1)
    signal = out.mode_probability[:, :2].sum(axis=1) > 0.5
    sensor = cell.prepare.drop_outs(cell.record, 1)
    flows = np.abs(cell.record.current) > 5.0
    lost = flows & (np.abs(sensor) < 1.0)
    assert lost.sum() > 500
    assert not signal[lost].any()
    assert signal[flows & ~lost].all()


def test_the_record_holds_the_drop_outs_of_its_seed(cell):
    written = np.genfromtxt(EXAMPLE / "record.csv", delimiter=",", names=True)["sensor"]
    made = cell.prepare.drop_outs(cell.record, cell.prepare.SEED)
    np.testing.assert_allclose(written, made, atol=0.0051)


def test_the_charge_of_the_record_is_that_of_its_currents(cell):
    """Rows were left out and put in; the current of a row flows in the interval before it."""
    record = cell.record
    counted = 1.0 + np.append(0.0, np.cumsum(record.current[1:] * record.dt[:-1])) / 3600 / 30.504
    np.testing.assert_allclose(record.soc, counted, atol=2e-3)


def test_the_model_without_law_is_a_filter_of_plain_formulas(cell):
    """The ekf of the page by hand: Jacobian of the table by its cubics, SciPy's."""
    table, record = cell.script.content(), cell.record
    ocv = PchipInterpolator(*(table["tables"]["ocv"][axis] for axis in "xy"))
    x, P = np.array(table["model"]["x0"]), np.array(table["model"]["P0"])
    R, q = np.array(table["model"]["R"]), np.array([1e-10, 1e-6, 4.0, 9e-12])
    y = np.column_stack([cell.prepare.drop_outs(record, 1), record.voltage])[:400]
    out = cell.script.run(cell.filters["ekf"], record, 1)
    for k, dt in enumerate(record.dt[:400]):
        H = np.array([[0.0, 0.0, 1.0, 0.0], [ocv(x[0], 1), 1.0, x[3], x[2]]])
        seen = np.array([x[2], ocv(x[0]) + x[3] * x[2] + x[1]])
        there = np.isfinite(y[k])
        H, S = H[there], (H @ P @ H.T + R)[np.ix_(there, there)]
        K = P @ H.T @ np.linalg.inv(S)
        x, P = x + K @ (y[k] - seen)[there], P - K @ S @ K.T
        np.testing.assert_allclose(out.filtered_state[k], x, rtol=1e-7, atol=1e-9)
        a = np.exp(-dt / 100.0)
        F = np.eye(4)
        F[0, 2], F[1, 1], F[1, 2] = dt / 3600.0 / 30.5, a, 0.0015 * (1.0 - a)
        x, P = F @ x, F @ P @ F.T + np.diag(q * dt)
