"""Confront a filter with everything at hand: literature, Riccati solver, interpreter, compilers.

`fkgen.validate` runs the closed forms before any C is generated. Here the compiled C is on trial as
well: against CasADi, against NumPy statement by statement, and by the self-test it ships with.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial

from fkgen.backend.lower import generate
from fkgen.backend.source import Source
from fkgen.families import family
from fkgen.oracle.theorems.identity import Identity
from fkgen.problem import Spec
from fkgen.proof import agreement, selftest, steady_state
from fkgen.proof.validate import validate
from fkgen.symbolic.recursion import Recursion
from fkgen.symbolic.validated import Claim, Validated


@dataclass(frozen=True, slots=True)
class Step:
    """One stretch of work."""

    title: str  # What is done, for whoever waits
    run: Callable[[], tuple[Claim, ...]]  # Does it; returns the claims that were tried


def verify(spec: Spec) -> tuple[Claim, ...]:
    """Run everything; whether each claim holds is for the caller to see."""
    return tuple(claim for step in steps(spec) for claim in step.run())


def steps(spec: Spec) -> tuple[Step, ...]:
    """What `verify` does, one after the other: run them in this order."""

    @cache
    def design() -> Validated:
        return validate(spec)

    def free() -> Recursion:
        """Without the ranges of the spec, in which a covariance cannot grow beyond all bounds."""
        own = design().recursion
        return family(spec.filter.family).build(spec) if own.ranged else own

    @cache
    def source() -> Source:
        return generate(design())

    def machine() -> tuple[Claim, ...]:
        return agreement.with_machine(source(), agreement.trial(spec))

    def compiled(compiler: selftest.Chosen) -> tuple[Claim, ...]:
        return selftest.claims(source(), compiler)

    return (
        Step("closed forms", lambda: design().claims),
        *(
            Step(f"theorem: {each.claim}", partial(_theorem, each))
            for each in family(spec.filter.family).theorems
        ),
        Step("Riccati equation by python-control", lambda: steady_state.claims(free())),
        Step("compiled C against NumPy", machine),
        Step("compiled C against CasADi", lambda: agreement.with_interpreter(design())),
        *(
            Step(f"self-test compiled by {each.name}", partial(compiled, each))
            for each in selftest.compilers()
        ),
    )


def _theorem(identity: Identity) -> tuple[Claim, ...]:
    source = f"SymPy and Coq, for all models of a size; {identity.source}"
    claim = selftest.fact(identity.claim, source, holds=identity.holds())
    return (replace(claim, standing=identity.standing),)
