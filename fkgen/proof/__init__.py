"""Confront a recursion with its closed forms; only what survives reaches the back end."""

from fkgen.proof.validate import Claim, Validated, confront, validate

__all__ = ["Claim", "Validated", "confront", "validate"]
