"""A table, for the terminal and for Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from rich.console import Console
from rich.table import Table as RichTable

#: Points (n, value) of each curve, and the unit of the values.
Figure = tuple[dict[str, list[tuple[int, float]]], str]


@dataclass
class Table:
    """Rows of text under a header.

    Attributes
    ----------
    title : str
    columns : sequence of str
    note : str
        What was measured, and what it is measured against.
    curves : dict of str to Figure
        Files of figures, and what they show.
    """

    title: str
    columns: Sequence[str]
    note: str
    rows: list[list[str]] = field(default_factory=list)
    curves: dict[str, Figure] = field(default_factory=dict)

    def add(self, *cells: object) -> None:
        """Append a row."""
        self.rows.append([str(cell) for cell in cells])

    def show(self, console: Console) -> None:
        """Print."""
        table = RichTable(title=self.title, caption=self.note, title_justify="left")
        for i, column in enumerate(self.columns):
            table.add_column(column, justify="right" if i else "left")
        for row in self.rows:
            table.add_row(*row)
        console.print(table)

    def section(self, effort: str) -> tuple[str, str]:
        """Title and text in Markdown; ``effort`` says how it was measured, if in no usual way."""
        rule = ["---", *["---:"] * (len(self.columns) - 1)]
        lines = [f"| {' | '.join(row)} |" for row in ([*self.columns], rule, *self.rows)]
        figures = [f"![{unit}]({name})\n" for name, (_, unit) in self.curves.items()]
        return self.title, "\n".join(["", f"{self.note}{effort}", "", *figures, *lines, "", ""])


def ns(seconds: float) -> str:
    """Nanoseconds, three digits."""
    value = seconds * 1e9
    return f"{value:.1f}" if value < 100 else f"{value:.0f}"


def times(ratio: float) -> str:
    """A ratio."""
    return f"{ratio:.2f}" if ratio < 10 else f"{ratio:.0f}"


def verdict(value: float, limit: float) -> str:
    """Whether a target is met."""
    return "met" if value <= limit else "missed"
