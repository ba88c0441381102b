"""The stages in a row.

    Spec -> Validated -> Source -> CompiledFilter

A spec is what the user says. Validation builds the recursion symbolically and confronts it with
closed forms that share no code with it; only what agrees goes on. Generation lowers the recursion
to a C program held as data and prints it. Compilation makes a shared library, once per content,
and loads it. Each stage takes the value of the one before and returns a frozen one; only the last
touches the disk.

A filter that was built before comes from the cache by its spec, without CasADi: stages are
imported when they are needed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from fkgen.runtime import cache
from fkgen.runtime.compiler import find_compiler
from fkgen.runtime.library import load, make
from fkgen.runtime.sampler import CompiledSampler, make_sampler

if TYPE_CHECKING:
    from fkgen.backend.sampler import SamplerSource
    from fkgen.backend.source import Source
    from fkgen.proof import Validated
    from fkgen.runtime.compiled import CompiledFilter
    from fkgen.spec import Spec


def validate(spec: Spec) -> Validated:
    """Build the recursion of a spec and run every closed form of its family.

    Raises
    ------
    ValidationError
        If one is contradicted: a defect of fkgen, never of the spec.
    """
    from fkgen import proof  # noqa: PLC0415 - see above

    return proof.validate(spec)


def generate(design: Validated) -> Source:
    """Generate the C code of one validated filter. Nothing is written to disk."""
    from fkgen.backend.lower import lower  # noqa: PLC0415 - see above
    from fkgen.backend.render import render  # noqa: PLC0415 - see above

    return render(lower(design.recursion), tuple(claim.claim for claim in design.claims))


def compile(source: Source) -> CompiledFilter:
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


def build(spec: Spec) -> CompiledFilter:
    """Validate, generate and compile in one; a spec that was built before is only loaded.

    Raises
    ------
    ValidationError, CompilerError, OutputError
        As the stages do.
    """
    compiler = find_compiler()
    key = cache.key_of(cache.own_digest(), spec.canonical(), compiler.identity)
    return load(cache.find(key) or make(key, generate(validate(spec)), compiler))


def sampler(spec: Spec) -> CompiledSampler:
    """Write the plant and the faults of a spec as C that draws trials, compile and load it.

    Raises
    ------
    SpecError
        If the spec does not say how its faults come about.
    CompilerError, OutputError
        As `compile` does.
    """
    compiler = find_compiler()
    key = cache.key_of("sampler", cache.own_digest(), spec.canonical(), compiler.identity)
    return CompiledSampler(cache.find(key) or make_sampler(key, _sampler_source(spec), compiler))


def _sampler_source(spec: Spec) -> SamplerSource:
    from fkgen.backend.sampler import lower_sampling, render_sampler  # noqa: PLC0415 - see above
    from fkgen.symbolic.sampling import sampling_of  # noqa: PLC0415 - see above

    return render_sampler(lower_sampling(sampling_of(spec)))
