"""Mistakes of users: one line, exit status 2, no traceback, nothing half written."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from click.testing import CliRunner

from fkgen.cli import main
from fkgen.errors import SpecError
from fkgen.problem import Spec
from fkgen.study.reports.starters import resource, starter

GOOD = "t_s,voltage,speed_measured\n0,1,0.1\n0.01,1,0.2\n0.02,1,\n"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "motor.toml").write_text(starter("mkf"), encoding="utf-8")
    (tmp_path / "good.csv").write_text(GOOD, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def refused(folder):
    """Call fkgen, expect one line on stderr and no new file, and return that line."""

    def call(*arguments):
        before = snapshot(folder)
        result = CliRunner().invoke(main, [str(a) for a in arguments], prog_name="fkgen")
        assert result.exit_code == 2, result.output
        assert result.stdout == ""
        assert result.stderr.startswith("error: ")
        assert result.stderr.count("\n") == 1
        assert snapshot(folder) == before
        return result.stderr.strip()

    return call


def snapshot(folder):
    return {p: p.read_bytes() if p.is_file() else None for p in sorted(folder.rglob("*"))}


def fkgen(*arguments, **options):
    command = [sys.executable, "-m", "fkgen", *map(str, arguments)]
    return subprocess.run(command, text=True, check=False, timeout=120, **options)


@pytest.mark.parametrize("command", [["check"], ["generate"], ["verify"], ["run"]])
def test_a_spec_that_is_not_there(refused, command):
    arguments = [*command, "none.toml", *(["good.csv"] if command == ["run"] else [])]
    assert "none.toml: file: given a path that cannot be read" in refused(*arguments)


def test_a_spec_that_is_wrong(refused, folder):
    (folder / "w.toml").write_text(starter("mkf").replace('"mkf"', '"mfk"'), encoding="utf-8")
    assert "w.toml: filter.family: given 'mfk'" in refused("check", "w.toml")


PLANT = """name = "plant"
[parameters]
a = {default = 0.9, min = 0.0, max = 1.0}
[model]
states = [{name = "p"}, {name = "v"}]
A = [["a", 0.1], [0.0, 0.8]]
C = [[1.0, 0.0]]
Q = [[0.2, 0.0], [0.0, 0.1]]
R = [[0.5]]
x0 = [0.0, 0.0]
P0 = [[1.0, 0.0], [0.0, 1.0]]
[filter]
family = "kf"
"""
JUMPS = PLANT.replace("[filter]", "[faults.jump]\ntransition = [[0.9, 0.1], [0.2, 0.8]]\n[filter]")
JUMPS = JUMPS.replace('"kf"', '"imm"').replace("[filter]", "modes = [{}, MODE]\n[filter]")
MODE = "faults.jump.modes[1]"
#: What a spec says of offsets, noises, gates, gains, times, ranges and modes, and cannot mean.
MODEL = [
    (PLANT, "model.S", "x0 =", "S = [[5.0], [0.0]]\nx0 =", "expected what Q and R allow"),
    (JUMPS, "model.S", "x0 =", "S = [[0.1], [0.0]]\nx0 =", "only the family kf"),
    (PLANT, "model.c", "x0 =", "c = [1.0]\nx0 =", "given 1 entries; expected a list of 2"),
    (PLANT, "model.d[0]", "x0 =", "d = [inf]\nx0 =", "given inf; expected a finite number"),
    (PLANT, "model.time", "x0 =", 'time = "cont"\nx0 =', "one of discrete, continuous"),
    (PLANT, "model.sample_time", "x0 =", 'time = "continuous"\nx0 =', "beside time = "),
    (PLANT, "filter.gate", '"kf"', '"kf"\ngate = 1.0', "between 0 and 1, both excluded"),
    (PLANT, "filter.gate_by", '"kf"', '"kf"\ngate = 0.9\ngate_by = "both"', "one of row, sample"),
    (
        PLANT,
        "filter.gain",
        '"kf"',
        '"kf"\ngain = "stationary"',
        "depends on a; expected constant A",
    ),
    (PLANT, "parameters.a.default", "0.9,", "1.5,", "a default in the range, 0.0 to 1.0"),
    (PLANT, "parameters.a.min", "min = 0.0", "min = 3.0", "above max = 1.0"),
    (JUMPS, f"{MODE}.states[1]", "MODE", '{states = ["p", "x"]}', "some of the states p, v"),
    (JUMPS, f"{MODE}.A", "MODE", '{states = ["p"], A = [[1, 0], [0, 1]]}', "has 1 of the states"),
    (JUMPS, f"{MODE}.S", "MODE", "{S = [[0.1], [0.0]]}", "one of A, B, C, D, Q, R, c, d"),
]


@pytest.mark.parametrize(
    ("base", "key", "old", "new", "expected"), MODEL, ids=lambda text: text[:9]
)
def test_a_model_that_cannot_be_meant_is_refused_alike_from_a_file_a_dict_and_every_command(
    refused, folder, base, key, old, new, expected
):
    text = base.replace(old, new).replace("MODE", "{}")
    (folder / "w.toml").write_text(text, encoding="utf-8")
    commands = (["check", "w.toml"], ["generate", "w.toml"], ["run", "w.toml", "good.csv"])
    (line,) = {refused(*command) for command in commands}
    assert line.startswith(f"error: w.toml: {key}: given ")
    assert expected in line
    with pytest.raises(SpecError) as fault:
        Spec.from_dict(tomllib.loads(text))
    assert str(fault.value).replace("<dict>", "w.toml") == line.removeprefix("error: ")
    assert fault.value.key == key


def test_an_unknown_family(refused):
    assert refused("new", "mk") == "error: family: given 'mk'; expected 'mkf'"
    assert "expected one of: kf, ekf, iekf, ukf, mkf, mme" in refused("new", "nothing")


def test_new_never_overwrites(refused):
    assert "given a file that exists" in refused("new", "kf", "-o", "motor.toml")
    assert "a folder that does not exist" in refused("new", "kf", "-o", "no/motor.toml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t_s,voltage\n0,1\n", "line 1: given no column speed_measured"),
        (GOOD.replace("0.2", "o.2"), "line 3, column speed_measured: given 'o.2'"),
        (GOOD.replace("0.02", "-1"), "line 4, column t_s: given -1 after 0.01"),
        (GOOD.replace(",0.2", ""), "line 3: given 2 fields; expected 3"),
        (GOOD.replace(",1,0.2", ",,0.2"), "line 3, column voltage: given nothing"),
        ("", "given an empty file"),
        ("t_s,voltage,speed_measured\n", "a header and nothing below it"),
    ],
)
def test_a_record_that_is_wrong(refused, folder, text, message):
    (folder / "bad.csv").write_text(text, encoding="utf-8")
    line = refused("run", "motor.toml", "bad.csv", "-o", "out.csv", "--plot", "out.png")
    assert line.startswith("error: bad.csv")
    assert message in line


def test_a_record_that_is_not_there(refused):
    assert "none.csv: given a path that cannot be read" in refused("run", "motor.toml", "none.csv")


def test_an_unknown_port(refused):
    line = refused("run", "motor.toml", "good.csv", "--keep", "nis,gian")
    assert line == "error: --keep: given 'gian'; expected 'gain'"


def test_outputs_that_exist_are_kept_unless_forced(refused, folder):
    (folder / "out.csv").write_text("mine", encoding="utf-8")
    (folder / "out.png").write_text("mine", encoding="utf-8")
    line = refused("run", "motor.toml", "good.csv", "-o", "out.csv")
    assert line == (
        "error: out.csv: given a file that exists; expected the name of a new file, "
        "or --force to replace it"
    )
    assert "out.png" in refused("run", "motor.toml", "good.csv", "--plot", "out.png")
    arguments = ["run", "motor.toml", "good.csv", "-o", "out.csv", "--force"]
    assert CliRunner().invoke(main, arguments).exit_code == 0
    assert (folder / "out.csv").read_text(encoding="utf-8").startswith("t_s,")


def test_a_picture_in_an_unknown_format(refused):
    line = refused("run", "motor.toml", "good.csv", "-o", "out.csv", "--plot", "out.bmp")
    assert "given the ending '.bmp'" in line


def test_a_file_of_others_in_the_place_of_a_generated_one_is_kept(refused, folder):
    (folder / "mine").mkdir()
    (folder / "mine" / "my_filter.c").write_text("precious", encoding="utf-8")
    line = refused("generate", "motor.toml", "-o", "mine")
    assert "given a file that fkgen did not write" in line
    assert [path.name for path in (folder / "mine").iterdir()] == ["my_filter.c"]


def test_generated_files_that_were_edited_are_kept(refused, folder):
    assert CliRunner().invoke(main, ["generate", "motor.toml", "-o", "c"]).exit_code == 0
    with (folder / "c" / "my_filter.c").open("a", encoding="utf-8") as file:
        file.write("/* mine */\n")
    assert "given a generated file that was edited" in refused("generate", "motor.toml", "-o", "c")


def test_a_file_where_the_folder_should_be(refused):
    assert "given a file" in refused("generate", "motor.toml", "-o", "good.csv")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
@pytest.mark.parametrize(
    "arguments",
    [
        ("generate", "motor.toml", "-o", "locked/c"),
        ("run", "motor.toml", "good.csv", "-o", "locked/o.csv"),
        ("new", "kf", "-o", "locked/s.toml"),
    ],
)
def test_a_folder_without_permission(refused, folder, arguments):
    (folder / "locked").mkdir(mode=0o500)
    assert "permission denied" in refused(*arguments)


def full(*_arguments, **_options):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_disk_that_fills_up_during_run(refused, monkeypatch):
    monkeypatch.setattr(os, "fsync", full)
    line = refused("run", "motor.toml", "good.csv", "-o", "out.csv")
    assert line.startswith("error: out.csv: given no space left on device; expected a place")


def test_a_disk_that_fills_up_during_generate(refused, monkeypatch):
    monkeypatch.setattr(Path, "write_text", full)
    assert "no space left on device" in refused("generate", "motor.toml", "-o", "c")


def test_a_generation_that_is_interrupted_leaves_nothing(folder, monkeypatch):
    before, written, write = snapshot(folder), [], Path.write_text

    def interrupted(path, *arguments, **options):
        if len(written) == 2:
            raise KeyboardInterrupt
        written.append(path)
        return write(path, *arguments, **options)

    monkeypatch.setattr(Path, "write_text", interrupted)
    result = CliRunner().invoke(main, ["generate", "motor.toml", "-o", "c"])
    assert result.exit_code == 130
    assert result.stderr == "error: interrupted\n"
    assert len(written) == 2
    assert snapshot(folder) == before


def test_a_disk_that_fills_up_under_the_cache(refused, folder, monkeypatch, tmp_path_factory):
    monkeypatch.setenv("FKGEN_CACHE", str(tmp_path_factory.mktemp("cache")))
    monkeypatch.setattr(Path, "write_text", full)
    line = refused("run", "motor.toml", "good.csv", "-o", "out.csv")
    assert "no space left on device" in line
    assert "FKGEN_CACHE" in line


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
@pytest.mark.parametrize(
    "arguments", [("new", "kf"), ("families",), ("run", "motor.toml", "good.csv")]
)
def test_a_full_standard_output(folder, arguments):
    with Path("/dev/full").open("w", encoding="utf-8") as full_device:
        done = fkgen(*arguments, cwd=folder, stdout=full_device, stderr=subprocess.PIPE)
    assert done.returncode == 2
    assert (
        done.stderr.splitlines()[-1] == "error: output cannot be written: no space left on device"
    )
    assert "Traceback" not in done.stderr


def test_a_reader_that_goes_away_is_no_news(folder):
    spec = resource("examples/car_speed/spec.toml")
    drive = resource("examples/car_speed/record.csv")
    command = [sys.executable, "-m", "fkgen", "run", str(spec), str(drive)]
    with subprocess.Popen(
        command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        process.stdout.readline()
        process.stdout.close()
        errors = process.stderr.read()
    assert errors == b""


def test_a_compiler_that_fails(refused, monkeypatch, tmp_path_factory):
    monkeypatch.setenv("FKGEN_CACHE", str(tmp_path_factory.mktemp("cache")))
    monkeypatch.setenv("FKGEN_CC", "/bin/false")
    line = refused("run", "motor.toml", "good.csv", "-o", "out.csv")
    assert line.startswith("error: /bin/false refused")


def test_a_compiler_that_is_not_there(refused, monkeypatch):
    monkeypatch.setenv("FKGEN_CC", "no-such-cc")
    assert "FKGEN_CC is 'no-such-cc'" in refused("run", "motor.toml", "good.csv")


def test_a_demo_without_a_compiler_names_what_is_missing(folder):
    environment = {
        "PATH": str(folder),
        "HOME": str(folder),
        "PYTHONPATH": os.pathsep.join(sys.path),
    }
    code = (
        "import importlib.util as u; find = u.find_spec\n"
        "u.find_spec = lambda n, *a: None if n == 'ziglang' else find(n, *a)\n"
        "from fkgen.cli import main; main(['demo'])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("error: no C compiler found")
    assert done.stderr.count("\n") == 1
    assert not (folder / "fkgen_demo").exists()


def test_a_file_where_the_demo_should_go(refused):
    assert "good.csv: given a file; expected a folder" in refused("demo", "-o", "good.csv")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("frob",), "no such command 'frob'; see: fkgen --help"),
        (("check",), "missing argument 'SPEC'; see: fkgen check --help"),
        (("run", "a", "b", "--bad"), "no such option"),
        (("new", "kf", "kf"), "got unexpected extra argument (kf); see: fkgen new --help"),
    ],
)
def test_mistakes_in_the_command_line_are_one_line(refused, arguments, message):
    assert message in refused(*arguments)


def test_without_a_command_there_is_help(folder):
    result = CliRunner().invoke(main, [], prog_name="fkgen")
    assert "Usage: fkgen" in result.output
    assert "Traceback" not in result.output
