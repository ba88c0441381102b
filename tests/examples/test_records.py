"""The records of the examples are those that their scripts make of the data sets."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from scripts import EXAMPLES, scripts_of

DATA = Path(os.environ.get("FKGEN_DATA") or EXAMPLES.parents[1] / "shared" / "data")
SETS = {
    "attitude": "broad_imu",
    "battery": "battery_leaf",
    "car_speed": "car_wheel_speed",
    "gps_glitch": "uav_gps_glitch",
    "late_gps": "uav_gps_glitch",
    "ship_track": "ship_tracks_ais",
}
MADE = {
    "attitude": {f"record_{trial}.csv" for trial in (16, 30, 32, 35)},
    "battery": {"record.csv"},
    "car_speed": {"record.csv", "lost.csv", "reference.csv"},
    "gps_glitch": {"record.csv"},
    "late_gps": {"record.csv"},
    "ship_track": {"reports.csv"},  # its record.csv is made of this one, see test_ship_track.py
}


@pytest.mark.parametrize("example", SETS)
def test_the_records_are_made_of_the_data_set(example, tmp_path):
    data = DATA / SETS[example]
    if not data.is_dir():
        pytest.skip(f"no data set {data}; FKGEN_DATA names the folder of all data sets")
    with scripts_of(example, "prepare") as (prepare,):
        prepare.make(data, tmp_path)
    made = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert set(made) == MADE[example]
    for name, content in made.items():
        assert content == (EXAMPLES / example / name).read_bytes()


@pytest.mark.parametrize("example", SETS)
def test_a_record_names_its_source_and_its_licence(example):
    text = (EXAMPLES / example / "record.md").read_text(encoding="utf-8")
    for fact in ("**Source**", "https://", "opyright", "License", "Changed"):
        assert fact in text


@pytest.fixture(scope="module")
def car():
    with scripts_of("car_speed", "prepare") as (prepare,):
        yield prepare


def test_the_record_of_the_drive_is_the_complete_one_without_the_lost_samples(car):
    record = car.read().without(car.DROPOUT)
    written = np.genfromtxt(EXAMPLES / "car_speed" / "record.csv", delimiter=",", skip_header=1)
    there = np.column_stack([record.t, record.dt, record.a_fwd, record.y])
    np.testing.assert_array_equal(there, written)
    lost = np.genfromtxt(EXAMPLES / "car_speed" / "lost.csv", delimiter=",", skip_header=1)
    np.testing.assert_array_equal(record.lost[np.isfinite(record.lost).any(axis=1)], lost[:, 1:])


def test_no_wheel_sample_of_the_complete_drive_is_missing(car):
    wheels = np.isfinite(car.read().y[:, :4])
    assert wheels.sum() == 4 * 4974
    assert (wheels == wheels[:, :1]).all()


@pytest.mark.parametrize(("axle", "scale"), [(slice(2), 1.0079), (slice(2, 4), 1.0097)])
def test_the_scale_of_the_wheels_is_that_of_the_page(car, axle, scale):
    found, _ = car.wheel_scale(car.read(), axle)
    assert round(found, 4) == scale
