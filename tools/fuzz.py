"""Call the C of examples with any bits, in any order: ``python tools/fuzz.py [FILTER]...``.

The harness of ``fkgen generate --harness`` under libFuzzer with the address and undefined-behaviour
sanitizers, divisions by zero among them. It stops where a refused call changed a byte, where an
accepted one left an instance that is none, and where a sanitizer speaks. A table in Markdown; the
exit status is 1 if anything was found.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import get_args

from rich.progress import track

import fkgen
from fkgen.backend.render import with_harness
from fkgen.problem.code import Update

ROOT = Path(__file__).resolve().parent.parent
FLAGS = ("-g", "-O1", "-ffp-contract=off", "-fno-sanitize-recover=all")
SANITIZERS = "-fsanitize=fuzzer,address,undefined,float-divide-by-zero"
#: Up to a hundred calls of a filter of some twenty numbers.
BYTES = 1 << 16
HEAD = ("filter", "update", "sequences", "found")


def main() -> int:
    """Fuzz the examples; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="filters; default: all")
    parser.add_argument("--runs", type=int, default=1_000_000, help="sequences of each filter")
    parser.add_argument("--seconds", type=int, default=60, help="most for each filter")
    parser.add_argument("--update", choices=get_args(Update), help="form of the update")
    parser.add_argument("-o", "--output", type=Path, help="Markdown file for the table")
    given = parser.parse_args()
    if shutil.which("clang") is None:
        print("there is no clang: apt install clang libclang-rt-14-dev", file=sys.stderr)
        return 2
    specs = [
        fkgen.load(path)
        for path in sorted((ROOT / "examples").glob("*/*.toml"))
        if "[filter]" in path.read_text(encoding="utf-8")
    ]
    if given.update:
        specs = [replace(each, code=replace(each.code, update=given.update)) for each in specs]
    specs = [each for each in specs if not given.names or each.name in given.names]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        found = pool.map(lambda each: one(each, given.runs, given.seconds), specs)
        rows = list(track(found, "filters", total=len(specs)))
    lines = ["| " + " | ".join(row) + " |" for row in (HEAD, ("---",) * len(HEAD), *rows)]
    if given.output is not None:
        given.output.write_text("\n".join([*lines, ""]), encoding="utf-8")
    print("\n".join(lines))
    return 1 if any(row[-1] for row in rows) else 0


def one(spec: fkgen.Spec, runs: int, seconds: int) -> tuple[str, str, str, str]:
    """A row of the table: the form of the update, how many sequences, and what stopped them."""
    try:
        design = fkgen.validate(spec)
        source = with_harness(fkgen.generate(design))
    except fkgen.FkgenError as error:
        return spec.name, spec.code.update, "0", f"not generated: {error}"
    form = design.recursion.form or "none"
    with tempfile.TemporaryDirectory() as folder:
        source.write(Path(folder))
        files = [name for name in source.files if name.endswith(".c") and "selftest" not in name]
        built = run("clang", *FLAGS, SANITIZERS, *files, "-o", "fuzz", folder=folder)
        if built.returncode:
            return spec.name, form, "0", f"not compiled: {built.stderr.splitlines()[0]}"
        limits = (f"-runs={runs}", f"-max_total_time={seconds}", f"-max_len={BYTES}")
        done = run("./fuzz", "-seed=1", "-len_control=20", *limits, folder=folder)
    counts = [int(each) for each in re.findall(r"(?:^#|Done )(\d+)", done.stderr, re.MULTILINE)]
    return spec.name, form, f"{max(counts, default=0):,}", told(done)


def told(done: subprocess.CompletedProcess[str]) -> str:
    """What stopped it, in a few words; nothing if nothing did."""
    if done.returncode == 0:
        return ""
    lines = [line for line in done.stderr.splitlines() if "runtime error" in line]
    lines += [line for line in done.stderr.splitlines() if "ERROR" in line]
    if lines and "deadly signal" not in lines[0]:
        return lines[0].strip()
    return "an accepted call left an instance that is none, or a refused one changed something"


def run(*command: str, folder: str) -> subprocess.CompletedProcess[str]:
    """A command in a folder."""
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


if __name__ == "__main__":
    sys.exit(main())
