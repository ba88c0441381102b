"""From a proved recursion to C text: lower, then render."""

from __future__ import annotations

from fkgen.backend.lower import lower
from fkgen.backend.render import render
from fkgen.backend.source import Source
from fkgen.symbolic.validated import Validated


def generate(design: Validated) -> Source:
    """Generate the C code of one validated filter. Nothing is written to disk."""
    return render(lower(design.recursion), tuple(claim.claim for claim in design.claims))
