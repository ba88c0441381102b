"""The text over lanes, from the program and what the other templates read."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from fkgen.backend import ir
from fkgen.backend.lanes.printer import LanesPrinter
from fkgen.backend.lines import filled
from fkgen.backend.size.stack import BYTES
from fkgen.symbolic.interface import Outcome, Port, Status

#: Statements of a step beyond which a compiler would work on the lanes for too long.
LARGEST = 8000

#: Functions over all lanes at once; others take one lane after the other.
WHOLE = frozenset((ir.Operator.EXP, ir.Operator.LOG))
_TWO = frozenset(("atan2", "hypot"))


def lanes_text(program: ir.CProgram, context: Mapping[str, Any], alone: Mapping[str, Any]) -> str:
    """C over lanes; empty where the program is too large for it.

    ``alone`` is what the template of elementary functions reads of those that are not in `WHOLE`.
    """
    if program.statements > LARGEST:
        return ""
    c = LanesPrinter(program)
    verbs = ("correct", "close_window", "propagate")
    own = {
        "c": c,
        "width": BYTES[program.scalar],
        "letter": "d" if program.scalar == "double" else "s",
        "functions": sorted(program.functions, key=lambda each: each.value),
        "whole": {each.value for each in program.functions & WHOLE},
        "two": _TWO,
        "alone": alone,
        "phases": [(verb, program.verbs[verb]) for verb in verbs if verb in program.verbs],
        "printed": c.phase,
        "place_of": _place_of,
        "full_places": {_place_of(port): places(port) for port in program.ports if port.symmetric},
        "outcomes": [
            (outcome.status.value, _above(c, program, outcome))
            for outcome in reversed(program.outcomes)
        ],
        "skipped": Status.SKIPPED.value,
    }
    return filled("lanes.c.j2", {**context, **own})


def _above(c: LanesPrinter, program: ir.CProgram, outcome: Outcome) -> str:
    """Mask of the lanes in which an outcome applies."""
    port = next(port for port in program.ports if port.name == outcome.port)
    places = [f"[{i}]" for i in range(port.size)] if port.shape else [""]
    level = c.literal(outcome.level)
    return " | ".join(f"({c.mask_type})(now->{port.member}{at} > {level})" for at in places)


def _place_of(port: Port) -> str:
    """Ports of one shape share a table."""
    return "x".join(map(str, port.shape))


def places(port: Port) -> list[int]:
    """Where each entry of full symmetric matrices is in what is stored."""
    found = port.unpacked(np.arange(port.size)).ravel()
    return [int(each) for each in found]
