"""Cross compilers: which one is there for a board, and programs made by it."""

from __future__ import annotations

import ctypes
import importlib.metadata
import importlib.util
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from fkgen.backend.lines import environment
from fkgen.backend.source import Source
from fkgen.errors import CompilerError
from fkgen.runtime import cache
from fkgen.runtime.compiler import compile_shared, find_compiler
from fkgen.target.boards import Board

#: What every program is compiled with.
_FLAGS = ("-std=c99", "-ffp-contract=off", "-ffunction-sections", "-fdata-sections")
_LINKED = ("-nostdlib", "-Wl,--gc-sections")

_GNU = {"arm": "arm-none-eabi-gcc", "avr": "avr-gcc"}
_PACKAGES = {
    "arm": "pip install ziglang, or: apt install gcc-arm-none-eabi libnewlib-arm-none-eabi",
    "avr": "apt install gcc-avr avr-libc",
}

_WAIT = 600


@dataclass(frozen=True, slots=True)
class Toolchain:
    """A compiler for a board."""

    name: str  # With its version
    command: tuple[str, ...]  # With the flags that say which processor
    libraries: tuple[str, ...]  # What a program that has no start is linked with
    script: tuple[str, ...]  # And by which rules

    def run(self, *arguments: str, folder: Path) -> None:
        """Compile or link; CompilerError with the first complaint if that fails."""
        command = [*self.command, *arguments]
        environment = os.environ | {
            f"ZIG_{of}_CACHE_DIR": os.environ.get(f"ZIG_{of}_CACHE_DIR", str(_zig_cache()))
            for of in ("LOCAL", "GLOBAL")
        }
        try:
            started = subprocess.Popen(
                command,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                cwd=folder,
                env=environment,
                start_new_session=True,
            )
        except OSError as error:
            raise CompilerError(f"{self.name} cannot be run: {error}") from None
        try:
            _, complaints = started.communicate(timeout=_WAIT)
        except subprocess.TimeoutExpired:
            os.killpg(started.pid, signal.SIGKILL)  # compilers start others
            started.wait()
            raise CompilerError(f"{self.name} took more than {_WAIT} s: stopped") from None
        if started.returncode != 0:
            lines = complaints.strip().splitlines() or [f"exit status {started.returncode}"]
            first = next(
                (line for line in lines if "error" in line or "undefined" in line), lines[0]
            )
            raise CompilerError(f"{self.name}: {first.replace(str(folder), '').lstrip('/')}")


def on_this_machine(template: str, *libraries: str) -> ctypes.CDLL:
    """Functions in C that go with an emulator, compiled for this machine."""
    with tempfile.TemporaryDirectory(prefix="fkgen-") as place:
        source, target = Path(place) / template, Path(place) / "functions.so"
        source.write_text(environment().get_template(template).render(), encoding="utf-8")
        compile_shared(find_compiler(), source, target, libraries=libraries)
        return ctypes.CDLL(str(target))


def _zig_cache() -> Path:
    """Where zig keeps the run-time library of each processor, which takes it ten seconds."""
    return cache.folder() / "zig"


def toolchain(board: Board) -> Toolchain:
    """The GNU compiler for a board, or that of PyPI's ziglang.

    Raises
    ------
    CompilerError
        If there is neither; it says how to install one.
    """
    found = shutil.which(_GNU.get(board.machine, "")) if board.machine in _GNU else None
    if found is not None:
        return Toolchain(
            _version(found), (found, *board.gcc), ("-lc", "-lgcc", "-lc"), board.script
        )
    if board.zig and importlib.util.find_spec("ziglang") is not None:
        version = importlib.metadata.version("ziglang")
        command = (sys.executable, "-m", "ziglang", "cc", *board.zig)
        return Toolchain(f"zig cc {version}", command, ("-rtlib=compiler-rt",), board.script)
    packages = _PACKAGES.get(board.machine, "pip install ziglang")
    raise CompilerError(f"there is no compiler for {board.name}; install one: {packages}")


def _version(command: str) -> str:
    asked = [command, "-dumpfullversion", "-dumpversion"]  # old ones know the second alone
    try:
        done = subprocess.run(asked, capture_output=True, text=True, timeout=_WAIT, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise CompilerError(f"{command} cannot be run: {error}") from None
    return f"{Path(command).name} {done.stdout.strip()}"


def compiled(
    tools: Toolchain, source: Source, extra: Sequence[tuple[str, str]], folder: Path
) -> list[Path]:
    """Objects of the filter, its self-test, and of what is needed besides."""
    for name, text in (*source.files.items(), *extra):
        (folder / name).write_text(text, encoding="utf-8")
    files = sorted(path.name for path in folder.glob("*.c") if not path.name.endswith("_main.c"))
    for name in files:
        tools.run(
            *_FLAGS, optimisation(source), "-c", name, "-o", f"{Path(name).stem}.o", folder=folder
        )
    return [folder / f"{Path(name).stem}.o" for name in files]


def optimisation(source: Source) -> str:
    """The level that the spec asks for."""
    return "-Os" if source.program.optimise == "size" else "-O2"


def linked(tools: Toolchain, objects: Sequence[Path], roots: Sequence[str], target: Path) -> Path:
    """A program of some objects, in which functions of these names are kept."""
    kept = [f"-Wl,-e,{roots[0]}", *(f"-Wl,-u,{root}" for root in roots)]
    names = [path.name for path in objects]
    flags = (*_LINKED, *tools.script, *kept)
    tools.run(*flags, *names, *tools.libraries, "-o", target.name, folder=target.parent)
    return target
