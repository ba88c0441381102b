"""Operations, code size and compile time of what is generated."""

from __future__ import annotations

import subprocess
import time
from pathlib import Path

from harness import models
from harness.report import Table, verdict
from harness.settings import Settings
from rivals import contenders

import fkgen

#: Operations that a step may cost, where a limit was agreed on.
LIMITS = {"imm, 3 modes": 950, "imm, 4 modes": 1400, "imm, 4 modes, lumpable": 1400}


def generated(settings: Settings) -> Table:
    """One row per filter and form of the covariance update."""
    table = Table(
        "What is generated",
        [
            "filter",
            "update",
            "operations",
            "limit",
            "lines of C",
            ".text -O2",
            ".text -Os",
            "gcc -O2, s",
        ],
        "Floating-point operations of a step with every row present, without those inside log and "
        "exp. .text in bytes by gcc: init, update, predict, step and constants.",
    )
    for title, spec in models.all_models().items():
        forms = ("short", "joseph") if spec["filter"]["family"] == "kf" else ("auto",)
        for form in forms:
            source = fkgen.generate(
                fkgen.validate(fkgen.Spec.from_dict(models.with_code(spec, update=form)))
            )
            folder = source.write(settings.folder / form / spec["name"])
            code = folder / f"{spec['name']}.c"
            lines = len(code.read_text().splitlines())
            (fast, seconds), (small, _) = (_compile(code, level) for level in ("-O2", "-Os"))
            flops = source.program.flops
            limit = f"{LIMITS[title]} ({verdict(flops, LIMITS[title])})" if title in LIMITS else ""
            table.add(title, form, flops, limit, lines, fast, small, f"{seconds:.2f}")
    return table


def _compile(code: Path, level: str) -> tuple[int, float]:
    """Bytes of .text, and seconds."""
    target = code.with_suffix(".o")
    flags = [flag for flag in contenders.FLAGS if flag != "-fPIC"]
    start = time.perf_counter()
    subprocess.run(["gcc", *flags, level, "-c", str(code), "-o", str(target)], check=True)
    seconds = time.perf_counter() - start
    done = subprocess.run(["size", str(target)], capture_output=True, text=True, check=True)
    return int(done.stdout.splitlines()[1].split()[0]), seconds
