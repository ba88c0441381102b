"""What was proved of a recursion: the only thing that becomes C."""

from __future__ import annotations

from dataclasses import dataclass

from fkgen.errors import ValidationError
from fkgen.problem import Spec
from fkgen.problem.finding import Finding
from fkgen.symbolic.recursion import Recursion


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """One statement and how well it held.

    Attributes
    ----------
    claim, source : str
    error, tolerance : float
        Largest relative error found, and allowed.
    standing : str
        What it stands on: "measured", or "symbolic and machine-checked" for a theorem.
    """

    claim: str
    source: str
    error: float
    tolerance: float
    standing: str = "measured"

    @property
    def holds(self) -> bool:
        """Whether the error is within the tolerance; a NaN is not."""
        return self.error <= self.tolerance

    def __str__(self) -> str:
        return (
            f"{self.claim} [{self.source}], off by {self.error:.1e}, allowed {self.tolerance:.1e}"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Validated:
    """A recursion that agreed with every closed form: the only thing that becomes C.

    Attributes
    ----------
    recursion : Recursion
    claims : tuple of Claim
        What was proved.
    findings : tuple of Finding
        Where the filter of this spec is less than its name says; the header repeats them.
    """

    recursion: Recursion
    claims: tuple[Claim, ...]
    findings: tuple[Finding, ...] = ()

    def __post_init__(self) -> None:
        failed = tuple(str(claim) for claim in self.claims if not claim.holds)
        if failed or not self.claims:
            raise ValidationError(self.spec.filter.family, failed or ("nothing was proved",))

    @property
    def spec(self) -> Spec:
        """What the recursion was built for."""
        return self.recursion.spec
