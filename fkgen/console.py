"""Tables and progress on the terminal: texts as they are, plain where nobody looks."""

from __future__ import annotations

# ruff: noqa: PLC0415 - rich takes long to import
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

#: Called with the number of pieces that were done since the last call.
Advance = Callable[[int], object]


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


def html_table(caption: str, head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """The same for a notebook."""
    from html import escape

    def row(cells: Sequence[Any], tag: str) -> str:
        return f"<tr>{''.join(f'<{tag}>{escape(str(each))}</{tag[:2]}>' for each in cells)}</tr>"

    body = "".join(row(each, "td") for each in rows)
    top = row(head, 'th scope="col"')
    return f"<table><caption>{escape(caption)}</caption><thead>{top}</thead>{body}</table>"


@contextmanager
def counting(*, shown: bool) -> Iterator[Advance]:
    """The same where nobody knows how many there are: a terminal shows how many there were."""
    screen = console(err=True) if shown else None
    if screen is None or not screen.is_terminal:
        yield lambda _: None
        return
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (
        SpinnerColumn(),
        TextColumn("{task.completed:,.0f} samples", markup=False),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=screen, transient=True) as bar:
        task = bar.add_task("", total=None)
        yield lambda done: bar.advance(task, done)


@contextmanager
def progressing(title: str, total: int, *, shown: bool) -> Iterator[Advance]:
    """A function to call with the number of pieces done since; only a terminal shows the bar."""
    screen = console(err=True) if shown else None
    if screen is None or not (screen.is_terminal or screen.is_jupyter):
        yield lambda _: None
        return
    from rich.progress import (
        BarColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f}"),
        TimeElapsedColumn(),
        TextColumn("left:"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=screen, transient=True) as bar:
        task = bar.add_task(title, total=total)
        yield lambda done: bar.advance(task, done)
