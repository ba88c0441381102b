"""``fkgen run`` over what a logger wrote: the same numbers, a summary, nothing lost."""

from __future__ import annotations

import csv
import io
import json
import subprocess
import sys

import numpy as np
import pandas as pd
import pyarrow.parquet
import pytest
from click.testing import CliRunner

import fkgen
from fkgen.cli import main
from fkgen.study.records import csv_files, files, filtering
from fkgen.study.records.table import read_table

SPEC = """
name = "walk"
[parameters]
dt = 0.1
[model]
states = [{name = "p"}, {name = "v"}]
outputs = [{name = "gps", unit = "m"}, {name = "speed", unit = "m/s"}]
sample_time = "dt"
A = [[1.0, "dt"], [0.0, 1.0]]
C = [[1.0, 0.0], [0.0, 1.0]]
Q = [[1e-4, 0.0], [0.0, 1e-2]]
R = [[1.0, 0.0], [0.0, 0.04]]
x0 = [0.0, 0.0]
P0 = [[100.0, 0.0], [0.0, 25.0]]
[filter]
family = "kf"
"""
NAN = np.nan


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "walk.toml").write_text(SPEC, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*options, status=0):
    result = CliRunner().invoke(main, ["run", "walk.toml", *options], prog_name="fkgen")
    assert result.exit_code == status, result.output
    return result


def drawn(samples=900):
    rng = np.random.default_rng(5)
    t = 1_714_564_800_000 + np.cumsum(rng.integers(10, 200, samples))
    y = rng.normal(size=(samples, 2)).round(3)
    y[rng.random(y.shape) < 0.4] = NAN
    return t, y


def text_of(t, y, separator=";"):
    rows = (["" if np.isnan(value) else repr(value) for value in row] for row in y.tolist())
    lines = [separator.join([str(time), *row]) for time, row in zip(t.tolist(), rows, strict=True)]
    return "\n".join([separator.join(["Time [ms]", "Speed (m/s)", "GPS height [m]"]), *lines])


def gaps_of(times, silent):
    """Pauses between rows that are well above the usual one, sample by sample."""
    pauses, last = [], times[0]
    for time, nothing in zip(times, silent, strict=True):
        if not nothing:
            pauses.append(time - last)
            last = time
    usual = max(np.median(pauses[1:]), np.median(np.diff(times)))
    long = [each for each in [*pauses, times[-1] - last] if each > 2.5 * usual]
    return len(long), max(long)


@pytest.mark.parametrize("block", [300, 1 << 22])
def test_a_record_in_pieces_is_filtered_as_the_whole(folder, monkeypatch, block):
    monkeypatch.setattr(csv_files, "BLOCK", block)
    t, y = drawn()
    (folder / "log.csv").write_text(text_of(t, y[:, ::-1]), encoding="utf-8")
    result = run("log.csv", "--column", "gps=gps height")
    table = list(csv.DictReader(io.StringIO(result.stdout)))
    step = np.diff(t, append=2 * t[-1] - t[-2]) / 1000
    expected = fkgen.build(fkgen.load("walk.toml")).run(y, params={"dt": step})
    for name, values in (
        ("p", expected.filtered_state[:, 0]),
        ("v", expected.filtered_state[:, 1]),
    ):
        np.testing.assert_allclose(
            [float(row[f"filtered_state.{name}"]) for row in table], values, rtol=1e-13
        )
    assert [int(row["Time [ms]"]) for row in table] == t.tolist()
    there = np.isfinite(y)
    count, longest = gaps_of((t / 1000).tolist(), ~there.any(axis=1))
    assert count > 5
    rms = np.sqrt(expected.nis[there.any(axis=1)].sum() / there.sum())
    assert result.stderr.splitlines()[-1] == (
        f"summary: log.csv: 900 samples, {there.sum()} of 1800 rows used, {count} gaps (the "
        f"longest of {longest:.6g} s), 0 refused, 0 rejected, rms of normalised "
        f"innovations {rms:.3g} (1 where the model is right)"
    )


def test_what_was_refused_is_counted_and_named_by_its_line(folder):
    (folder / "log.csv").write_text(
        "gps,speed,dt\n1,2,0.1\n\n1,2,1e200\n1,2,1e200\n,,0.1\n", "utf-8"
    )
    result = run("log.csv", "-o", "out.csv", status=1)
    assert result.stdout == ""
    (warning,) = (line for line in result.stderr.splitlines() if line.startswith("warning"))
    assert warning.startswith("warning: log.csv: 2 samples refused, the first in line 4: WALK_")
    assert warning.endswith("held: no time passed there")
    assert (
        "summary: log.csv: 4 samples, 2 of 8 rows used, 0 gaps, 2 refused (2 of them held), 0 rej"
        in (result.stderr)
    )
    assert len((folder / "out.csv").read_text("utf-8").splitlines()) == 5


@pytest.mark.parametrize(
    ("silent", "told"),
    [
        ([3], "0 gaps"),
        ([3, 4], "1 gap (the longest of 3 samples)"),
        ([0, 1, 2, 7, 8, 9, 10, 11], "2 gaps (the longest of 5 samples)"),
        (range(12), "1 gap (the longest of 11 samples)"),
    ],
)
def test_gaps_without_times_are_counted_in_samples(folder, monkeypatch, silent, told):
    rows = ["," if k in silent else "1,2" for k in range(12)]
    (folder / "log.csv").write_text("\n".join(["gps,speed", *rows, ""]), encoding="utf-8")
    for block in (30, 1 << 20):
        monkeypatch.setattr(csv_files, "BLOCK", block)
        assert f"rows used, {told}, 0 refused" in run("log.csv").stderr


def test_an_error_in_the_last_piece_leaves_nothing(folder, monkeypatch):
    monkeypatch.setattr(csv_files, "BLOCK", 300)
    t, y = drawn()
    text = text_of(t, y).replace("GPS height [m]", "gps") + "\n1;2;3\n"
    (folder / "log.csv").write_text(text, encoding="utf-8")
    for options in ((), ("-o", "out.csv"), ("-o", "out.csv", "--plot", "out.png")):
        result = run("log.csv", *options, status=2)
        assert result.stdout == ""
        assert "error: log.csv, line 902, column Time [ms]: given 1 after" in result.stderr
        assert sorted(p.name for p in folder.iterdir()) == ["log.csv", "walk.toml"]


def test_times_with_commas_and_quotes_come_out_as_they_were(folder):
    times = ["2024-05-01T12:00:00,5", "2024-05-01T12:00:01,0"]
    rows = "\n".join(f'"{time}",1,2' for time in times)
    (folder / "log.csv").write_text(f"time,gps,speed\n{rows}\n", "utf-8")
    table = list(csv.DictReader(io.StringIO(run("log.csv").stdout)))
    assert [row["time"] for row in table] == times


OTHERS = {
    "run": ["run", "walk.toml", "log.csv"],
    "simulate": ["simulate", "walk.toml", "--record", "log.csv"],
    "compare": [
        "compare",
        "walk.toml",
        *("--families", "kf", "--runs", "2", "--record", "log.csv"),
    ],
    "fault-effect": ["fault-effect", "walk.toml", "--sensor", "gps", "--record", "log.csv"],
}


def command(name, *options):
    return CliRunner().invoke(main, [*OTHERS[name], *options], prog_name="fkgen")


@pytest.mark.parametrize("name", OTHERS)
def test_every_command_tells_of_a_record_what_run_tells(folder, name):
    text = "Stamp;Speed;gps [m];dt\n0,00;1;2;0\n0,10;1;-99;0,1\n0,30;1;2;0,2\n0,40;1;2;0,1\n"
    (folder / "log.csv").write_text(text, encoding="utf-8")
    result = command(name, "--time", "stamp", "--missing", "-99")
    assert result.exit_code == 0, result.output
    said = [line for line in result.stderr.splitlines() if not line.startswith("summary")]
    (warning,) = said
    assert warning == (
        "warning: log.csv, line 2, column dt: 0 contradicts the times, which say 0.1 to the next "
        "sample; the times are used"
    )
    assert "contradicts" not in result.stdout
    if name == "simulate":
        table = list(csv.DictReader(io.StringIO(result.stdout)))
        assert [row["Stamp"] for row in table] == ["0,00", "0,10", "0,30", "0,40"]
        assert next(iter(table[0])) == "Stamp"
        np.testing.assert_allclose([float(row["dt"]) for row in table], [0.1, 0.2, 0.1, 0.1])
        assert [row["gps"] == "" for row in table] == [False, True, False, False]
        (folder / "back.csv").write_text(result.stdout, encoding="utf-8")
        back = CliRunner().invoke(main, ["run", "walk.toml", "back.csv", "--time", "Stamp"])
        assert back.exit_code == 0, back.output


WRONG = {
    "a signal without a column": ("t,speed\n0,1\n", [], "no column gps (there are: t, speed)"),
    "times that go back": ("t,gps,speed\n2,1,1\n1,1,1\n", [], "given 1 after 2; expected times"),
    "a time that is none": ("t,gps,speed\n0,1,1\nnoon,1,1\n", [], "line 3, column t: given 'no"),
    "a field that is none": ("t,gps,speed\n0,1,1\n1,x,1\n", [], "line 3, column gps: given 'x'"),
    "too few fields": ("t,gps,speed\n0,1,1\n1,1\n", [], "line 3: given 2 fields; expected 3"),
    "a missing parameter": ("gps,speed,dt\n1,1,1\n1,1,\n1,1,1\n", [], "line 3, column dt: given"),
    "a doubtful number": ("gps,speed\n1,1\n-9999,1\n", [], "expected --missing -9999 if"),
    "nothing below": ("gps,speed\n", [], "given a header and nothing below it"),
    "an unknown name": ("gps,speed\n1,1\n", ["--column", "gnss=gps"], "--column: given 'gnss'"),
    "an unknown heading": ("gps,speed\n1,1\n", ["--column", "gps=GNSS"], "'GNSS', which is no"),
    "no such time": ("gps,speed\n1,1\n", ["--time", "clock"], "time column: given 'clock', which"),
    "a wide delimiter": ("gps,speed\n1,1\n", ["--delimiter", "ab"], "--delimiter: given 'ab'"),
    "a wrong decimal": ("gps,speed\n1,1\n", ["--decimal", "x"], "--decimal: given 'x'"),
    "no encoding": ("gps,speed\n1,1\n", ["--encoding", "x"], "--encoding: given 'x'"),
    "negative lines": ("gps,speed\n1,1\n", ["--skip-rows", "-1"], "--skip-rows: given -1"),
}


@pytest.mark.parametrize("name", OTHERS)
@pytest.mark.parametrize(("text", "options", "message"), WRONG.values(), ids=WRONG)
def test_every_command_refuses_a_record_in_one_line_and_loses_nothing(
    folder, name, text, options, message
):
    (folder / "log.csv").write_text(text, encoding="utf-8")
    (folder / "out.csv").write_text("precious", encoding="utf-8")
    here = ["-o", "out.csv", "--force"] if name in {"run", "simulate"} else ["--plot", "new.png"]
    result = command(name, *options, *here)
    assert result.exit_code == 2
    assert result.stdout == ""
    (line,) = result.stderr.splitlines()
    assert line.startswith("error: ")
    assert message in line
    assert (folder / "out.csv").read_text("utf-8") == "precious"
    assert sorted(p.name for p in folder.iterdir()) == ["log.csv", "out.csv", "walk.toml"]


def of_matlab(path):
    """The first bytes of a MATLAB file of version 7.3, which is all that is looked at."""
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(512, b" ") + b"\x89HDF\r\n\x1a\n")


OTHER_FILES = {
    "log.parquet": (
        lambda path: pd.DataFrame({"t": [0.0], "gps": [1.0]}).to_parquet(path),
        "log.parquet: given no column speed (there are: t, gps); expected a column for each of: ",
    ),
    "log.mat": (of_matlab, "given a MATLAB file of version 7.3; expected h5py to read it: pip"),
    "log.npz": (lambda path: np.savez(path, gps=[1.0, 2.0], speed=[1, 2, 3]), "given 2 values; ex"),
    "none.csv": (lambda path: None, "none.csv: given a path that cannot be read (no such file"),  # noqa: ARG005
}


@pytest.mark.parametrize("name", OTHER_FILES)
def test_other_files_are_refused_in_one_line_and_nothing_is_lost(folder, monkeypatch, name):
    write, message = OTHER_FILES[name]
    write(folder / name)
    monkeypatch.setitem(sys.modules, "h5py", None)
    before = sorted(p.name for p in folder.iterdir())
    result = run(name, "-o", "out.csv", "--plot", "out.png", status=2)
    assert result.stdout == ""
    (line,) = result.stderr.splitlines()
    assert line.startswith("error: ")
    assert message in line
    assert sorted(p.name for p in folder.iterdir()) == before
    with pytest.raises(fkgen.DataError) as error:
        read_table(name, fkgen.load("walk.toml"))
    assert f"error: {error.value}" == line


def test_a_parquet_file_holds_the_numbers_of_the_csv_file(folder, monkeypatch):
    monkeypatch.setattr(csv_files, "BLOCK", 300)
    monkeypatch.setattr(filtering, "GROUP", 250)
    (folder / "log.csv").write_text(text_of(*drawn()).replace("GPS height [m]", "gps"), "utf-8")
    run("log.csv", "-o", "out.parquet")
    run("log.csv", "-o", "out.csv")
    table, text = pd.read_parquet("out.parquet"), pd.read_csv("out.csv")
    assert 2 < pyarrow.parquet.ParquetFile("out.parquet").num_row_groups < 6
    assert list(table.columns) == list(text.columns)
    for name in text.columns[1:]:
        assert np.array_equal(table[name].to_numpy(float), text[name].to_numpy(float), True)
    run("out.parquet", "--column", "gps=filtered_state.p", "--column", "speed=filtered_state.v")


@pytest.fixture
def stopped(folder, monkeypatch):
    """A run that was interrupted in the middle, and the bytes of one that was not."""
    monkeypatch.setattr(csv_files, "BLOCK", 300)
    (folder / "log.csv").write_text(text_of(*drawn()).replace("GPS height [m]", "gps"), "utf-8")
    run("log.csv", "-o", "whole.csv")
    added, whole = [], files.Kept.add

    def add(self, data, samples):
        whole(self, data, samples)
        added.append(samples)
        if len(added) == 20:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(files.Kept, "add", add)
        result = run("log.csv", "-o", "out.csv", "--resume", status=130)
    line = f"error: interrupted; out.csv.partial holds {sum(added)} samples: the same call goes on"
    assert result.stderr.startswith(line)
    assert not (folder / "out.csv").exists()
    return sum(added), (folder / "whole.csv").read_bytes()


def test_a_run_that_was_interrupted_goes_on_to_the_same_bytes(folder, stopped, monkeypatch):
    written, whole = [], files.Kept.add
    monkeypatch.setattr(
        files.Kept, "add", lambda self, data, n: written.append(n) or whole(self, data, n)
    )
    with (folder / "out.csv.partial").open("ab") as file:
        file.write(b"12.3,what was not noted before the power failed")
    result = run("log.csv", "-o", "out.csv", "--resume")
    assert (folder / "out.csv").read_bytes() == stopped[1]
    assert sum(written) == 900 - stopped[0]
    assert "summary: log.csv: 900 samples" in result.stderr
    assert sorted(p.name for p in folder.iterdir() if "partial" in p.name) == []


def test_what_another_run_left_is_refused_and_stays(folder, stopped):
    left = (folder / "out.csv.partial").read_bytes()
    refused = run("log.csv", "-o", "out.csv", "--resume", "--keep", "nis", status=2)
    assert "what is left of another run, or of another record; it stays as it is" in refused.stderr
    text = (folder / "log.csv").read_text("utf-8")
    (folder / "log.csv").write_text(text + "\n", "utf-8")
    run("log.csv", "-o", "out.csv", "--resume", status=2)
    assert (folder / "out.csv.partial").read_bytes() == left
    assert json.loads((folder / "out.csv.partial.json").read_text())["samples"] == stopped[0]


def test_a_run_that_cannot_be_resumed_is_refused_and_a_bad_record_leaves_nothing(folder):
    (folder / "log.csv").write_text("gps,speed\n1,2\n1,x\n", encoding="utf-8")
    for options in (("--resume",), ("--resume", "-o", "out.parquet")):
        refused = run("log.csv", *options, status=2)
        assert "expected a CSV file as --output" in refused.stderr
    run("log.csv", "-o", "out.csv", "--resume", status=2)
    assert sorted(p.name for p in folder.iterdir()) == ["log.csv", "walk.toml"]


@pytest.mark.exhaustive
def test_memory_does_not_grow_with_the_record(folder):
    code = (
        "import atexit, resource; from fkgen.cli import main;"
        "told = lambda: print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss);"
        "atexit.register(told); main(['run', 'walk.toml', '{}', '-o', '{}'])"
    )
    for suffix in ("csv", "parquet"):
        used = []
        for samples in (300_000, 1_500_000):
            y = np.random.default_rng(0).normal(size=(samples, 2)).round(3)
            frame, name = pd.DataFrame(y, columns=["gps", "speed"]), f"{samples}.{suffix}"
            frame.to_csv(name, index=False) if suffix == "csv" else frame.to_parquet(name)
            out = f"out-{name}"
            command = [sys.executable, "-c", code.format(name, out)]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            used.append(int(done.stdout.split()[-1]) / 1024)
        assert used[1] < used[0] + 100.0, suffix
