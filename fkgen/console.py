"""Tables on the terminal: texts as they are, plain where nobody looks."""

from __future__ import annotations

# ruff: noqa: PLC0415 - rich takes long to import
import sys
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console


def console(*, err: bool = False) -> Console:
    """A console that takes texts as they are, and does not fold lines where nobody looks."""
    from rich.console import Console

    seen = (sys.stderr if err else sys.stdout).isatty()
    width = None if seen else 200
    return Console(stderr=err, markup=False, highlight=False, emoji=False, width=width)


def print_table(head: Sequence[str], rows: Iterable[Sequence[Any]], **justify: Any) -> None:
    """Print rows of texts below their headings."""
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE, pad_edge=False)
    for name in head:
        table.add_column(name, justify=justify.get(name, "left"), overflow="fold")
    for row in rows:
        table.add_row(*row)
    console().print(table)
