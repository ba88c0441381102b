"""What the header says about the model, as lines of a comment."""

from __future__ import annotations

from fkgen.backend.ir import Signal

#: Longest list of units that is written out.
_LONGEST = 60


def unit_of(signals: tuple[Signal, ...]) -> str:
    """Units of a vector, such as ``[m, m/s]``; empty if none is stated, or they are too many."""
    units = [signal.unit or "-" for signal in signals]
    if set(units) == {"-"} or not units:
        return ""
    text = f"[{', '.join(units if len(set(units)) > 1 else units[:1])}]"
    return text if len(text) <= _LONGEST else ""
