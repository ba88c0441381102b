"""`fkgen run` over CSV files: seconds, of them those of reading, and peak memory."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
from harness import models
from harness.report import Table, verdict
from harness.settings import Settings

import fkgen

_ROWS = (1_000_000, 3_000_000)
_SECONDS, _READING, _PEAK = 3.0, 1.0, 400.0  # of 1,000,000 rows; MiB of 3,000,000
_SCRIPT = r"""
import json, re, sys, time
from pathlib import Path
wall = time.perf_counter()
from fkgen.study.records.reading import checked
import fkgen
spec, record = fkgen.Spec.from_dict(json.loads(sys.argv[1])), checked(Path(sys.argv[2]))
if sys.argv[3]:
    from fkgen.study.records.filtering import run
    run(spec, record, output=Path(sys.argv[3]), plot=None, keep="", force=True)
else:
    from fkgen.study.records.record import Record
    assert sum(piece.samples for piece in Record(record, spec).pieces())
peak = int(re.search(r"VmHWM:\s*(\d+)", open("/proc/self/status").read())[1]) / 1024.0
print(json.dumps([time.perf_counter() - wall, time.process_time(), peak]))
"""


def files(settings: Settings) -> Table:
    """Cost of a record in a file."""
    table = Table(
        "`fkgen run` over a CSV file",
        ["rows", "run, s of CPU", "wall, s", "reading alone, s of CPU", "peak, MiB", "met"],
        "kf n2 p1 with a column of times in a fresh process, cached build, the usual columns "
        "written to a file. Wall depends on the disk and on who else is busy. Limits: "
        f"{_SECONDS:g} s and {_READING:g} s of reading for {_ROWS[0]} rows, {_PEAK:g} MiB.",
    )
    spec = models.all_models()["kf n2 p1, C = [0 1]"]
    fkgen.build(fkgen.Spec.from_dict(spec))
    for rows in _ROWS:
        path = settings.folder / "record.csv"
        _write(path, fkgen.Spec.from_dict(spec).model.outputs[0].name, rows)
        wall, seconds, peak = _measure(spec, path, settings.folder / "filtered.csv")
        _, reading, _ = _measure(spec, path, "")
        share = rows / _ROWS[0]
        met = max(seconds / share / _SECONDS, reading / share / _READING, peak / _PEAK)
        numbers = (f"{each:.2f}" for each in (seconds, wall, reading))
        table.add(rows, *numbers, f"{peak:.0f}", verdict(met, 1.0))
    return table


def _write(path: Path, name: str, rows: int) -> None:
    y = np.random.default_rng(0).normal(size=rows)
    with path.open("w", encoding="utf-8") as file:
        file.write(f"t,{name}\n")
        file.writelines(f"{0.01 * k:.2f},{value:.4f}\n" for k, value in enumerate(y.tolist()))


def _measure(spec: models.Spec, record: Path, output: Path | str) -> tuple[float, float, float]:
    arguments = [json.dumps(spec), str(record), str(output)]
    done = subprocess.run(
        [sys.executable, "-c", _SCRIPT, *arguments], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(done.stderr)
    wall, seconds, peak = json.loads(done.stdout)
    return wall, seconds, peak
