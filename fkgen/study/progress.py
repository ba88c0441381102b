"""Show how far long work is, on stderr and only if somebody wants to see it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from fkgen.runtime.blocks import Advance


def _silent(_: int) -> None:
    return


@contextmanager
def progressing(title: str, total: int, *, shown: bool) -> Iterator[Advance]:
    """A function to call with the number of pieces that were done since the last call.

    Parameters
    ----------
    title : str
        What is done.
    total : int
        Number of pieces.
    shown : bool
        If somebody is there to see it: nothing is written into files and pipes.
    """
    from rich.console import Console  # noqa: PLC0415 - slow to import
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn  # noqa: PLC0415

    console = Console(stderr=True)
    if not (shown and (console.is_terminal or console.is_jupyter)):
        yield _silent
        return
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(title, total=total)
        yield lambda done: bar.advance(task, done)
