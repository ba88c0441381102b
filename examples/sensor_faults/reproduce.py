"""Section VI again: ``python reproduce.py`` writes tables.md, tables.csv and errors.png.

The exit status is 1 if an ordering of the filters does not hold by four standard errors, or if the
page quotes a number that the tables do not have.
"""

from __future__ import annotations

import csv
import multiprocessing
import os
import re
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np
import section_vi as vi
from errors import Errors, Estimate, mean
from figure import draw
from slips import SLIPS, one_step

import fkgen

THREE = f"{vi.IMM}, 3 modes"
TIMES = (1, 2, 3, 5, 10, 50)
ORDERED = {  # the smaller error, the larger error: by four standard errors in these studies
    (vi.GENIE, vi.IMM): vi.STUDIES,
    (vi.IMM, vi.ONE_STEP): (vi.EXAMPLE_1, vi.BURSTS),
    (vi.ONE_STEP, vi.LINEAR): (*vi.STUDIES, vi.REDRAWN),
    (vi.AUGMENTED, vi.LINEAR): (vi.EXAMPLE_1, vi.BURSTS),
    (vi.NAIVE_MEAN, vi.LINEAR): (vi.EXAMPLE_1,),
}
LEAST_Z = 4.0
STATED = (
    "paper: linear is worse than one_step",
    "not in the paper",
    "paper: linear is better than one_step",
)
HEADING = (
    "# Section VI in numbers",
    "",
    f"Written by `reproduce.py`: {vi.RUNS} runs of samples 0 to {vi.SAMPLES - 1}, filtered in C.",
    "MSE: mean squared error of x(k|k) over samples 50 to 100; as a ratio: over that of the genie.",
    "NEES: mean of the squared error over the variance that the filter states; an honest filter",
    "has 1. +- one standard error.",
)
Rows = list[Sequence[str]]


@dataclass(frozen=True)
class Result:
    """One study.

    Attributes
    ----------
    study : Study
        Its law.
    errors : mapping of str to Errors
        By filter, all run in C.
    slips : mapping of str to Errors
        Of the one-step filter in NumPy, by slip.
    apart : mapping of str to float
        Largest differences between estimates that should be the same.
    """

    study: vi.Study
    errors: Mapping[str, Errors]
    slips: Mapping[str, Errors]
    apart: Mapping[str, float]

    def difference(self, first: str, second: str) -> Estimate:
        """MSE of the first minus MSE of the second filter, paired over runs."""
        return mean(self.errors[first].each - self.errors[second].each)


def examine(study: vi.Study) -> Result:
    """Simulate a study and run every filter over it."""
    runs, specs, state, errors = vi.simulate(study), vi.filters(study), {}, {}
    for name, spec in specs.items():
        state[name], variance = vi.estimates(fkgen.build(spec), runs)
        errors[name] = Errors.of(runs.state, state[name], variance)
    del errors[THREE]
    sensor = specs[vi.ONE_STEP].faults.sensor
    law = np.array(sensor.kernel), np.array(sensor.initial)
    again = {slip: one_step(runs.measured[..., 0], *law, slip) for slip in SLIPS}
    slips = {slip: Errors.of(runs.state, *found) for slip, found in again.items()}
    apart = {
        "imm with 3 and with 4 modes": state[THREE] - state[vi.IMM],
        "imm and one_step": state[vi.IMM] - state[vi.ONE_STEP],
        "one_step in C and in NumPy": state[vi.ONE_STEP] - again["none"][0],
    }
    return Result(study, errors, slips, {name: float(np.abs(d).max()) for name, d in apart.items()})


def cost(name: str, spec: fkgen.Spec) -> Sequence[str]:
    """Name, operations and size of an instance, from the generated header."""
    header = fkgen.generate(fkgen.validate(spec)).files[f"{spec.name}.h"]
    step = re.search(r"Cost of one step with every row present: (.*)\.\n", header)
    size = re.search(r"An instance is (\d+) doubles", header)
    if step is None or size is None:
        message = f"the header of {name} does not state its cost"
        raise SystemExit(message)
    operations = step[1].replace(" floating-point operations", "").replace(" and ", ", ")
    return name, operations, str(8 * int(size[1]))


def main_table(results: Sequence[Result]) -> Rows:
    """Ratio to the genie and NEES of every filter in every study."""
    rows: Rows = [["filter"]]
    for result in results:
        rows[0] = [*rows[0], result.study.title, "NEES"]
    for name in results[0].errors:
        row = [name]
        for result in results:
            errors, genie = result.errors[name], result.errors[vi.GENIE]
            over = f"1 (MSE {genie.mse})" if errors is genie else f"{errors.over(genie)}"
            row += [over, f"{errors.nees:.3f}"]
        rows.append(row)
    return rows


def time_table(results: Sequence[Result]) -> Rows:
    """Ratios in single samples."""
    rows: Rows = [["study", "filter", *(f"k = {k}" for k in TIMES)]]
    for result in results:
        for name in (vi.LINEAR, vi.ONE_STEP, vi.IMM):
            at = [result.errors[name].over_at(result.errors[vi.GENIE], k) for k in TIMES]
            rows.append([result.study.title, name, *(f"{each:.3f}" for each in at)])
    return rows


def pair_table(results: Sequence[Result]) -> Rows:
    """Paired differences of the mean squared errors."""
    rows: Rows = [["study", "difference", "MSE", "z"]]
    for result in results:
        for smaller, larger in ORDERED:
            d = result.difference(larger, smaller)
            rows.append([result.study.title, f"{larger} - {smaller}", f"{d:.5f}", f"{d.z:+.1f}"])
    return rows


def slip_table(results: Sequence[Result]) -> Rows:
    """The one-step filter with a slip beside the linear filter."""
    rows: Rows = [["one_step", *(result.study.title for result in results)]]
    for slip, text in SLIPS.items():
        over = (r.slips[slip].over(r.errors[vi.GENIE]) for r in results)
        rows.append([text, *(f"{each}" for each in over)])
    linear = (r.errors[vi.LINEAR].over(r.errors[vi.GENIE]) for r in results)
    rows.append([vi.LINEAR, *(f"{each}" for each in linear)])
    return rows


def belief_table(results: Sequence[Result]) -> Rows:
    """What the linear filters say of their error, and what it is."""
    rows: Rows = [["study", "filter", "MSE it states", "its MSE"]]
    for result in results:
        for name in (vi.LINEAR, vi.AUGMENTED):
            errors = result.errors[name]
            rows.append([result.study.title, name, f"{errors.believed:.4f}", f"{errors.mse}"])
    return rows


def same_table(results: Sequence[Result]) -> Rows:
    """Largest differences between estimates."""
    rows: Rows = [["largest difference", *(result.study.title for result in results)]]
    for what in results[0].apart:
        rows.append([what, *(f"{result.apart[what]:.1e}" for result in results)])
    return rows


def markdown(tables: Mapping[str, Rows]) -> str:
    """Lay the tables out."""
    law = f"E[gamma] = {vi.MEAN_GAMMA:.4f}, p11 = {vi.P11:.4f}"
    lines = [*HEADING, "", f"Example 2: {law}, p11 - E[gamma] = {vi.P11 - vi.MEAN_GAMMA:.5f}."]
    for title, (head, *body) in tables.items():
        lines += ["", f"## {title}", ""]
        rule = ["---", *["---:"] * (len(head) - 1)]
        lines += ["| " + " | ".join(row) + " |" for row in (head, rule, *body)]
    return "\n".join(lines) + "\n"


def violations(results: Sequence[Result]) -> list[str]:
    """Say which ordering does not hold."""
    found = []
    for result in results:
        for (smaller, larger), studies in ORDERED.items():
            d = result.difference(larger, smaller)
            if result.study in studies and d.z < LEAST_Z:
                found.append(f"{result.study.title}: {larger} - {smaller} = {d}, z = {d.z:.1f}")
    return found


def unsupported(page: str, tables: str) -> list[str]:
    """Find what the page quotes, costs and all with three decimals or more, and no table has."""
    numbers = re.findall(r"\d+\.\d{3,}", page)
    costs = re.findall(r"\| \d+, [^|]*log \| \d+ \|", page)
    return [each for each in (*numbers, *costs) if each not in tables]


def main() -> None:
    """Write the tables and the figure."""
    start = time.perf_counter()
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(os.cpu_count(), mp_context=spawn) as workers:
        studies = [workers.submit(examine, study) for study in (*vi.STUDIES, vi.REDRAWN)]
        specs = vi.filters(vi.EXAMPLE_1).items()
        costs = [workers.submit(cost, *each) for each in specs]
        everything = [each.result() for each in studies]
        price = [each.result() for each in costs]
    results = everything[: len(vi.STUDIES)]
    tables = {
        "Errors over those of the genie": main_table(results),
        "In single samples": time_table(results),
        "Differences of MSE, run by run": pair_table(everything),
        "What the linear filters state": belief_table(results),
        "Slips in the one-step filter": slip_table(results),
        "Estimates that agree": same_table(results),
        "Cost of one step of the C code": [["filter", "operations", "instance, bytes"], *price],
    }
    text = markdown(tables)
    (vi.HERE / "tables.md").write_text(text, encoding="utf-8")
    with (vi.HERE / "tables.csv").open("w", encoding="utf-8", newline="") as file:
        out = csv.writer(file, lineterminator="\n")
        for title, rows in tables.items():
            out.writerows([title, *row] for row in rows)
    figure = draw([(r.study, r.errors) for r in results], STATED)
    figure.savefig(vi.HERE / "errors.png", dpi=110, metadata={"Software": None})
    print(text)
    print(f"{time.perf_counter() - start:.0f} s")
    page = (vi.HERE / "README.md").read_text(encoding="utf-8")
    missing = [f"README.md quotes {each}" for each in unsupported(page, text)]
    if wrong := [*violations(everything), *missing]:
        raise SystemExit("\n".join(wrong))


if __name__ == "__main__":
    main()
