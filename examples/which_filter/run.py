"""Which filter? ``python run.py`` writes tables.md and the figures, in about a minute.

Three plants: the scalar system of Sigalov & Oshman, section VI, with the faults of example 1 and of
example 2, and a quadcopter whose GPS goes wrong. The exit status is 1 if README.md quotes a line
that the tables do not have.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import fkgen
from fkgen.study.comparisons.report import draw_comparison, markdown
from fkgen.study.records.table import read_table
from fkgen.study.reports.plots import rendered

HERE = Path(__file__).resolve().parent
EXAMPLES = HERE.parent
SCALAR = ("imm", "one_step", "linear_optimal", "linear_optimal:form=augmented", "kf")
GPS = ("imm", "one_step", "linear_optimal:form=augmented", "kf")
SEED = 1


def comparisons() -> Iterator[tuple[str, str, fkgen.Comparison]]:
    """Title, name of the figure, and what was found."""
    for number in (1, 2):
        spec = fkgen.load(EXAMPLES / "sensor_faults" / f"example{number}.toml")
        found = fkgen.compare(spec, SCALAR, runs=10_000, steps=101, skip=50, seed=SEED)
        yield f"Scalar system, faults of example {number}", f"example{number}.png", found
    spec = fkgen.load(EXAMPLES / "gps_glitch" / "spec.toml")
    record = read_table(EXAMPLES / "gps_glitch" / "record.csv", spec)
    found = fkgen.compare(
        spec,
        GPS,
        runs=500,
        steps=len(record.y),
        skip=1000,
        seed=SEED,
        params=record.params,
        present=np.isfinite(record.y),
    )
    yield "Height of a quadcopter", "gps_glitch.png", found


def missing(page: str, text: str) -> list[str]:
    """Lines of tables on the page that no command wrote; bytes of code depend on the compiler."""
    quoted = [line for line in page.splitlines() if line.startswith(("| ", "Take "))]
    return [line for line in quoted if line not in text and not line.startswith("| code")]


def main() -> int:
    """Run as a script."""
    parts = ["# Which filter, in numbers", "", "Written by `run.py`.", ""]
    for title, figure, found in comparisons():
        text = markdown(found).replace(f"{EXAMPLES.parent}/", "")
        parts += [f"## {title}", "", f"![{title}]({figure})", "", text]
        path = HERE / figure
        path.write_bytes(rendered(draw_comparison(found), path))
        print(f"{title}: {found.recommendation}")
    text = "\n".join(parts)
    (HERE / "tables.md").write_text(text, encoding="utf-8")
    lines = missing((HERE / "README.md").read_text(encoding="utf-8"), text)
    for line in lines:
        print(f"README.md quotes what the tables do not have: {line}", file=sys.stderr)
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
