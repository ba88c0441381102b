"""The simulation again: ``python reproduce.py`` writes tables.md, tables.csv and soft_fault.png.

The exit status is 1 if a statement of the page does not hold by four standard errors, or if the
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

import noiseless
import numpy as np
import simulation as sim
from figure import draw
from outcome import Estimate, Outcome, mean

import fkgen

Rows = list[Sequence[str]]
TIMES = (600, 690, 720, 750, 780, 810, 840, 900, 990)
SHOWN = (sim.KF, sim.KF_TEST, sim.DFCF, sim.CPCF, sim.PAPER)
TESTED = (sim.DFCF, sim.LESS, sim.CPCF, sim.PAPER)
FAULT_FREE = range(sim.WINDOW, sim.FAULT, sim.WINDOW)
FAULTY = (720, 750, 780, 810, 840)
POSITIONS = ((1, 700), (701, 720), (721, 750), (751, 780), (781, 810), (811, 840), (841, 900),
             (901, 990))  # fmt: skip
LEAST_Z = 4.0
HEADING = (
    "# The simulation in numbers",
    "",
    f"Written by `reproduce.py`: {sim.BATCHES} batches of {sim.RUNS} runs, filtered in C. Actual:",
    "root mean square of the error about the truth, +- one standard error. Reported: root of the",
    "mean variance that the filter states.",
)


def batch(number: int) -> dict[str, Outcome]:
    """Simulate one batch and run every filter over it."""
    runs = sim.simulate(sim.RUNS, number)
    specs = sim.specifications()
    return {name: Outcome.of(fkgen.build(spec), runs) for name, spec in specs.items()}


def sigma_table(outcomes: Mapping[str, Outcome]) -> Rows:
    """Actual and reported one-sigma."""
    rows: Rows = [["t, s", *SHOWN]]
    for t in TIMES:
        found = (outcomes[name] for name in SHOWN)
        rows.append([str(t), *(f"{each.actual(t)} / {each.reported(t):.3f}" for each in found)])
    drift = (f"{mean(outcomes[name].error[:, sim.END].astype(float))}" for name in SHOWN)
    return [*rows, [f"mean error at {sim.END}", *drift]]


def rejection_table(outcomes: Mapping[str, Outcome]) -> Rows:
    """Share of windows rejected."""
    rows: Rows = [["window that ends at, s", *TESTED]]
    for title, ends in [("30 to 690", list(FAULT_FREE)), *((str(t), [t]) for t in FAULTY)]:
        rows.append([title, *(f"{outcomes[name].rejected(ends)}" for name in TESTED)])
    for t in FAULTY[:-1]:
        detected = (f"{outcomes[name].detected_by(t)}" for name in TESTED)
        rows.append([f"fault detected by {t}", *detected])
    return rows


def position_table(outcomes: Mapping[str, Outcome]) -> Rows:
    """Share of positions that the Kalman filter rejects."""
    rows: Rows = [["positions from, s", "to, s", "rejected"]]
    for first, last in POSITIONS:
        share = outcomes[sim.KF_TEST].rejected(slice(first, last + 1))
        rows.append([str(first), str(last), f"{share:.4f}"])
    return rows


def honesty(outcome: Outcome, dof: int) -> dict[str, Estimate]:
    """Before the fault: mean statistic, false alarms at 5 %, mean squared error over variance.

    Windows of one run are independent, and so are their statistics, as long as all are accepted.
    """
    ends = list(FAULT_FREE)
    statistic = outcome.statistic[:, ends].astype(float).ravel()
    alarms = (statistic > noiseless.chi2.isf(sim.FALSE_ALARM, dof)).astype(float)
    ratio = outcome.error[:, 690].astype(float) ** 2 / outcome.variance[:, 690]
    return {"mean zeta": mean(statistic), "false alarms": mean(alarms), "ratio": mean(ratio)}


def honest_table(outcomes: Mapping[str, Outcome]) -> Rows:
    """The same with the values that they have to have."""
    rows: Rows = [
        ["filter, nothing rejected", "mean zeta", "above the threshold", "e^2 / P at 690"]
    ]
    for name, dof in zip(sim.NO_TEST, (2, 1, 1), strict=True):
        found = honesty(outcomes[name], dof)
        rows.append([f"{name}: {dof}, 0.05, 1", *(f"{each:.4f}" for each in found.values())])
    return rows


def batch_table(batches: Sequence[Mapping[str, Outcome]]) -> Rows:
    """How much 360 runs scatter."""
    rows: Rows = [["standard deviation over batches", *SHOWN]]
    for t in (690, sim.END):
        each = [[b[name].actual(t).value for b in batches] for name in SHOWN]
        rows.append([f"actual at {t}", *(f"{np.std(v, ddof=1):.3f}" for v in each)])
    return rows


def exact_tables() -> dict[str, Rows]:
    """What needs no random numbers."""
    names, at = (sim.KF, *sim.NO_TEST), (300, 600, 690)
    kept = noiseless.variances(names, at, noiseless.record())
    lost = noiseless.variances(names, (sim.END,), noiseless.record(until=690))
    head = [*(f"{t} s" for t in at), f"{sim.END} s, nothing accepted after 690 s"]
    variances: Rows = [["P11, m^2", *head]]
    variances += [[n, *(f"{v:.12f}" for v in (*kept[n], *lost[n]))] for n in names]
    drift: Rows = [["mean error of kf without a test at, s", *map(str, noiseless.DRIFT_AT)]]
    drift.append(["m", *(f"{v:.6f}" for v in noiseless.drift())])
    power: Rows = [["non-centrality, power", *(f"{t} s" for t in noiseless.ENDS)]]
    for name, dof in zip(sim.NO_TEST, (2, 1, 1), strict=True):
        for accepting, text in ((False, "nothing faulty accepted"), (True, "all accepted")):
            values = noiseless.non_centrality(name, accepting=accepting)
            chances = noiseless.power(values, dof)
            title = f"{name.removesuffix(', no test')}, {text}"
            pairs = zip(values, chances, strict=True)
            power.append([title, *(f"{v:.6f}, {p:.4f}" for v, p in pairs)])
    lengths: Rows = [["P11 at 900 s by length of the windows", "maintenance (44)", "optimal"]]
    for seconds, value in noiseless.by_window().items():
        lengths.append([f"{seconds} s", f"{value['paper']:.6f}", f"{value['optimal']:.6f}"])
    walk: Rows = [["a random walk with P0 = 1, q = 100, r = 1000", "m^2"]]
    walk += [[name, f"{value:.6f}"] for name, value in noiseless.counter_example().items()]
    return {
        "Variances": variances,
        "Drift": drift,
        "Power": power,
        "Windows": lengths,
        "Two raw measurements and one that is compressed": walk,
    }


def markdown(tables: Mapping[str, Rows]) -> str:
    """Lay the tables out."""
    lines = list(HEADING)
    for title, (head, *body) in tables.items():
        lines += ["", f"## {title}", ""]
        rule = ["---", *["---:"] * (len(head) - 1)]
        lines += ["| " + " | ".join(row) + " |" for row in (head, rule, *body)]
    return "\n".join(lines) + "\n"


def violations(outcomes: Mapping[str, Outcome]) -> list[str]:
    """Say which statement does not hold."""
    found = []
    for name, dof in zip(sim.NO_TEST, (2, 1, 1), strict=True):
        expected = {"mean zeta": float(dof), "false alarms": sim.FALSE_ALARM, "ratio": 1.0}
        for what, each in honesty(outcomes[name], dof).items():
            if abs(each.value - expected[what]) > LEAST_Z * each.error:
                found.append(f"{name}: {what} = {each}, not {expected[what]}")
    growth = {
        name: (
            outcomes[name].actual(sim.END).value / outcomes[name].actual(690).value,
            outcomes[name].reported(sim.END) / outcomes[name].reported(690),
        )
        for name in SHOWN
    }
    if not (growth[sim.KF_TEST][0] > 5.0 and growth[sim.KF_TEST][1] < 1.15):
        found.append(f"kf: {growth[sim.KF_TEST]}")
    for name in (sim.DFCF, sim.CPCF, sim.PAPER):
        if not (growth[name][0] < 2.2 and 1.3 < growth[name][1] < 1.5):
            found.append(f"{name}: {growth[name]}")
        if outcomes[name].rejected([840]).value < 0.95:
            found.append(f"{name}: {outcomes[name].rejected([840])} rejected at 840 s")
    return found


def unsupported(page: str, tables: str) -> list[str]:
    """Find what the page quotes with three decimals or more and no table has."""
    return [each for each in re.findall(r"\d+\.\d{3,}", page) if each not in tables]


def main() -> None:
    """Write the tables and the figure."""
    start = time.perf_counter()
    for spec in sim.specifications().values():
        fkgen.build(spec)
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(os.cpu_count(), mp_context=spawn) as workers:
        batches = list(workers.map(batch, range(sim.BATCHES)))
    outcomes = {name: Outcome.together([b[name] for b in batches]) for name in batches[0]}
    tables = {
        "One-sigma of the position, actual / reported, m": sigma_table(outcomes),
        "Rejected windows": rejection_table(outcomes),
        "Positions rejected by the Kalman filter that tests each": position_table(outcomes),
        "Before the fault, nothing rejected": honest_table(outcomes),
        "Batches of 360 runs": batch_table(batches),
        **exact_tables(),
    }
    text = markdown(tables)
    (sim.HERE / "tables.md").write_text(text, encoding="utf-8")
    with (sim.HERE / "tables.csv").open("w", encoding="utf-8", newline="") as file:
        out = csv.writer(file, lineterminator="\n")
        for title, rows in tables.items():
            out.writerows([title, *row] for row in rows)
    figure = draw(outcomes)
    figure.savefig(sim.HERE / "soft_fault.png", dpi=110, metadata={"Software": None})
    print(text)
    print(f"{time.perf_counter() - start:.0f} s")
    page = (sim.HERE / "README.md").read_text(encoding="utf-8")
    missing = [f"README.md quotes {each}" for each in unsupported(page, text)]
    if wrong := [*violations(outcomes), *missing]:
        raise SystemExit("\n".join(wrong))


if __name__ == "__main__":
    main()
