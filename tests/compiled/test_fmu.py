"""The co-simulation unit: valid by FMPy, and simulated by it with the bits of a run."""

from __future__ import annotations

import zipfile

import numpy as np
import pytest
from click.testing import CliRunner

import fkgen
from fkgen.cli import main

fmpy = pytest.importorskip("fmpy")
validation = pytest.importorskip("fmpy.validation")
T, dt = 40, 0.5

SPEC = """
name = "axis"
[model]
A = [[1, "dt"], [0, 0.98]]
B = [[0], [0.1]]
C = [[1, 0], [0, 1]]
Q = [[0.01, 0], [0, 0.02]]
R = [["r", 0.0], [0.0, 0.5]]
x0 = [0, 1]
P0 = [[1, 0], [0, 1]]
sample_time = "dt"
states = [{name = "position", unit = "m"}, {name = "speed", unit = "m/s"}]
inputs = [{name = "force", unit = "N", range = [-2.0, 2.0]}]
outputs = [{name = "force", unit = "<V> & more"}, {name = "nis"}]
[parameters]
dt = 0.5
r = 0.3
[filter]
family = "kf"
gate = 0.99
[code]
scalar = "SCALAR"
"""


@pytest.mark.parametrize(("fmi", "scalar"), [("2", "double"), ("3", "float"), ("3", "double")])
def test_it_is_valid_and_gives_the_bits_of_a_run(tmp_path, fmi, scalar):
    spec, path = tmp_path / "axis.toml", tmp_path / "axis.fmu"
    spec.write_text(SPEC.replace("SCALAR", scalar), encoding="utf-8")
    call = ["export-fmu", str(spec), "--fmi", fmi, "-o", str(path)]
    assert CliRunner().invoke(main, call).exit_code == 0
    assert CliRunner().invoke(main, call).exit_code == 2  # it is there
    first = path.read_bytes()
    assert CliRunner().invoke(main, [*call, "--force"]).exit_code == 0
    assert path.read_bytes() == first
    assert validation.validate_fmu(str(path)) == []

    rng = np.random.default_rng(1)
    y, u = rng.normal(size=(T, 2)), rng.uniform(-1, 1, (T, 1))
    y[3], y[5, 0], y[7, 1], u[9] = np.nan, np.nan, 1e3, 2.5
    given = np.zeros(T + 1, [(name, float) for name in ("time", "force", "y.force", "y.nis")])
    given["time"], given["force"][:T] = dt * np.arange(T + 1), u[:, 0]
    given["y.force"][:T], given["y.nis"][:T] = y.T
    names = ["filtered_state.speed", "predicted_covariance[1,0]", "nis", "rejected.nis"]
    found = fmpy.simulate_fmu(
        str(path),
        stop_time=dt * T,
        step_size=dt,
        output_interval=dt,
        input=given,
        start_values={"r": 0.25, "dt": 0.4},
        output=[*names, "status", "held"],
    )[1:]
    run = fkgen.build(fkgen.load(spec)).run(y, u, {"r": 0.25, "dt": 0.4})
    expected = (
        run.filtered_state[:, 1],
        run.predicted_covariance[:, 1, 0],
        run.nis,
        run.rejected[:, 1],
    )
    for name, values in zip(names, expected, strict=True):
        np.testing.assert_array_equal(found[name], values)
    np.testing.assert_array_equal(found["status"], run.status)
    np.testing.assert_array_equal(found["held"], run.held)
    assert {0, 1, 2} <= set(run.status)
    assert run.held.sum() == 1


@pytest.mark.parametrize("fmi", ["2", "3"])
def test_it_holds_its_sources_and_says_what_each_number_is(tmp_path, fmi):
    spec, path = tmp_path / "axis.toml", tmp_path / "axis.fmu"
    spec.write_text(SPEC.replace("SCALAR", "double"), encoding="utf-8")
    call = ["export-fmu", str(spec), "--fmi", fmi, "-o", str(path)]
    assert CliRunner().invoke(main, call).exit_code == 0
    names = zipfile.ZipFile(path).namelist()
    sources = {"sources/axis.c", "sources/axis.h", f"sources/fmi{fmi}.c"}
    assert {"modelDescription.xml", *sources} < {*names}
    about = fmpy.read_model_description(str(path))
    assert about.fmiVersion == f"{fmi}.0"
    assert about.buildConfigurations[0].sourceFileSets[0].sourceFiles == ["axis.c", f"fmi{fmi}.c"]
    known = {each.name: each for each in about.modelVariables}
    assert about.defaultExperiment.stepSize == "0.5"
    assert (known["r"].causality, known["r"].variability) == ("parameter", "tunable")
    assert known["filtered_state.position"].unit == "m"
    assert known["y.force"].unit == "<V> & more"
    assert known["y.force"].causality == known["force"].causality == "input"
    assert known["time"].causality == "independent"


def test_a_unit_of_version_3_goes_back_to_a_state_that_it_gave(tmp_path):
    spec, path = tmp_path / "axis.toml", tmp_path / "axis.fmu"
    spec.write_text(SPEC.replace("SCALAR", "double"), encoding="utf-8")
    call = ["export-fmu", str(spec), "--fmi", "3", "-o", str(path)]
    assert CliRunner().invoke(main, call).exit_code == 0
    about = fmpy.read_model_description(str(path))
    at = {each.name: each.valueReference for each in about.modelVariables}
    told = {"guid": about.guid, "unzipDirectory": fmpy.extract(str(path), str(tmp_path / "open"))}
    unit = pytest.importorskip("fmpy.fmi3").FMU3Slave(**told, modelIdentifier="axis")
    unit.instantiate()
    unit.enterInitializationMode(startTime=2.0)
    unit.exitInitializationMode()
    rows, asked = [at["y.force"], at["y.nis"]], [at["filtered_state.speed"], at["nis"], at["time"]]

    def stepped(y: float) -> list[float]:
        unit.setFloat64(rows, [y, 0.5])
        unit.doStep(2.0, 0.5)
        return unit.getFloat64(asked)

    kept = unit.serializeFMUState(unit.getFMUState())
    first = stepped(1.0)
    assert first[2] == 2.5
    assert stepped(1.0) != first
    unit.setFMUState(unit.deserializeFMUState(kept))
    assert unit.getFloat64(asked)[2] == 2.0
    assert stepped(1.0) == first
    unit.setFloat64([at["r"]], [0.1])
    unit.reset()
    unit.enterInitializationMode(startTime=2.0)
    unit.exitInitializationMode()
    assert stepped(1.0) == first  # with the parameters of the start
    unit.terminate()
    unit.freeInstance()


def test_a_version_that_is_not_known_is_refused(tmp_path):
    spec = tmp_path / "axis.toml"
    spec.write_text(SPEC.replace("SCALAR", "double"), encoding="utf-8")
    result = CliRunner().invoke(main, ["export-fmu", str(spec), "--fmi", "4"])
    assert result.exit_code == 2
    assert "'4' is not one of '2', '3'" in result.output + result.stderr
