"""Every filter over many records: ``python reproduce.py`` writes tables.md, tables.csv, losses.png.

The exit status is 1 if an ordering of the filters does not hold by four standard errors, or if the
page quotes a number that the tables do not have.
"""

from __future__ import annotations

import argparse
import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import losses
import numpy as np
from figure import draw
from losses import OUTAGE, STUDIES, Floats, Records, Study

import fkgen

RUNS, SEED = 2000, 7
LEAST_Z = 4.0
LOCKED = (losses.LLR, "nis, alpha .01", losses.ENERGY, losses.CONSTANT)
BINS = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0, np.inf)
ORDER = (losses.TRUTH, losses.KNOWN, losses.LLR, losses.NAHI, losses.BLIND)
"""From the smallest to the largest error, in the studies with losses that are spread."""

HEADING = """# Losses in numbers

Written by `reproduce.py`: {runs} runs of {samples} samples of each study, filtered in C, seed
{seed}. RMS: of the first state of x(k|k), over all samples and runs, +- one standard error; stated:
the root of the mean variance that the filter states. False: share of the good samples declared
lost; found: share of the lost ones.
"""
Rows = list[Sequence[str]]


@dataclass(frozen=True)
class Result:
    """One filter over the records of a study.

    Attributes
    ----------
    squares : (M,) ndarray
        Mean squared error of every run.
    stated : float
        Mean variance that the filter states.
    declared : (M, T) ndarray of bool
        Samples declared lost; (M, 0) without a detector.
    """

    squares: Floats
    stated: float
    declared: Floats

    @property
    def rms(self) -> float:
        """Root of the mean squared error."""
        return float(np.sqrt(self.squares.mean()))

    @property
    def error(self) -> float:
        """Its standard error, to first order."""
        spread = self.squares.std(ddof=1) / np.sqrt(self.squares.size)
        return float(spread / (2.0 * self.rms))


def run(name: str, spec: fkgen.Spec, records: Records) -> Result:
    """Filter all records of a study."""
    compiled = fkgen.build(spec)
    tests = "fault_declared" in compiled.ports
    keep = ["filtered_state", "filtered_covariance", *(["fault_declared"] if tests else [])]
    out = compiled.run_batch(losses.seen(name, records), keep=keep)
    if np.any(out.status < 0):
        raise SystemExit(f"{name}: refused samples")
    squares = (out.filtered_state[..., 0] - records.state) ** 2
    declared = out.fault_declared > 0.5 if tests else np.empty((len(squares), 0), bool)
    return Result(squares.mean(axis=1), float(out.filtered_covariance[..., 0, 0].mean()), declared)


def rates(result: Result, lost: Floats) -> tuple[float, float]:
    """Shares of good and of lost samples that are declared lost."""
    return float(result.declared[~lost].mean()), float(result.declared[lost].mean())


def main_table(results: Mapping[str, Result], records: Records) -> Rows:
    """Errors, and what the detectors do."""
    rows: Rows = [["filter", "RMS", "stated", "false", "found"]]
    for name, each in results.items():
        shares = rates(each, records.lost) if each.declared.size else ()
        decided = [f"{share:.4f}" for share in shares] or ["", ""]
        error = f"{each.rms:.4f} +- {each.error:.4f}"
        rows.append([name, error, f"{np.sqrt(each.stated):.4f}", *decided])
    return rows


def lock_table(results: Mapping[str, Result]) -> Rows:
    """False alarms before the outage, where no sample has been lost yet."""
    rows: Rows = [["detector", "declared, no sample lost so far", "mean length of a row of them"]]
    for name in LOCKED:
        before = results[name].declared[:, : OUTAGE.start]
        starts = before & ~np.pad(before, ((0, 0), (1, 0)))[:, :-1]
        rows.append([name, f"{before.mean():.4f}", f"{before.sum() / max(1, starts.sum()):.1f}"])
    return rows


def open_table(study: Study, records: Records) -> Rows:
    """The same tests on the innovations of a filter that is told the losses: nothing comes back."""
    spec = losses.filters(study)[losses.KNOWN]
    out = fkgen.build(spec).run_batch(
        losses.seen(losses.KNOWN, records), keep=["predicted_state", "innovation_covariance"]
    )
    start = np.full((len(records.state), 1), spec.model.x0.values()[0, 0])
    before = np.hstack([start, out.predicted_state[:, :-1, 0]])
    nis = (records.measured[..., 0] - before) ** 2 / out.innovation_covariance[..., 0, 0]
    rows: Rows = [["test", "false / found"]]
    for name, bound in (("energy (the paper's rule)", 1.0), ("nis, alpha .01", 6.6349)):
        false, caught = ((nis[which] > bound).mean() for which in (~records.lost, records.lost))
        rows.append([name, f"{false:.4f} / {caught:.4f}"])
    return rows


def visible_table(study: Study, records: Records) -> Rows:
    """How many losses llr finds, by the size of the signal that it predicts."""
    spec = losses.filters(study)[losses.LLR]
    keep = ["predicted_state", "fault_declared", "mode_law"]
    out = fkgen.build(spec).run_batch(records.measured, keep=keep)
    faults = spec.faults.jump
    if faults is None:
        raise SystemExit("no modes")
    R = np.array([mode.R.values()[0, 0] for mode in faults.modes])
    sizes = np.abs(out.predicted_state[:, :-1, 0]) / np.sqrt(out.mode_law[:, 1:] @ R)
    lost, declared = records.lost[:, 1:], out.fault_declared[:, 1:] > 0.5
    rows: Rows = [["predicted signal over noise", "losses", "found"]]
    for low, high in pairwise(BINS):
        chosen = lost & (sizes >= low) & (sizes < high)
        title = f"{low:.0f} to {high:.0f}" if np.isfinite(high) else f"above {low:.0f}"
        rows.append([title, str(chosen.sum()), f"{declared[chosen].mean():.4f}"])
    return rows


def violations(study: Study, results: Mapping[str, Result]) -> list[str]:
    """Say which ordering does not hold, run by run."""
    found = []
    for smaller, larger in pairwise(ORDER):
        d = results[larger].squares - results[smaller].squares
        if not d.any():  # every loss is found: the same filter
            continue
        z = d.mean() / (d.std(ddof=1) / np.sqrt(d.size))
        if z < LEAST_Z:
            found.append(f"{study.title}: {larger} - {smaller}, z = {z:.1f}")
    return found


def markdown(tables: Mapping[str, Rows], runs: int) -> str:
    """Lay the tables out."""
    lines = [HEADING.format(runs=runs, samples=losses.SAMPLES, seed=SEED).rstrip()]
    for title, (head, *body) in tables.items():
        lines += ["", f"## {title}", ""]
        rule = ["---", *["---:"] * (len(head) - 1)]
        lines += ["| " + " | ".join(row) + " |" for row in (head, rule, *body)]
    return "\n".join(lines) + "\n"


def unsupported(page: str, tables: str) -> list[str]:
    """Find what the page quotes with three decimals or more, and no table has."""
    return [each for each in re.findall(r"\d+\.\d{3,}", page) if each not in tables]


def examine(runs: int) -> tuple[dict[str, Rows], list[str]]:
    """Simulate, filter, and make the tables; the second value names what does not hold."""
    records = {study: losses.simulate(study, runs, SEED) for study in STUDIES}
    found = {
        study: {name: run(name, spec, seen) for name, spec in losses.filters(study).items()}
        for study, seen in records.items()
    }
    spread, outage, far = STUDIES
    tables = {study.title: main_table(found[study], records[study]) for study in STUDIES} | {
        "Locked out: before the outage": lock_table(found[outage]),
        "Tests whose verdicts do not come back": open_table(spread, records[spread]),
        "Which losses can be seen": visible_table(spread, records[spread]),
    }
    return tables, [text for study in (spread, far) for text in violations(study, found[study])]


def main() -> None:
    """Write the tables and the figure."""
    parser = argparse.ArgumentParser(description="compare detectors of lost samples")
    parser.add_argument("--runs", type=int, default=RUNS)
    runs = parser.parse_args().runs
    tables, wrong = examine(runs)
    text = markdown(tables, runs)
    print(text)
    (losses.HERE / "tables.md").write_text(text, encoding="utf-8")
    with (losses.HERE / "tables.csv").open("w", encoding="utf-8", newline="") as file:
        out = csv.writer(file, lineterminator="\n")
        for title, rows in tables.items():
            out.writerows([title, *row] for row in rows)
    draw().savefig(losses.HERE / "losses.png", dpi=110, metadata={"Software": None})
    page = (losses.HERE / "README.md").read_text(encoding="utf-8")
    wrong += [f"README.md quotes {each}" for each in unsupported(page, text)]
    if wrong:
        raise SystemExit("\n".join(wrong))


if __name__ == "__main__":
    main()
