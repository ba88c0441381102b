"""Templates from the wheel or the source tree, filled in; what those of the functions need."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import Any

import jinja2

from fkgen.backend.elementary import FORMATS
from fkgen.backend.ir import Operator
from fkgen.backend.printer import Printer


@cache
def environment() -> jinja2.Environment:
    """Templates from the wheel, or from the source tree."""
    here = Path(__file__).resolve().parents[1]
    folders = [here / "templates", here.parent / "templates"]
    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(folders),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,  # noqa: S701 - C, not HTML
    )


def filled(template: str, context: dict[str, object]) -> str:
    """A template filled in, without blanks at the end of lines and without gaps."""
    text = environment().get_template(template).render(context)
    lines = [line.rstrip() for line in text.splitlines()]
    kept = [line for i, line in enumerate(lines) if line or (i and lines[i - 1] not in ("", "{"))]
    return "\n".join(kept).rstrip() + "\n"


def elementary_context(c: Printer[Any], functions: frozenset[Operator]) -> dict[str, object]:
    """What the template of the elementary functions reads."""
    needs = {op.value: op in functions for op in Operator if op.is_function}
    needs["wave"] = needs["sin"] or needs["cos"] or needs["tan"]
    needs["scale"] = needs["exp"]
    needs["sqrt"] = needs["sqrt"] or needs["atan2"]
    return {
        "c": c,
        "name": c.name,
        "upper": c.upper,
        "real": c.real,
        "word": "uint64_t" if c.real == "double" else "uint32_t",
        "f": FORMATS[c.real],
        "needs": needs,
        "needs_elementary": bool(functions),
        "root2": math.sqrt(2.0),
        "ln2": math.log(2.0),
        "pi": math.pi,
    }
