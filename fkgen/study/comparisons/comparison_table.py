"""The table of a comparison as texts: a column per filter, the genie first."""

from __future__ import annotations

from collections.abc import Sequence

from fkgen.study.comparisons.ranking import Comparison, Row


def table_of(comparison: Comparison) -> tuple[list[str], list[list[str]]]:
    """Head and rows; what no filter has is left out.

    Parameters
    ----------
    comparison : Comparison

    Returns
    -------
    head : list of str
    rows : list of list of str
        The quantity, then a text per filter.
    """
    filters = (comparison.genie, *comparison.rows)
    rows: list[list[object]] = [
        ["MSE / that of the genie", *(row.relative for row in filters)],
        *([f"rmse {name}", *(row.rmse[name] for row in filters)] for name in filters[0].rmse),
        ["NEES / states", *(row.nees for row in filters)],
        ["NIS / rows of y", *(row.nis for row in filters)],
        ["faults found", *(row.detected for row in filters)],
        ["delay, samples", *(row.delay for row in filters)],
        ["false alarms", *(row.false_alarms for row in filters)],
        ["flops of a step", *(row.footprint.operations for row in filters)],
        ["calls of log, exp, ..", *(row.footprint.calls for row in filters)],
        ["state, bytes", *(row.footprint.state for row in filters)],
        *_code(filters),
        ["nothing cheaper is as good", *("yes" if row.pareto else "" for row in filters)],
    ]
    texts = [[str(cell) for cell in row] for row in rows]
    return ["", *(row.label for row in filters)], [row for row in texts if set(row[1:]) != {"-"}]


def _code(filters: Sequence[Row]) -> list[list[object]]:
    """Bytes of code, a row per target."""
    targets = dict.fromkeys(key for row in filters for key in row.footprint.flash)
    return [
        [f"code {key}, bytes", *(row.footprint.flash.get(key, "-") for row in filters)]
        for key in targets
    ]


def markdown(comparison: Comparison) -> str:
    """The same table for a page, with the recommendation and the notes below it."""
    head, rows = table_of(comparison)
    rule = ["---", *("---:" for _ in head[1:])]
    lines = [_line(cells) for cells in (head, rule, *rows)]
    notes = [f"- {note}" for note in comparison.notes]
    return "\n".join([*lines, "", comparison.recommendation, "", *notes]) + "\n"


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
