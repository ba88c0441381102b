"""Measure fkgen: ``python bench/run.py``; ``--write`` puts the tables into docs/benchmarks.md."""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))  # works with and without an installation

import batches  # noqa: E402
import clock  # noqa: E402
import files  # noqa: E402
import memory  # noqa: E402
import rates  # noqa: E402
import records  # noqa: E402
import sizes  # noqa: E402
import startup  # noqa: E402
import steps  # noqa: E402
import switching  # noqa: E402
import trials  # noqa: E402
from contenders import FLAGS  # noqa: E402
from report import Table  # noqa: E402
from rich.console import Console  # noqa: E402
from settings import Settings  # noqa: E402

PARTS = {
    "hand": steps.against_hand,
    "libraries": steps.against_libraries,
    "imm": switching.models_side_by_side,
    "missing": switching.missing_sample,
    "rates": rates.rates,
    "families": steps.families,
    "run": records.runs,
    "batch": batches.batches,
    "step": records.python_steps,
    "startup": startup.waiting,
    "stages": startup.stages,
    "memory": memory.peak,
    "files": files.files,
    "sizes": sizes.generated,
    "trials": trials.trials,
}


def main() -> None:
    """Measure what was asked for, print it, and write it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=PARTS, nargs="+", help="some of the tables")
    parser.add_argument("--rounds", type=int, default=60, help="turns of every contender")
    parser.add_argument("--seconds", type=float, default=3.0, help="of turns, at least")
    parser.add_argument(
        "--callgrind", action="store_true", help="count instructions too (valgrind)"
    )
    parser.add_argument("--write", action="store_true", help="write docs/benchmarks.md")
    options = parser.parse_args()
    if options.write and options.only:
        parser.error("--write needs all tables")
    console = Console()
    clock.pin()
    with tempfile.TemporaryDirectory() as folder:
        settings = Settings(Path(folder), options.rounds, options.seconds, options.callgrind)
        tables = []
        for name in options.only or PARTS:
            tables.append(PARTS[name](settings))
            tables[-1].show(console)
    if options.write:
        target = ROOT / "docs" / "benchmarks.md"
        target.write_text(_page(settings, tables), encoding="utf-8")
        console.print(f"wrote {target.relative_to(ROOT)}")


def _page(settings: Settings, tables: list[Table]) -> str:
    versions = [_version(cc) for cc in settings.compilers]
    head = [
        "# Benchmarks",
        "",
        "Written by `python bench/run.py --write`; `make bench` measures without writing.",
        f"All take turns on one core, {settings.rounds} rounds and {settings.seconds:g} s or more.",
        "Times depend on the machine, ratios much less.",
        "",
        f"Compilers: {'; '.join(versions)}. Flags: `{' '.join(FLAGS)}`, no `-march`.",
        "",
    ]
    return "\n".join([*head, *[table.markdown() for table in tables]])


def _version(compiler: str) -> str:
    command = [compiler, "-dumpfullversion", "-dumpversion"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return f"{compiler} {done.stdout.strip()}"


if __name__ == "__main__":
    main()
