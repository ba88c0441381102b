"""A filter as a co-simulation unit of FMI: XML, sources and a library for this machine, zipped."""

from __future__ import annotations

import io
import platform
import tempfile
import zipfile
from pathlib import Path

from fkgen.backend.ir import CProgram
from fkgen.backend.lines import filled
from fkgen.backend.render import context_of
from fkgen.backend.source import Source
from fkgen.runtime.compiler import compile_shared, find_compiler
from fkgen.target.fmi import build_description, description, token_of

#: A year in which every file of the archive is written: the same spec gives the same bytes.
_TIME = (1980, 1, 1, 0, 0, 0)

_ENDINGS = {"Darwin": ".dylib", "Windows": ".dll"}
#: Names of machines in FMI 3; folders of version 2, which are as in 3 where it names none.
_MACHINES = {"AMD64": "x86_64", "arm64": "aarch64", "ARM64": "aarch64", "i686": "x86"}
_FOLDERS = {"x86_64-linux": "linux64", "x86_64-darwin": "darwin64", "x86_64-windows": "win64"}


def fmu(source: Source, version: int = 2) -> bytes:
    """The unit of a filter in version 2 or 3 of FMI, whose library is for this machine.

    Raises
    ------
    CompilerError
        If there is no compiler, or if it refuses the sources.
    """
    program = source.program
    context = context_of(program) | {"token": token_of(program)}
    sources = {name: text for name, text in source.files.items() if _is_source(program, name)}
    sources[f"fmi{version}.c"] = filled(f"fmi{version}.c.j2", context)
    listed = sorted(name for name in sources if name.endswith(".c"))
    files = {f"sources/{name}": text.encode("utf-8") for name, text in sources.items()}
    files["modelDescription.xml"] = description(program, version, listed)
    if version == 3:
        files["sources/buildDescription.xml"] = build_description(program, listed)
    name = f"{program.name}{_ENDINGS.get(platform.system(), '.so')}"
    files[f"binaries/{_folder(version)}/{name}"] = _library(program, sources, listed)
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as zipped:
        for name in sorted(files):
            zipped.writestr(zipfile.ZipInfo(name, _TIME), files[name], zipfile.ZIP_DEFLATED)
    return archive.getvalue()


def _is_source(program: CProgram, name: str) -> bool:
    return name.endswith((".c", ".h")) and not name.startswith(f"{program.name}_selftest")


def _folder(version: int) -> str:
    """Where tools look for the library of this machine."""
    machine = platform.machine()
    folder = f"{_MACHINES.get(machine, machine)}-{platform.system().lower()}"
    return _FOLDERS.get(folder, folder) if version == 2 else folder


def _library(program: CProgram, sources: dict[str, str], listed: list[str]) -> bytes:
    with tempfile.TemporaryDirectory(prefix="fkgen-") as folder:
        for file, text in sources.items():
            (Path(folder) / file).write_text(text, encoding="utf-8")
        whole, library = Path(folder) / "whole.c", Path(folder) / "library"
        whole.write_text("".join(f'#include "{each}"\n' for each in listed), encoding="utf-8")
        statements = program.statements
        compile_shared(find_compiler(), whole, library, statements=statements, native=False)
        return library.read_bytes()
