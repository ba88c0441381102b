"""The numbers of the example with the models of Song & Hu, from an independent computation."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from effect_plants import MODELS, paper
from scripts import scripts_of

import fkgen
from fkgen.profiles import pulse

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "fault_effect"
SECOND = [(2.359, 0, 53), (2.906, 0, 38), (2.359, 0, 53)]
#: |dX| after a unit pulse: peak, samples after the onset, last of them with 1 % of the peak.
PULSES = {
    ("A", 0): [(0.390, 0, 35), (0.096, 0, 48), (0.720, 0, 22)],
    ("A", 1): SECOND,
    ("B", 0): [None] * 3,
    ("B", 1): [(1.784, 10, 470), (4.139, 0, 33), (4.914, 0, 29)],
    ("C", 1): SECOND,
    ("D", 0): [(0.455, 0, 0), None, (0.656, 0, 0)],
    ("D", 1): [None, (0.807, 0, 89), None],
}
PLATEAUS = {
    ("A", 0): (1.058853, 0.033402, -0.052257),
    ("A", 1): (7.576941, 13.898017, 7.576643),
    ("B", 1): (199.997739, 19.940640, -1.839163),
    ("D", 0): (0.455372, 0.0, -0.655736),
    ("D", 1): (0.0, 16.157634, 0.0),
}
INPUT_PULSES = {
    "A": [(27.2033, 199), (3.6973, 99), (1.0, 0)],
    "C": [(3.6973, 99), (1.0, 0), None],
    "D": [None, (1.0, 0), None],
}
INPUT_STEPS = {
    "A": [(-1e4, 837), (-1e3, 661), (100, 458)],
    "C": [(1000, 661), (100, 458), None],
    "D": [None, (100, 458), None],
}


@pytest.fixture(scope="module")
def example():
    with scripts_of("fault_effect", "song_hu", "printed") as (song_hu, printed):
        yield SimpleNamespace(**vars(song_hu), as_printed=printed.as_printed)


@pytest.mark.parametrize("name", MODELS)
def test_the_example_has_the_models_of_the_paper(example, name):
    here, there = example.spec(name).model, paper(name).model
    for letter in "ABCQR":
        assert np.array_equal(getattr(here, letter).values(), getattr(there, letter).values())
    A, Q = here.A.values(), here.Q.values()
    np.testing.assert_allclose(here.P0.values(), A @ A.T + Q, rtol=1e-15)


@pytest.mark.parametrize(("name", "row"), PULSES)
def test_pulses_of_a_sensor(example, name, row):
    deviation = example.sensor_fault(name, np.eye(2)[row], lasting=False)
    for i, expected in enumerate(PULSES[name, row]):
        if expected is None:
            assert not deviation[:, i].any()
            continue
        found = example.peak(deviation[:, i])
        assert found.size == pytest.approx(expected[0], abs=6e-4)
        assert (found.at, found.over - 1) == expected[1:]


@pytest.mark.parametrize(("name", "row"), PLATEAUS)
def test_where_a_lasting_bias_ends(example, name, row):
    deviation = example.sensor_fault(name, np.eye(2)[row], lasting=True)
    # after 2500 samples 2e-11 of the slowest mode, 0.99, is left
    np.testing.assert_allclose(deviation[-1], PLATEAUS[name, row], rtol=1e-8, atol=1e-6)


@pytest.mark.parametrize("name", INPUT_PULSES)
def test_anomalies_of_the_input(example, name):
    once, lasting = (example.input_anomaly(name, lasting=each) for each in (False, True))
    for i in range(3):
        if INPUT_PULSES[name][i] is None:
            assert not once[:, i].any()
            assert not lasting[:, i].any()
            continue
        size, at = INPUT_PULSES[name][i]
        found = example.peak(once[:, i])
        assert found.size == pytest.approx(size, abs=6e-5)
        assert found.at == at
        end, settled = INPUT_STEPS[name][i]
        assert lasting[-1, i] == pytest.approx(end, rel=1e-6)
        assert example.settling(lasting[:, i], end) == settled


def test_a_pulse_soon_after_the_start(example):
    effect = fkgen.fault_effect(example.spec("A"), pulse(200, 2, [1.0, 1.0])).state_deviation
    size = np.abs(effect[:, 0])
    assert size[2] == pytest.approx(0.24, abs=5e-3)
    assert size.max() == pytest.approx(1.504, abs=5e-4)
    assert int(size.argmax()) + 1 == 14
    assert np.flatnonzero(size > 0.01 * size.max())[-1] + 1 == 57


def test_the_gain_as_printed_is_of_no_use(example):
    for name in "ACD":
        found = example.as_printed(name)
        assert found.gain > 1e3
        assert found.eigenvalue < 0.0
        assert found.radius > 1.0


def test_the_page_quotes_its_tables():
    page, tables = ((EXAMPLE / name).read_text("utf-8") for name in ("README.md", "tables.md"))
    quoted = re.findall(r"\d+\.\d{3,}", page)
    assert len(quoted) > 50
    assert [number for number in quoted if number not in tables] == []
