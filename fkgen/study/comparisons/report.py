"""A comparison as a table and as a figure: error against cost, with what nothing cheaper beats."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fkgen.study.comparisons.footprint import CALL
from fkgen.study.comparisons.ranking import Comparison, Row
from fkgen.study.reports.plots import BLUE, GREY, ORANGE, styled


@styled
def draw_comparison(comparison: Comparison) -> Figure:
    """Draw every filter as a point with its standard error, the Pareto front as a line."""
    figure = Figure(figsize=(7.5, 4.8), layout="constrained")
    axis = figure.subplots()
    rows = sorted(comparison.rows, key=lambda row: row.footprint.cost)
    front = [row for row in rows if row.pareto]
    costs, errors = [row.footprint.cost for row in front], [row.relative.value for row in front]
    axis.step(costs, errors, where="post", color=BLUE, lw=1.2, alpha=0.6, label="Pareto front")
    for at, row in enumerate(rows):
        colour, place = BLUE if row.pareto else GREY, (row.footprint.cost, row.relative.value)
        shape, label, weight = "o" if row.pareto else "s", row.label, "normal"
        axis.errorbar(*place, yerr=row.relative.error, fmt=shape, color=colour, capsize=3, ms=6)
        if row.label == comparison.recommended:
            label, colour, weight = f"{row.label} (recommended)", ORANGE, "bold"
        near = (6, 7 if at % 2 == 0 else -13)  # above or below, so that neighbours fit
        text = axis.annotate(label, place, near, textcoords="offset points", color=colour)
        text.set(fontsize=9, fontweight=weight)
    axis.axhline(1.0, color="black", lw=0.8, ls=":", label="genie, told every fault")
    _scale(axis, rows)
    axis.set_xlabel(f"operations of a step, a call of log or exp counted as {CALL}")
    axis.set_ylabel("mean squared error / that of the genie")
    title = f"{comparison.name}: {comparison.runs} trials of {comparison.steps} samples"
    axis.set_title(title, fontsize=10)
    axis.grid(axis="y", lw=0.4, alpha=0.5)
    axis.tick_params(which="both", labelsize=8)
    axis.legend()
    return figure


def _scale(axis: Axes, rows: Sequence[Row]) -> None:
    """Logarithmic costs, room for names, and logarithmic errors where they are far apart."""
    axis.set_xscale("log")
    low, high = rows[0].footprint.cost, rows[-1].footprint.cost
    axis.set_xlim(low / 1.3, high * (2.2 if high > low else 1.6))
    axis.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.xaxis.set_minor_formatter(lambda x, _: f"{x:g}" if f"{x:e}"[0] in "25" else "")
    highest = float(np.nanmax([row.relative.value for row in rows]))
    if highest > 10.0:
        axis.set_yscale("log")
        axis.set_ylim(0.5, 3.0 * highest)
    else:
        top = 1.0 + 1.15 * max(0.05, highest - 1.0)
        axis.set_ylim(1.0 - 0.12 * (top - 1.0), top)


def table_of(comparison: Comparison) -> tuple[list[str], list[list[str]]]:
    """Head, and rows of the quantity and a text per filter; what no filter has is left out."""
    filters = (comparison.genie, *comparison.rows)
    targets = dict.fromkeys(key for row in filters for key in row.footprint.flash)
    lines: dict[str, Iterable[object]] = {
        "MSE / that of the genie": (row.relative for row in filters),
        **{f"rmse {name}": [row.rmse[name] for row in filters] for name in filters[0].rmse},
        "NEES / states": (row.nees for row in filters),
        "NIS / rows of y": (row.nis for row in filters),
        "faults found": (row.detected for row in filters),
        "delay, samples": (row.delay for row in filters),
        "false alarms": (row.false_alarms for row in filters),
        "flops of a step": (row.footprint.operations for row in filters),
        "calls of log, exp, ..": (row.footprint.calls for row in filters),
        "state, bytes": (row.footprint.state for row in filters),
        **{f"code {t}, bytes": [r.footprint.flash.get(t, "-") for r in filters] for t in targets},
        "nothing cheaper is as good": ("yes" if row.pareto else "" for row in filters),
    }
    texts = [[name, *map(str, cells)] for name, cells in lines.items()]
    return ["", *(row.label for row in filters)], [row for row in texts if set(row[1:]) != {"-"}]


def markdown(comparison: Comparison) -> str:
    """The same table for a page, with the recommendation and the notes below it."""
    head, rows = table_of(comparison)
    rule = ["---", *("---:" for _ in head[1:])]
    lines = [f"| {' | '.join(line)} |" for line in (head, rule, *rows)]
    notes = [f"- {note}" for note in comparison.notes]
    return "\n".join([*lines, "", comparison.recommendation, "", *notes, ""])
