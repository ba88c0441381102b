"""Measure fkgen: ``python bench/run.py``; ``--write`` puts the tables into docs/benchmarks.md."""

from __future__ import annotations

import argparse
import contextlib
import os
import platform
import re
import subprocess
import sys
import tempfile
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))  # works with and without an installation

from harness import clock, figure, page  # noqa: E402
from harness.settings import Settings  # noqa: E402
from rich.console import Console  # noqa: E402
from rivals.contenders import FLAGS  # noqa: E402
from tables import (  # noqa: E402
    anchors,
    batches,
    extended,
    files,
    growth,
    memory,
    rates,
    records,
    sizes,
    startup,
    steps,
    switching,
    trials,
)

ROUNDS, SECONDS = 60, 3.0
PARTS = {
    "anchors": anchors.hand,
    "slingen": anchors.slingen,
    "growth": growth.growth,
    "batches": batches.lanes,
    "hand": steps.against_hand,
    "libraries": steps.against_libraries,
    "imm": switching.models_side_by_side,
    "missing": switching.missing_sample,
    "rates": rates.rates,
    "families": steps.families,
    "run": records.runs,
    "step": records.python_steps,
    "startup": startup.waiting,
    "stages": startup.stages,
    "memory": memory.peak,
    "files": files.files,
    "sizes": sizes.generated,
    "extended": extended.steps,
    "extended-m4f": extended.sizes,
    "trials": trials.trials,
    "fits": trials.fits,
}


def main() -> None:
    """Measure what was asked for, print it, and write it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=PARTS, nargs="+", help="some of the tables")
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="turns of every contender")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="of turns, at least")
    parser.add_argument(
        "--callgrind", action="store_true", help="count instructions too (valgrind)"
    )
    parser.add_argument("--write", action="store_true", help="into docs/benchmarks.md")
    options = parser.parse_args()
    console = Console()
    clock.pin()
    with tempfile.TemporaryDirectory() as folder:
        os.environ["FKGEN_CACHE"] = str(Path(folder) / "cache")  # builds are those of this run
        settings = Settings(Path(folder), options.rounds, options.seconds, options.callgrind)
        tables = []
        for name in options.only or PARTS:
            tables.append(PARTS[name](settings))
            tables[-1].show(console)
    if options.write:
        docs = ROOT / "docs"
        for table in tables:
            for name, (curves, unit) in table.curves.items():
                figure.growth(docs / name, curves, table.title, unit)
        target = docs / "benchmarks.md"
        usual = (options.rounds, options.seconds) == (ROUNDS, SECONDS)
        effort = "" if usual else f" Here {options.rounds} rounds, {options.seconds:g} s or more."
        measured = [table.section(effort) for table in tables]
        text = page.renewed(target.read_text(encoding="utf-8"), _head(settings), measured)
        target.write_text(text, encoding="utf-8")
        console.print(f"wrote {target.relative_to(ROOT)}")


def _head(settings: Settings) -> str:
    versions = "; ".join(_version(cc) for cc in settings.compilers)
    return f"""# Benchmarks

Written by `python bench/run.py --write`; `make bench` measures without writing.
All take turns on one core, {ROUNDS} rounds and {SECONDS:g} s or more where nothing else is said.
Times depend on the machine, ratios much less.

Sections are renewed one by one; machine and versions are those of the last to be renewed.

Machine: {_processor()}, {os.cpu_count()} cores. Compilers: {versions}.
Libraries: {", ".join(_libraries())}.
Flags: `{" ".join(FLAGS)}`, no `-march`, where nothing else is said.
"""


def _processor() -> str:
    """The model as the system names it."""
    information = Path("/proc/cpuinfo")
    text = information.read_text(encoding="utf-8") if information.exists() else ""
    found = re.search(r"model name\s*:\s*(.+)", text)
    return f"{found[1]} ({platform.machine()})" if found else platform.machine()


def _libraries() -> list[str]:
    """Versions of what is measured, as far as it is installed."""
    found = [f"Python {platform.python_version()}"]
    for name in ("numpy", "numba", "filterpy", "statsmodels", "simdkalman"):
        with contextlib.suppress(metadata.PackageNotFoundError):
            found.append(f"{name} {metadata.version(name)}")
    macros = Path("/usr/include/eigen3/Eigen/src/Core/util/Macros.h")
    if macros.exists():
        text = macros.read_text(encoding="utf-8")
        parts = re.findall(r"#define EIGEN_(?:WORLD|MAJOR|MINOR)_VERSION (\d+)", text)
        found.append(f"Eigen {'.'.join(parts)}")
    return found


def _version(compiler: str) -> str:
    command = [compiler, "-dumpfullversion", "-dumpversion"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return f"{compiler} {done.stdout.strip()}"


if __name__ == "__main__":
    main()
