"""Every command does what its help says."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
import tomllib

import numpy as np
import pytest
from click.testing import CliRunner

import fkgen
from fkgen.cli import main
from fkgen.errors import InternalError
from fkgen.families import NAMES as FAMILIES
from fkgen.study.reports.starters import resource, starter

CAR = resource("examples/car_speed/spec.toml")
DRIVE = resource("examples/car_speed/record.csv")
COMMANDS = ("demo", "new", "check", "generate", "verify", "run", "families")
HEAVY = ("casadi", "sympy", "control", "scipy", "matplotlib", "numpy", "rich")


@pytest.fixture
def invoke(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def call(*arguments, status=0):
        result = CliRunner().invoke(main, [str(a) for a in arguments], prog_name="fkgen")
        assert result.exit_code == status, result.output
        assert "Traceback" not in result.output
        return result

    return call


@pytest.fixture
def motor(tmp_path):
    path = tmp_path / "motor.toml"
    path.write_text(starter("mkf"), encoding="utf-8")
    return path


@pytest.fixture
def record(tmp_path):
    path = tmp_path / "record.csv"
    rng = np.random.default_rng(3)
    rows = "".join(f"{0.01 * k:.2f},1,{v:.4f}\n" for k, v in enumerate(0.1 * rng.normal(size=20)))
    path.write_text(f"t_s,voltage,speed_measured\n{rows}", encoding="utf-8")
    return path


def test_help_names_every_command(invoke):
    text = invoke("--help").stdout
    assert all(f"  {command} " in text for command in COMMANDS)


def test_version(invoke):
    assert invoke("--version").stdout == f"fkgen {fkgen.__version__}\n"


def test_help_and_import_are_light():
    code = f"import sys, fkgen, fkgen.cli; print([m for m in {HEAVY!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_python_m_is_the_command():
    command = [sys.executable, "-m", "fkgen", "--version"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout == f"fkgen {fkgen.__version__}\n"


def test_families_are_listed_with_their_titles(invoke):
    words = invoke("families").stdout.split()
    assert set(FAMILIES) <= set(words)
    assert "intermittent" in words


@pytest.mark.parametrize("family", FAMILIES)
def test_new_gives_a_spec_that_validates_as_it_is(invoke, tmp_path, family):
    invoke("new", family, "-o", "s.toml")
    assert (tmp_path / "s.toml").read_text(encoding="utf-8") == invoke("new", family).stdout
    spec = fkgen.load(tmp_path / "s.toml")
    assert spec.filter.family == family
    assert all(claim.holds for claim in fkgen.validate(spec).claims)


@pytest.mark.parametrize("family", FAMILIES)
def test_starters_explain_every_section(family):
    text = starter(family)
    assert text.count("#") > 10
    assert set(tomllib.loads(text)) >= {"name", "model", "filter", "code"}


def test_check_prints_findings_and_values(invoke, motor):
    text = invoke("check", motor).stdout
    assert "time_constant" in text
    assert "closed_loop_radius" in text


def test_check_as_json_is_what_python_gives(invoke, motor):
    told = json.loads(invoke("check", motor, "--json").stdout)
    report = fkgen.check(fkgen.load(motor))
    assert told["sound"] is True
    assert [f["code"] for f in told["findings"]] == [f.code for f in report.findings]
    assert told["values"]["closed_loop_radius"] == report.values["closed_loop_radius"]


def test_check_of_a_model_that_cannot_work_exits_with_1(invoke, tmp_path):
    text = starter("kf").replace("C = [[1.0, 0.0], ", "C = [[0.0, 0.0], ")
    (tmp_path / "bad.toml").write_text(text, encoding="utf-8")
    assert "undetectable" in invoke("check", "bad.toml", status=1).stdout
    assert json.loads(invoke("check", "bad.toml", "--json", status=1).stdout)["sound"] is False


def test_generate_writes_into_a_folder_named_after_the_filter(invoke, tmp_path, motor):
    text = invoke("generate", motor).stdout
    names = {path.name for path in (tmp_path / "my_filter").iterdir()}
    assert {"my_filter.h", "my_filter.c", "manifest.json"} <= names
    assert all(name in text for name in names)
    assert "floating-point operations" in text


def test_generate_into_the_sources_of_others_says_what_stays_theirs(invoke, tmp_path, motor):
    (tmp_path / "src").mkdir()
    for name in ("main.c", "CMakeLists.txt"):
        (tmp_path / "src" / name).write_text("mine", encoding="utf-8")
    told = invoke("generate", motor, "-o", "src")
    assert "my_filter.h" in told.stdout
    assert "CMakeLists.txt" not in told.stdout
    assert "CMakeLists.txt is yours and stays; add my_filter.c to it" in told.stderr
    for name in ("main.c", "CMakeLists.txt"):
        assert (tmp_path / "src" / name).read_text(encoding="utf-8") == "mine"


def test_generate_again_gives_the_same_files(invoke, tmp_path, motor):
    invoke("generate", motor, "-o", "a")
    first = {path.name: path.read_bytes() for path in (tmp_path / "a").iterdir()}
    invoke("generate", motor, "-o", "a")
    assert {path.name: path.read_bytes() for path in (tmp_path / "a").iterdir()} == first


def test_run_writes_what_python_gives(invoke, tmp_path, motor, record):
    result = invoke("run", motor, record, "-o", "out.csv")
    assert result.stdout == ""
    assert "out.csv: written, 20 samples" in result.stderr
    assert "default of parameter xi" in result.stderr
    with (tmp_path / "out.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    with record.open(encoding="utf-8") as file:
        y = [float(row["speed_measured"]) for row in csv.DictReader(file)]
    expected = fkgen.build(fkgen.load(motor)).run(y, np.ones(20)).filtered_state
    assert [float(row["filtered_state.speed"]) for row in rows] == expected[:, 1].tolist()
    assert [row["t_s"] for row in rows[:2]] == ["0.00", "0.01"]


def test_run_without_output_prints(invoke, motor, record):
    result = invoke("run", motor, record)
    assert result.stdout.startswith("t_s,filtered_state.current,filtered_state.speed,filtered_sd")
    assert result.stdout.count("\n") == 21


def test_run_keeps_what_was_asked_for(invoke, motor, record):
    text = invoke("run", motor, record, "--keep", "gain, predicted_sd,filtered_covariance").stdout
    assert text.splitlines()[0].split(",") == [
        *("t_s", "gain.current.speed_measured", "gain.speed.speed_measured"),
        *("predicted_sd.current", "predicted_sd.speed"),
        *(f"filtered_covariance.{p}" for p in ("current.current", "speed.current", "speed.speed")),
        "status",
    ]


def test_run_draws(invoke, tmp_path, motor, record):
    invoke("run", motor, record, "-o", "o.csv", "--plot", "o.png")
    assert (tmp_path / "o.png").read_bytes().startswith(b"\x89PNG")


def test_run_reports_refused_samples_and_exits_with_1(invoke, tmp_path, motor, record):
    lines = record.read_text(encoding="utf-8").splitlines()
    lines[3] = lines[7] = "0.06,1,inf"
    record.write_text("\n".join(lines).replace("0.06", "0.02", 1), encoding="utf-8")
    result = invoke("run", motor, record, "-o", "o.csv", status=1)
    assert "2 samples refused, the first in line 4: MY_FILTER_INPUT_NOT_FINITE: " in result.stderr
    assert "line 4" in result.stderr
    assert (tmp_path / "o.csv").read_text(encoding="utf-8").splitlines()[3].endswith(",-2")


def test_run_refuses_parameters_out_of_range_sample_by_sample(invoke, motor, record):
    lines = record.read_text(encoding="utf-8").splitlines()
    rows = [f"{line},{'xi' if k == 0 else 1.5 if k == 5 else 0.5}" for k, line in enumerate(lines)]
    record.write_text("\n".join(rows), encoding="utf-8")
    text = invoke("run", motor, record, status=1).stderr
    assert "1 sample refused, in line 6: MY_FILTER_PARAMETER_OUT_OF_RANGE" in text


def test_the_drive_is_filtered_to_four_centimetres_per_second(invoke, tmp_path):
    invoke("demo", "-o", tmp_path / "d")
    text = invoke("demo", "-o", tmp_path / "d").stdout  # again, over its own output
    rms = float(text.split("rms error ")[1].split()[0])
    assert 0.03 < rms < 0.05
    assert "ns each" in text
    made = {path.name for path in (tmp_path / "d").iterdir()}
    assert made == {"car_speed", "car_speed.png", "dc_motor_unknown", "dc_motor_unknown.png"}


def test_the_drive_is_filtered_from_the_command_line(invoke, tmp_path):
    invoke("run", CAR, DRIVE, "-o", "out.csv")
    assert len((tmp_path / "out.csv").read_text(encoding="utf-8").splitlines()) == 11782


def test_verify_prints_every_claim(invoke, motor, monkeypatch):
    from fkgen.proof import verify

    claims = (
        fkgen.Claim(claim="one thing", source="[model.A[0]]", error=0.0, tolerance=0.0),
        fkgen.Claim(claim="another", source="there", error=1e-3, tolerance=1e-9),
    )
    step = verify.Step("all", lambda: claims)
    monkeypatch.setattr(verify, "steps", lambda _spec: (step,))
    text = invoke("verify", motor, status=1).stdout
    assert "[model.A[0]]" in text  # no markup
    assert "NO" in text
    assert "1 of 2 claims hold" in text


def test_a_defect_asks_for_a_report(invoke, motor, monkeypatch):
    def broken(_spec):
        raise InternalError("two and two\nmake five")

    monkeypatch.setattr("fkgen.pipeline.validate", broken)
    text = invoke("generate", motor, status=2).stderr
    assert text.startswith("error: two and two make five; ")
    assert "please report" in text
    assert text.count("\n") == 1


def test_an_interrupt_is_status_130(invoke, motor, monkeypatch):
    def interrupted(_spec):
        raise KeyboardInterrupt

    monkeypatch.setattr("fkgen.pipeline.validate", interrupted)
    assert invoke("generate", motor, status=130).stderr == "error: interrupted\n"
