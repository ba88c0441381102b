"""Run every example on every processor there are tools for: ``python tools/firmware.py [-o FILE]``.

Float and double, 200 drawn steps each, compared with this machine bit by bit; a table of figures in
Markdown. The exit status is 1 if a bit differs.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

from rich.progress import track

import fkgen
from fkgen.proof import agreement
from fkgen.target.boards import BOARDS, Board, board
from fkgen.target.emulator import emulator
from fkgen.target.toolchain import toolchain
from fkgen.target.verify import STEPS, on_host, tried

ROOT = Path(__file__).resolve().parent.parent
HEAD = ("filter", "scalar", "target", "compiler", "instructions", "flash B", "RAM B", "stack B")


def main() -> int:
    """Run everything; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, help="Markdown file for the table")
    begin, output = time.monotonic(), parser.parse_args().output
    boards = [name for name in BOARDS if available(name)]
    paths = sorted(
        path for path in (ROOT / "examples").glob("*/*.toml") if "[filter]" in path.read_text()
    )
    jobs = [(path, scalar, boards) for path in paths for scalar in ("float", "double")]
    rows, wrong = [], 0
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        for found in track(pool.map(one, jobs), "examples", total=len(jobs)):
            for row, holds in found:
                print(*row, file=sys.stderr, flush=True)
                rows.append(row)
                wrong += not holds
    lines = ["| " + " | ".join(row) + " |" for row in (HEAD, ("---",) * len(HEAD), *rows)]
    if output is not None:
        output.write_text("\n".join([*lines, ""]), encoding="utf-8")
    print("\n".join(lines))
    spent = time.monotonic() - begin
    print(f"{len(rows) - wrong} of {len(rows)} with the bits of this machine, in {spent:.0f} s")
    return 1 if wrong else 0


def available(name: str) -> bool:
    """Whether there are tools for a processor; if not, say which are missing."""
    try:
        toolchain(board(name))
        emulator(board(name))
    except fkgen.CompilerError as missing:
        print(f"left out: {missing}", file=sys.stderr)
        return False
    return True


def one(job: tuple[Path, str, list[str]]) -> list[tuple[tuple[str, ...], bool]]:
    """One example in one scalar type on all processors."""
    path, scalar, names = job
    spec = fkgen.load(path)
    spec = replace(spec, code=replace(spec.code, scalar=scalar))
    source, record = fkgen.generate(fkgen.validate(spec)), agreement.trial(spec, STEPS)
    expected = on_host(source, record)
    return list(_on_boards(spec, [BOARDS[name] for name in names], source, record, expected))


def _on_boards(
    spec: fkgen.Spec, boards: list[Board], *given: object
) -> Iterator[tuple[tuple[str, ...], bool]]:
    scalar = spec.code.scalar
    for each in boards:
        if each.machine == "avr" and scalar == "double":
            continue
        try:
            claims, figures = tried(each, toolchain(each), *given)
        except fkgen.CompilerError as fault:
            fits = "does not fit" in str(fault)
            yield (spec.name, scalar, each.name, str(fault), "", "", "", ""), fits
            continue
        steps = f"{figures.instructions_min} to {figures.instructions_max}"
        sizes = map(str, (figures.flash, figures.ram, figures.stack))
        holds = all(claim.holds for claim in claims)
        compiler = figures.compiler if holds else f"OTHER BITS: {figures.compiler}"
        yield (spec.name, scalar, each.name, compiler, steps, *sizes), holds


if __name__ == "__main__":
    sys.exit(main())
