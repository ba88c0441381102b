"""Confront a filter with everything at hand: literature, Riccati solver, interpreter, compilers.

`fkgen.validate` runs the closed forms before any C is generated. Here the compiled C is on trial as
well: against CasADi, against NumPy statement by statement, and by the self-test it ships with.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

from fkgen.backend.lower import generate
from fkgen.backend.source import Source
from fkgen.families import family
from fkgen.oracle.theorems.identity import Identity
from fkgen.problem import Spec
from fkgen.proof import agreement, selftest, steady_state
from fkgen.proof.validate import validate
from fkgen.symbolic.validated import Claim, Validated

__all__ = ["Claim", "Step", "steps", "verify"]


@dataclass(frozen=True, slots=True)
class Step:
    """One stretch of work."""

    title: str  # What is done, for whoever waits
    run: Callable[[], tuple[Claim, ...]]  # Does it; returns the claims that were tried


def verify(spec: Spec) -> tuple[Claim, ...]:
    """Run everything.

    Parameters
    ----------
    spec : Spec

    Returns
    -------
    tuple of Claim
        Whether each holds is for the caller to see.

    Raises
    ------
    ValidationError
        If a closed form is contradicted: there is no C then.
    CompilerError
        If there is no C compiler or it refuses the code.
    """
    return tuple(claim for step in steps(spec) for claim in step.run())


def steps(spec: Spec) -> tuple[Step, ...]:
    """What `verify` does, one after the other: run them in this order."""
    trial = _Trial(spec)
    theorems = family(spec.filter.family).theorems
    return (
        Step("closed forms", trial.closed_forms),
        *(Step(f"theorem: {each.claim}", partial(_theorem, each)) for each in theorems),
        Step("Riccati equation by python-control", trial.riccati),
        Step("compiled C against NumPy", trial.machine),
        Step("compiled C against CasADi", trial.interpreter),
        *(
            Step(f"self-test compiled by {each.name}", partial(trial.selftest, each))
            for each in selftest.compilers()
        ),
    )


class _Trial:
    """The stages of one spec, each made when it is first needed."""

    def __init__(self, spec: Spec) -> None:
        self.spec = spec

    @cached_property
    def design(self) -> Validated:
        return validate(self.spec)

    @cached_property
    def source(self) -> Source:
        return generate(self.design)

    def closed_forms(self) -> tuple[Claim, ...]:
        return self.design.claims

    def riccati(self) -> tuple[Claim, ...]:
        return steady_state.claims(self.design.recursion)

    def machine(self) -> tuple[Claim, ...]:
        return agreement.with_machine(self.source, agreement.trial(self.spec))

    def interpreter(self) -> tuple[Claim, ...]:
        return agreement.with_interpreter(self.design)

    def selftest(self, compiler: selftest.Chosen) -> tuple[Claim, ...]:
        return selftest.claims(self.source, compiler)


def _theorem(identity: Identity) -> tuple[Claim, ...]:
    """A theorem holds or it does not: there is no error in between."""
    error = 0.0 if identity.holds() else float("inf")
    source = f"SymPy, for all models of a size; {identity.source}"
    return (Claim(claim=identity.claim, source=source, error=error, tolerance=0.0),)
