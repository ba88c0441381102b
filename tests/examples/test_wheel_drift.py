"""The drifting wheel of examples/wheel_drift: isolated, and the other three used."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from scripts import scripts_of

pytestmark = pytest.mark.compiled

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "wheel_drift"


@pytest.fixture(scope="module")
def script():
    with scripts_of("wheel_drift", "drift") as (drift,):
        yield drift


@pytest.fixture(scope="module")
def car(script):
    return script.Car()


@pytest.mark.parametrize("wheel", range(4))
@pytest.mark.parametrize("rate", [-0.002, 0.002])
def test_every_wheel_is_isolated_within_15_seconds(script, car, wheel, rate):
    drift = script.Drift(wheel, 15.0, rate)
    pair, single = car.filtered("dfcf", drift), car.filtered("kf", drift)
    assert car.detection(pair, drift) - 15.0 < 15.0
    late = pair.ends > 35.0
    assert pair.rejected[late, wheel].all()
    assert not np.delete(pair.rejected[late], wheel, axis=1).any()
    assert car.rms(pair, 15.0) < 0.4 * car.rms(single, 15.0)


def test_without_drift_hardly_anything_is_rejected(car):
    quiet = car.filtered("dfcf", None)
    assert quiet.rejected.sum() <= 2
    assert car.rms(quiet, 5.0) < 0.06


def test_the_table_of_the_page_is_what_the_script_finds(script, car, monkeypatch):
    monkeypatch.setattr(script, "RATES", (0.002,))
    (row,) = script.table(car)
    text = (EXAMPLE / "README.md").read_text(encoding="utf-8")
    cells = re.search(r"^\| 0\.20 \|(.*)\|$", text, re.MULTILINE).group(1)
    stated = [float(value) for value in re.findall(r"\d+\.?\d*", cells)]
    found = [100 * row[1], row[2], 100 * row[3], row[4], row[5], 100 * row[6]]
    np.testing.assert_allclose(found, stated, atol=0.06)
