"""Make an entry of the cache from generated code, and a filter from an entry."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from fkgen.runtime import cache
from fkgen.runtime.compiled import CompiledFilter
from fkgen.runtime.compiler import Compiler, compile_shared, find_compiler
from fkgen.runtime.layout import Layout, layout_of

if TYPE_CHECKING:
    from fkgen.backend.source import Source


def make(key: str, source: Source, compiler: Compiler) -> Path:
    """Compile generated code into the cache; the folder of the finished entry."""
    program = source.program

    def fill(folder: Path) -> None:
        for name, text in source.files.items():
            (folder / name).write_text(text, encoding="utf-8")
        record = folder / f"{program.name}_record.c"
        record.write_text(source.record, encoding="utf-8")
        compile_shared(compiler, record, folder / cache.LIBRARY, flops=program.flops)
        layout = layout_of(program, source.claims)
        (folder / cache.LAYOUT).write_text(layout.to_json(), encoding="utf-8")

    return cache.store(key, fill)


def compile_source(source: Source) -> CompiledFilter:
    """Compile generated code into a filter that runs from Python; cached by content.

    Raises
    ------
    CompilerError
        If there is no C compiler or it refuses the code.
    OutputError
        If the cache folder cannot be written.
    """
    compiler = find_compiler()
    key = cache.key_of(source.record, *source.files.values(), compiler.identity)
    return load(cache.find(key) or make(key, source, compiler))


def load(entry: Path) -> CompiledFilter:
    """Load a finished entry."""
    layout = Layout.from_json((entry / cache.LAYOUT).read_text(encoding="utf-8"))
    return CompiledFilter(layout, entry / cache.LIBRARY)
