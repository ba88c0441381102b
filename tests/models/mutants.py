"""Recursions with a mistake in them, and what the proof says about those."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import pytest

from fkgen.errors import ValidationError
from fkgen.families import family
from fkgen.proof.validate import confront


def recursion(spec):
    return family(spec.filter.family).build(spec)


def proved(mutant):
    return confront(family(mutant.spec.filter.family), mutant)


def refusals(mutant):
    """The claims that do not hold, as one text."""
    with pytest.raises(ValidationError) as caught:
        proved(mutant)
    return "; ".join(caught.value.failed)


def rewritten(whole, prefix, change, *, phase="update"):
    """Change what a phase assigns to variables with this prefix.

    ``change(name, value, symbols)`` gives the new value.
    """
    written = getattr(whole, phase)
    symbols = written.symbols
    owner = {e.element_hash(): n for n, s in symbols.items() for e in ca.symvar(s)}
    blocks, found = [], False
    for block in written.blocks:
        assign = dict(block.assign)
        for name, value in block.assign.items():
            if name.startswith(prefix):
                assign[name], found = ca.densify(change(name, value, symbols)), True
        more = {owner[e.element_hash()] for v in assign.values() for e in ca.symvar(v)}
        reads = tuple(sorted({*block.reads, *more}))
        blocks.append(replace(block, assign=assign, reads=reads))
    assert found
    return replace(whole, **{phase: replace(written, blocks=tuple(blocks))})


def read_instead(whole, prefix, old, new):
    """Read another variable of the same size."""
    return rewritten(whole, prefix, lambda _, v, s: ca.substitute(v, s[old], s[new]))


def started(whole, **values):
    """Another start of the instance."""
    return replace(whole, initial={**whole.initial, **values})
