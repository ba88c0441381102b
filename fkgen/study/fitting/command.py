"""What ``fkgen fit`` does: records in; a table, a picture and a spec file with estimates out."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fkgen.console import progressing
from fkgen.errors import DataError
from fkgen.problem import Spec
from fkgen.study.fitting.autocovariance import Autocovariance, autocovariance
from fkgen.study.fitting.domain import estimated
from fkgen.study.fitting.fit import Fit, fit, put_defaults
from fkgen.study.records.files import refuse_targets, write_whole
from fkgen.study.records.reading import Reading
from fkgen.study.records.table import Say, read_table, separated

HEAD = ("parameter", "default", "estimate", "standard error", "95 % from", "to")


@dataclass(frozen=True, slots=True)
class Fitted:
    """A fit as a command tells it."""

    fit: Fit
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    lines: Sequence[str]

    def to_json(self) -> str:
        """The fit as JSON."""
        return self.fit.to_json()


def fitted(
    spec: Spec,
    readings: Sequence[Reading],
    *,
    estimate: str,
    output: Path | None,
    plot: Path | None,
    force: bool,
    second: bool,
    say: Say,
) -> Fitted:
    """Fit the parameters to the records; write the spec file and the picture that are asked for."""
    refuse_targets(output, plot, force=force)
    names = separated(estimate)
    searched = [each.name for each in estimated(spec, names)]
    tables = [read_table(reading, spec, searched) for reading in readings]
    for table in tables:
        say("note", table.notes)
        say("warning", table.warnings)
    u = [table.u for table in tables] if spec.model.nu else None
    y, params = [table.y for table in tables], [table.params for table in tables]
    shown = sys.stderr.isatty()
    found = fit(spec, y, u, params, names, progress=shown)
    with progressing("intervals", len(found.names), shown=shown) as advance:
        found.interval(advance=advance)
    if output is not None:
        write_whole(output, renewed(spec, found).encode("utf-8"), force=force)
        say("note", [f"{output}: written"])
    if plot is not None:
        from fkgen.study.fitting.page import draw  # noqa: PLC0415 - slow to import
        from fkgen.study.reports.plots import save  # noqa: PLC0415

        save(draw(found), plot, force=force)
        say("note", [f"{plot}: written"])
    opinion = [] if not second else [judged(found, autocovariance(spec, y, u, params, searched))]
    return told(found, opinion)


def judged(found: Fit, other: Autocovariance) -> str:
    """How far the estimates are from those of autocovariances."""
    parts = []
    for name, value in other.estimates.items():
        apart = abs(value - found.estimates[name]) / found.standard_errors[name]
        away = f" ({apart:.2g} standard errors away)" if math.isfinite(apart) else ""
        parts.append(f"{name} = {value:.6g}{away}")
    return f"autocovariance least squares: {', '.join(parts)}"


def told(found: Fit, opinion: Sequence[str] = ()) -> Fitted:
    """The table, and the sentences below it."""
    intervals = found.interval()
    rows = [
        [name, *(f"{value:.6g}" for value in numbers)]
        for name in found.names
        for numbers in [
            (
                found.before.defaults[name],
                found.estimates[name],
                found.standard_errors[name],
                *intervals[name],
            )
        ]
    ]
    gained = found.log_likelihood - found.initial_log_likelihood
    text = f"log-likelihood {found.log_likelihood:.10g}, {gained:.6g} above that of the defaults"
    text += f"; AIC {found.aic:.8g}, BIC {found.bic:.8g}"
    return Fitted(found, HEAD, rows, (text, found.message, *opinion))


def renewed(spec: Spec, found: Fit) -> str:
    """The text of the spec file with the estimates as defaults: its comments, its order."""
    import tomlkit  # noqa: PLC0415 - this command alone needs it

    try:
        text = Path(spec.file).read_bytes().decode("utf-8-sig")
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise DataError(spec.file, given=reason, expected="the spec file as it was read") from None
    document: Any = tomlkit.parse(text)
    put_defaults(document["parameters"], spec, found.estimates, _replace)
    return tomlkit.dumps(document)


def _replace(table: Any, name: str, value: float) -> None:
    """Put a number in the place of another; a comment behind it stays in its column."""
    import tomlkit  # noqa: PLC0415 - this command alone needs it

    item, old = tomlkit.item(value), table[name]
    space = old.trivia.comment_ws
    if space and not space.strip(" "):
        space = " " * max(1, len(old.as_string()) + len(space) - len(item.as_string()))
    item.trivia.comment_ws = space
    item.trivia.comment = old.trivia.comment
    table[name] = item
