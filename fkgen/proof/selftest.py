"""Compile the generated files as a user would, with every compiler, and run their self-test."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

from fkgen.backend.source import Source
from fkgen.errors import CompilerError, OutputError
from fkgen.runtime.compiler import LARGE, find_compiler
from fkgen.symbolic.validated import Claim

#: The warnings that the generated code promises to be free of.
STRICT = (
    *("-std=c99", "-Wall", "-Wextra", "-pedantic", "-Wconversion", "-Wshadow"),
    *("-Wdouble-promotion", "-Wmissing-prototypes", "-Wcast-qual", "-Wundef", "-Wfloat-equal"),
    *("-Werror", "-ffp-contract=off"),
)

_WAIT = 600


@dataclass(frozen=True, slots=True)
class Chosen:
    """A compiler to try."""

    name: str  # For the reader
    command: tuple[str, ...]  # Program and leading arguments


def compilers() -> tuple[Chosen, ...]:
    """The compiler that fkgen uses, and gcc and clang if they are there."""
    used = find_compiler().command
    found = {shutil.which(name) or "": name for name in ("gcc", "clang")}
    others = [Chosen(name, (path,)) for path, name in found.items() if path]
    real = {Path(each.command[0]).resolve() for each in others}
    if len(used) == 1 and Path(used[0]).resolve() in real:
        return tuple(others)
    return (Chosen(Path(used[0]).name, used), *others)


def claims(source: Source, compiler: Chosen) -> tuple[Claim, ...]:
    """Compile without a warning, and give the recorded bits."""
    name = source.program.name
    try:
        with tempfile.TemporaryDirectory(prefix="fkgen-") as place:
            folder = Path(place)
            for file, text in source.files.items():
                (folder / file).write_text(text, encoding="utf-8")
            complaint = _compile(compiler, folder, statements=source.program.statements)
            passed = not complaint and _execute([str(folder / "selftest")]).returncode == 0
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise OutputError(
            tempfile.gettempdir(), given=reason, expected="a folder for temporary files"
        ) from None
    strict = f"{compiler.name} accepts the code as C99 without a warning"
    bits = f"the self-test compiled by {compiler.name} gives the recorded bits"
    return (
        fact(strict, complaint or " ".join(STRICT[1:-1]), holds=not complaint),
        fact(bits, f"{name}_selftest.c", holds=passed),
    )


def fact(claim: str, source: str, *, holds: bool) -> Claim:
    """What is so or not, without an error in between."""
    return Claim(claim=claim, source=source, error=0.0 if holds else float("inf"), tolerance=0.0)


def _compile(compiler: Chosen, folder: Path, *, statements: int) -> str:
    """Compile all files into one program; the first complaint, or nothing."""
    files = sorted(str(path) for path in folder.glob("*.c"))
    optimisation = "-O2" if statements <= LARGE else "-O1"
    done = _execute(
        [*compiler.command, *STRICT, optimisation, *files, "-lm", "-o", str(folder / "selftest")]
    )
    if done.returncode == 0:
        return ""
    lines = done.stderr.strip().splitlines() or [f"exit status {done.returncode}"]
    first = next((line for line in lines if "error" in line), lines[0])
    return first.replace(str(folder), "").lstrip("/")


def _execute(command: list[str]) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(  # noqa: S603 - a compiler that was looked for, and its output
            command, capture_output=True, text=True, timeout=_WAIT, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise CompilerError(f"{command[0]} cannot be run: {error}") from None
