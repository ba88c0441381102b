"""The stages in a row: Spec -> Validated -> Source -> CompiledFilter.

Each takes the value of the one before and returns a frozen one; only the last touches the disk. A
filter that was built before comes from the cache by its spec, without CasADi: stages are imported
when they are needed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from fkgen.errors import of_type
from fkgen.problem.spec import as_spec
from fkgen.runtime import cache
from fkgen.runtime.compiled import CompiledFilter
from fkgen.runtime.compiler import compile_source as compile
from fkgen.runtime.compiler import find_compiler, make

if TYPE_CHECKING:
    from fkgen.backend.source import Source
    from fkgen.problem import Spec
    from fkgen.symbolic.validated import Validated

__all__ = ["build", "compile", "generate", "validate"]


def validate(spec: Spec) -> Validated:
    """Build the recursion of a spec and run every closed form of its family.

    Raises
    ------
    ValidationError
        If one is contradicted: a defect of fkgen, never of the spec.
    """
    from fkgen.proof import validate as proof  # noqa: PLC0415 - see above

    return proof.validate(as_spec(spec))


def generate(design: Validated) -> Source:
    """Generate the C code of one validated filter. Nothing is written to disk."""
    from fkgen.backend import lower as backend  # noqa: PLC0415 - see above
    from fkgen.symbolic.validated import Validated  # noqa: PLC0415 - see above

    return backend.generate(of_type("design", design, Validated, "what fkgen.validate returns"))


def build(spec: Spec) -> CompiledFilter:
    """Validate, generate and compile in one; a spec that was built before is only loaded.

    Raises
    ------
    ValidationError, CompilerError, OutputError
        As the stages do.
    """
    spec = as_spec(spec)
    found = None if ":" in spec.filter.family else cache.find(_key(spec))  # else it is not fkgen's
    return CompiledFilter(found) if found else kept(spec, generate(validate(spec)))


def kept(spec: Spec, source: Source) -> CompiledFilter:
    """Compile the code of a spec so that `build` finds it."""
    if ":" in spec.filter.family:  # its code is not fkgen's, so it has no digest here
        return compile(source)
    key = _key(spec)
    return CompiledFilter(cache.find(key) or make(key, source, find_compiler()))


def _key(spec: Spec) -> str:
    written = (f"{key} = {text}" for each in spec.equations for key, text in each.written)
    return cache.key_of(cache.own_digest(), spec.canonical(), *written, find_compiler().identity)
