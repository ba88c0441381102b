"""Find a C compiler, and make shared libraries and entries of the cache with it."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from fkgen.errors import CompilerError, of_type
from fkgen.runtime import cache
from fkgen.runtime.compiled import CompiledFilter
from fkgen.runtime.layout import Layout, layout_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from fkgen.backend.source import Source
    from fkgen.runtime.results import Snapshot

#: The name under which compilers know the processor that they run on.
NATIVE = "native"

#: Operations in the text of a step beyond which -O3 takes longer to compile than anyone waits.
LARGE = 8000

_FLAGS = ("-std=c99", "-shared", "-fPIC", "-ffp-contract=off", "-fvisibility=hidden")
_WAIT = 600


@dataclass(frozen=True, slots=True)
class Compiler:
    """A command that compiles C."""

    command: tuple[str, ...]  # Program and leading arguments
    identity: str  # Changes when the compiler is replaced; part of the cache key
    flags: tuple[str, ...] = ()  # Those of FKGEN_CFLAGS, which come after fkgen's own


def find_compiler() -> Compiler:
    """The compiler of ``FKGEN_CC`` or ``CC``, else cc, gcc or clang, else PyPI's ziglang.

    Flags of ``FKGEN_CFLAGS`` come after fkgen's own.
    """
    for variable in ("FKGEN_CC", "CC"):
        words = os.environ.get(variable, "").split()
        if words:
            found = shutil.which(words[0])
            if found is None:
                raise CompilerError(f"{variable} is {words[0]!r}, which is not on the PATH")
            return _compiler(found, (found, *words[1:]))
    for found in filter(None, map(shutil.which, ("cc", "gcc", "clang"))):
        return _compiler(found, (found,))
    zig = importlib.util.find_spec("ziglang")
    if zig is not None and zig.origin is not None:
        return _compiler(zig.origin, (sys.executable, "-m", "ziglang", "cc"))
    raise CompilerError(
        "no C compiler found: looked for FKGEN_CC, CC, cc, gcc, clang and ziglang; "
        "install one of them (Debian: apt install gcc), or: pip install 'fkgen[zig]'"
    )


def _compiler(path: str, command: tuple[str, ...]) -> Compiler:
    """Known by path, size and time of the program, links followed: no process has to be started."""
    real = Path(path).resolve()
    stat = real.stat()
    flags = os.environ.get("FKGEN_CFLAGS", "").split()
    known = [f"{real}:{stat.st_size}:{stat.st_mtime_ns}", cache.processor()]
    identity = " ".join([*known, *flags])
    return Compiler(command, identity, tuple(flags))


def compile_shared(
    compiler: Compiler,
    source: Path,
    library: Path,
    *,
    statements: int = 0,
    libraries: tuple[str, ...] = (),
    native: bool = True,
) -> None:
    """Compile one file into a shared library, for this processor where the compiler knows it."""
    optimisation = "-O3" if statements <= LARGE else "-O1"
    own = (*_FLAGS, optimisation)
    known = (f"-march={NATIVE}",) if native and cache.processor() else ()
    try:
        _compile(compiler, (*own, *known, *compiler.flags), source, library, libraries)
    except CompilerError:
        if not known:
            raise
        _compile(compiler, (*own, *compiler.flags), source, library, libraries)


def _compile(
    compiler: Compiler,
    flags: tuple[str, ...],
    source: Path,
    library: Path,
    libraries: tuple[str, ...],
) -> None:
    command = [*compiler.command, *flags, str(source), *libraries, "-lm", "-o", str(library)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_WAIT, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise CompilerError(f"{compiler.command[0]} cannot be run: {error}") from None
    if done.returncode != 0 or not library.exists():
        lines = [line for line in done.stderr.splitlines() if "error" in line] or [
            done.stderr.strip() or f"exit status {done.returncode}"
        ]
        raise CompilerError(f"{compiler.command[0]} refused {source.name}: {lines[0]}")


def make(key: str, source: Source, compiler: Compiler) -> Path:
    """Compile generated code into the cache; the folder of the finished entry."""
    program = source.program
    layout = layout_of(program, source.claims)
    texts = {**source.files, f"{program.name}_record.c": source.record}
    texts |= {f"{program.name}_lanes.c": source.lanes} if source.lanes else {}
    texts |= {cache.LAYOUT: layout.to_json(), cache.SPEC: program.stated.spec}
    return cache.store(key, lambda folder: _fill(folder, texts, layout, compiler))


def _fill(folder: Path, texts: Mapping[str, str], layout: Layout, compiler: Compiler) -> None:
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    record = folder / f"{layout.name}_record.c"
    compile_shared(compiler, record, folder / cache.LIBRARY, statements=layout.statements)


def lanes_library(source: Path, statements: int, *, build: bool) -> Path | None:
    """The library over lanes of an entry; None if there is none.

    It is compiled, if it is not there yet, where ``build`` says so. Its name holds the compiler and
    the processor: a folder of the cache may be shared by machines.
    """
    try:
        compiler = find_compiler()
        library = source.with_name(f"lanes-{cache.key_of(compiler.identity)[:12]}.so")
        if build and source.exists() and not library.exists():
            with tempfile.TemporaryDirectory(prefix=".building-", dir=source.parent) as folder:
                made = Path(folder) / library.name
                compile_shared(compiler, source, made, statements=statements)
                made.replace(library)
        return library if library.exists() else None
    except (CompilerError, OSError):  # a batch does without
        return None


def travelled(
    key: str, texts: Mapping[str, str], processor: str, fill: Callable[[Compiler, Path], None]
) -> Path:
    """The entry of what was pickled: where it was, else compiled from its texts for this processor.

    A folder of the cache may be shared by machines: what was compiled for another processor is none
    of ours.
    """
    entry = cache.find(key) if processor == cache.processor() else None
    if entry is not None:
        return entry
    compiler = find_compiler()
    key = cache.key_of(*texts.values(), compiler.identity)
    return cache.find(key) or cache.store(key, lambda folder: fill(compiler, folder))


def revived(
    key: str, texts: Mapping[str, str], processor: str, snapshot: Snapshot
) -> CompiledFilter:
    """A filter that was pickled: from the cache, else compiled from its text anew."""

    def fill(compiler: Compiler, folder: Path) -> None:
        _fill(folder, texts, snapshot.layout, compiler)

    found = CompiledFilter(travelled(key, texts, processor, fill))
    found.restore(snapshot)
    return found


def compile_source(source: Source) -> CompiledFilter:
    """Compile generated code into a filter that runs from Python; cached by content.

    Raises
    ------
    CompilerError
        If there is no C compiler or it refuses the code.
    OutputError
        If the cache folder cannot be written.
    """
    from fkgen.backend.source import Source  # noqa: PLC0415 - a filter in the cache needs none

    of_type("source", source, Source, "what fkgen.generate returns")
    compiler = find_compiler()
    texts = (source.record, source.lanes, *source.files.values())
    key = cache.key_of(*texts, compiler.identity)
    return CompiledFilter(cache.find(key) or make(key, source, compiler))
