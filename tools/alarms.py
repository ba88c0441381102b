"""Have Frama-C look for run-time errors in every small example: ``python tools/alarms.py``.

Examples of at most four states, as ``fkgen verify --prove`` does it; a table in Markdown. The exit
status is 1 if there is an alarm, or an analysis that does not end.
"""

from __future__ import annotations

import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import fkgen
from fkgen.proof import eva

ROOT = Path(__file__).resolve().parent.parent
STATES = 4


def main() -> int:
    """Run everything; print the table."""
    paths = sorted(
        path for path in (ROOT / "examples").glob("*/*.toml") if "[filter]" in path.read_text()
    )
    jobs = [path for path in paths if states(path) <= STATES]
    print("| example | family | n | alarms | seconds |\n| --- | --- | ---: | ---: | ---: |")
    holds = True
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        for row, sound in pool.map(one, jobs):
            print(row, flush=True)
            holds = holds and sound
    return 0 if holds else 1


def states(path: Path) -> int:
    """How many states a spec has."""
    return fkgen.load(path).model.nx


def one(path: Path) -> tuple[str, bool]:
    """One line of the table, and whether there is no alarm."""
    spec, begin = fkgen.load(path), time.monotonic()
    try:
        claims = [claim for step in eva.steps(spec) for claim in step.run()]
        alarms, sound = f"{claims[0].error:.0f}", claims[0].holds
    except fkgen.CompilerError as fault:
        alarms, sound = str(fault), False
    where, seconds = path.relative_to(ROOT / "examples"), time.monotonic() - begin
    return f"| {where} | {spec.filter.family} | {states(path)} | {alarms} | {seconds:.0f} |", sound


if __name__ == "__main__":
    sys.exit(main())
