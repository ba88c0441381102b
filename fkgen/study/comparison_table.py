"""The table of a comparison as texts: one row per filter, the genie first."""

from __future__ import annotations

from collections.abc import Sequence

from fkgen.study.verdict import Comparison, Row

_STATES = 4  # columns of states; the rest are in the JSON text


def table_of(comparison: Comparison) -> tuple[list[str], list[list[str]]]:
    """Head and rows.

    Parameters
    ----------
    comparison : Comparison

    Returns
    -------
    head : list of str
    rows : list of list of str
    """
    states = list(comparison.genie.rmse)[:_STATES]
    targets = list(dict.fromkeys(key for row in comparison.rows for key in row.footprint.flash))
    declared = any(str(row.false_alarms) != "-" for row in comparison.rows)
    head = ["filter", "MSE / genie", *(f"rmse {state}" for state in states), "NEES", "NIS"]
    head += ["detected", "delay", "false alarms"] if declared else []
    head += ["flops", "calls", "state, B", *(f"{target}, B" for target in targets), "Pareto"]
    rows = [
        _cells(row, states, targets, declared=declared)
        for row in (comparison.genie, *comparison.rows)
    ]
    return head, rows


def _cells(row: Row, states: Sequence[str], targets: Sequence[str], *, declared: bool) -> list[str]:
    cells = [row.label, str(row.relative), *(str(row.rmse[state]) for state in states)]
    cells += [str(row.nees), str(row.nis)]
    cells += [str(row.detected), str(row.delay), str(row.false_alarms)] if declared else []
    cost = row.footprint
    cells += [str(cost.operations), str(cost.calls), str(cost.state)]
    cells += [str(cost.flash.get(target, "-")) for target in targets]
    return [*cells, "yes" if row.pareto else ""]


def markdown(comparison: Comparison) -> str:
    """The same table for a page, with the recommendation and the notes below it."""
    head, rows = table_of(comparison)
    rule = ["---", *("---:" for _ in head[1:])]
    lines = [f"| {' | '.join(cells)} |" for cells in (head, rule, *rows)]
    notes = [f"- {note}" for note in comparison.notes]
    return "\n".join([*lines, "", comparison.recommendation, "", *notes]) + "\n"
