"""Two versions of generated C side by side: ``python bench/against.py OLD NEW [NAME ...]``.

OLD and NEW are folders with a folder for each filter, such as ``generated`` of two checkouts. Where
a program lands in memory can decide up to a factor of 3 in its time: each version is linked and run
several times, in processes of its own, in turn, and the least times are compared.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

from harness import clock
from harness.report import Table, times
from rich.console import Console

FLAGS = ("-std=c99", "-ffp-contract=off")
CORTEX = ("-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard", "-Os")
VERSIONS = ("old", "new")

#: Prints the least nanoseconds of a step over some rounds of made-up measurements.
DRIVER = """
#define _POSIX_C_SOURCE 199309L
#include "{name}.c"
#include <stdio.h>
#include <time.h>
static {name}_t filter;
int main(void)
{{
    static {real} y[512][{upper}_NY];
    {declared}double least = 1e30;
    unsigned state = 1u;
    int i, k, round;
    {filled}for (k = 0; k < 512; ++k)
        for (i = 0; i < {upper}_NY; ++i)
        {{
            state = state * 1664525u + 1013904223u;
            y[k][i] = ({real})(((double)(state >> 8) / 16777216.0) - 0.5);
        }}
    for (round = 0; round < 40; ++round)
    {{
        struct timespec from, to;
        double taken;
        (void){name}_init(&filter);
        (void)clock_gettime(CLOCK_MONOTONIC, &from);
        for (k = 0; k < 512; ++k) (void){name}_step({call});
        (void)clock_gettime(CLOCK_MONOTONIC, &to);
        taken = 1e9 * (double)(to.tv_sec - from.tv_sec) + (double)(to.tv_nsec - from.tv_nsec);
        least = (taken < least) ? taken : least;
    }}
    printf("%.3f\\n", least / 512.0);
    return 0;
}}
"""


def main() -> None:
    """Measure steps under every compiler that is there, and the text for a Cortex-M4F."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("names", nargs="*", help="filters; default: all of the new version")
    parser.add_argument("--builds", type=int, default=5, help="of each version")
    options = parser.parse_args()
    folders = dict(zip(VERSIONS, (options.old, options.new), strict=True))
    names = options.names or sorted(p.name for p in options.new.iterdir() if p.is_dir())
    compilers = [each for each in ("gcc", "clang") if shutil.which(each)]
    note = "new / old: least time of a step at -O2; text and tables in bytes at -Os"
    table = Table("Two versions", ["filter", *compilers, "old, B", "new, B", "ratio"], note)
    clock.pin()
    with tempfile.TemporaryDirectory() as scratch:
        for name in names:
            here = {version: folder / name for version, folder in folders.items()}
            steps = [
                _steps(here, compiler, Path(scratch), options.builds) for compiler in compilers
            ]
            table.add(name, *map(times, steps), *_sizes(here, Path(scratch)))
    table.show(Console())


def _steps(here: dict[str, Path], compiler: str, scratch: Path, builds: int) -> float:
    taken: dict[str, list[float]] = {version: [] for version in VERSIONS}
    for build in range(builds):
        for version in VERSIONS if build % 2 else VERSIONS[::-1]:
            source, program = scratch / f"{version}.c", scratch / f"{version}-{build}"
            source.write_text(_driver(here[version]))
            inputs = ("-I", str(here[version].resolve()), str(source), "-o", str(program))
            subprocess.run([compiler, *FLAGS, "-O2", "-w", *inputs], check=True)
            taken[version].append(float(subprocess.check_output([str(program)], text=True)))
    return min(taken["new"]) / min(taken["old"])


def _driver(folder: Path) -> str:
    """The program for one version: what its step takes stands in its header."""
    name = folder.name
    head = (folder / f"{name}.h").read_text(encoding="utf-8")
    found = re.search(rf"{name}_step\(([^)]*)\)\s*;", head)
    if found is None:
        raise SystemExit(f"{folder}: no prototype of {name}_step in {name}.h")
    prototype = found[1]
    real = "double" if "double" in prototype else "float"
    given, driven = "params" in prototype, " u[" in prototype
    declared = [f"{name}_params_t params;"] * given
    declared += [f"static {real} u[{name.upper()}_NU];"] * driven
    every = "NULL" if "valid[" in prototype else "0xffffffffu"
    return DRIVER.format(
        name=name,
        upper=name.upper(),
        real=real,
        declared="".join(f"{line}\n    " for line in declared),
        filled=f"(void){name}_params_init(&params);\n    " * given,
        call=", ".join(["&filter", *["&params"] * given, *["u"] * driven, "y[k]", every]),
    )


def _sizes(here: dict[str, Path], scratch: Path) -> list[str]:
    """Bytes of text and tables of both versions, and their ratio; nothing without a compiler."""
    if shutil.which("arm-none-eabi-gcc") is None:
        return ["-"] * 3
    sizes = []
    for folder in here.values():
        source, target = folder / f"{folder.name}.c", scratch / "target.o"
        command = ["arm-none-eabi-gcc", *CORTEX, *FLAGS, "-c", str(source), "-o", str(target)]
        subprocess.run(command, check=True)
        text = subprocess.check_output(["arm-none-eabi-size", str(target)], text=True)
        sizes.append(sum(map(int, text.splitlines()[1].split()[:2])))
    return [*map(str, sizes), times(sizes[1] / sizes[0])]


if __name__ == "__main__":
    main()
