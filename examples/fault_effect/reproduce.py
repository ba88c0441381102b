"""The effect of faults again: ``python reproduce.py`` writes tables.md and both figures.

The exit status is 1 if a statement about a claim of the paper does not hold, or if the page quotes
a number that the tables do not have.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np
from figure import input_figures, sensor_figures
from printed import as_printed
from song_hu import AFTER, HERE, MODELS, Floats, input_anomaly, peak, sensor_fault, settling, spec
from theorem1 import growth

import fkgen
from fkgen.oracle.plants.actuator import LinearSystem, simulate
from fkgen.profiles import pulse

SENSORS = {"Y1": np.array([1.0, 0.0]), "Y2": np.array([0.0, 1.0])}
WINDOWS = (1, 10, 50, 200)
Rows = list[Sequence[str]]


def rank(columns: Sequence[Floats]) -> int:
    """Rank of matrices side by side."""
    return int(np.linalg.matrix_rank(np.hstack(columns)))


def rest_table() -> Rows:
    """Filters at rest."""
    rows: Rows = [["model", "rank obs.", "rank ctrb.", "rho(M)", "norm of M", "K of Y1", "K of Y2"]]
    for name in MODELS:
        values = fkgen.check(spec(name)).values
        A, B, C = (getattr(spec(name).model, letter).values() for letter in "ABC")
        powers = [np.linalg.matrix_power(A, k) for k in range(3)]
        ranks = rank([(C @ each).T for each in powers]), rank([each @ B for each in powers])
        gains = [
            ", ".join(f"{values[f'filtered_gain.X{i}.{y}']:.6f}" for i in (1, 2, 3))
            for y in SENSORS
        ]
        radius, norm = values["closed_loop_radius"], values["closed_loop_norm"]
        rows.append([name, *map(str, ranks), f"{radius:.9f}", f"{norm:.3f}", *gains])
    return rows


def plateau_table() -> Rows:
    """What a lasting unit bias of a filter at rest ends in."""
    rows: Rows = [["model", "sensor", "X1", "X2", "X3"]]
    for name in MODELS:
        for sensor, size in SENSORS.items():
            last = sensor_fault(name, size, lasting=True)[-1]
            rows.append([name, sensor, *(f"{v + 0.0:.3f}" for v in last)])
    return rows


def pulse_table() -> Rows:
    """Peaks and ends of unit pulses, sensors and input."""
    rows: Rows = [["model", "pulse in", "X1", "X2", "X3"]]
    for name in MODELS:
        found = {y: sensor_fault(name, size, lasting=False) for y, size in SENSORS.items()}
        found["U"] = input_anomaly(name, lasting=False)
        for where, deviation in found.items():
            cells = []
            for i in range(3):
                each = peak(deviation[:, i])
                over = str(each.over) if each.over < AFTER else "later"
                shown = f"{each.size:.4f} ({each.at}), {over}"
                cells.append(shown if each.size > 1e-9 else "none")
            rows.append([name, where, *cells])
    return rows


def step_table() -> Rows:
    """What a lasting unit anomaly of the input ends in, and when it gets there."""
    rows: Rows = [["model", "X1", "X2", "X3"]]
    for name in MODELS:
        A, B = (getattr(spec(name).model, letter).values() for letter in "AB")
        end = np.linalg.solve(np.eye(3) - A, B)[:, 0]
        deviation = input_anomaly(name, lasting=True)
        cells = [
            f"{end[i]:.0f}, {settling(deviation[:, i], end[i])}" if abs(end[i]) > 1e-9 else "none"
            for i in range(3)
        ]
        rows.append([name, *cells])
    return rows


def bias_table() -> Rows:
    """Least biases by test and window."""
    tests = [f"{test} {w}" for test in ("GLR", "NIS sum") for w in WINDOWS]
    rows: Rows = [["model", "sensor", "lambda at the onset", "in the end", "NIS", *tests]]
    for name in MODELS:
        for sensor in SENSORS:
            found = [fkgen.detectability(spec(name), sensor, 1e-3, 0.9, w) for w in WINDOWS]
            rows.append(
                [
                    name,
                    sensor,
                    f"{found[0].information[0]:.4g}",
                    f"{found[0].plateau:.2g}",
                    f"{found[0].nis:.4g}",
                    *(f"{each.glr:.4g}" for each in found),
                    *(f"{each.windowed_nis:.4g}" for each in found),
                ]
            )
    return rows


def other_facts() -> Rows:
    """Numbers that the page mentions by themselves."""
    start = fkgen.fault_effect(spec("A"), pulse(400, 2, [1.0, 1.0])).state_deviation[2:, 0]
    early, grown = peak(start), growth()
    slow = input_anomaly("A", lasting=False)[:, 0]
    rows: Rows = [["what", "number"]]
    rows += [
        ["A, pulse (1, 1) at k = 3: X1 at the onset", f"{abs(start[0]):.3f}"],
        ["its peak", f"{early.size:.3f}"],
        ["at k", str(3 + early.at)],
        ["below 1 % of the peak from k", str(3 + early.over)],
        ["A, pulse of the input: samples that X1 grows", str(int(np.argmax(np.abs(slow))))],
        ["Theorem 1: largest rho(M[k])", f"{grown.radius:.3f}"],
        ["deviation at the pulse", f"{grown.onset:.3f}"],
        ["deviation 37 samples later", f"{grown.end:.1e}"],
        [
            "C, pulse of the input: rms of X3 from two different noise records",
            f"{two_noises():.3f}",
        ],
    ]
    return rows


def two_noises() -> float:
    """Model C, X3: what a comparison of two runs with different noise shows where nothing is."""
    plant, T = spec("C"), 400
    built, system = fkgen.build(plant), LinearSystem.from_spec(plant, T)
    u = np.zeros((T, 1))
    runs = [
        built.run(simulate(system, each, np.random.default_rng(seed)), each).filtered_state
        for seed, each in ((1, u), (2, u + pulse(T, 100, 1.0)))
    ]
    return float(np.sqrt(np.mean((runs[1] - runs[0])[100:, 2] ** 2)))


def violations() -> list[str]:
    """Say which statement of the page about the paper does not hold."""
    states = {"C": [2], "D": [0, 2]}  # what B of the model reaches in no way
    printed = [as_printed(name) for name in "ACD"]
    statements = {
        "figures 5 and 6 are the same": np.array_equal(
            *(input_anomaly(name, lasting=True) for name in "AB")
        ),
        "an anomaly of the input moves what it reaches": not any(
            input_anomaly(name, lasting=True)[:, columns].any() for name, columns in states.items()
        ),
        "the gain as printed is of no use": all(
            each.gain > 1e3 and each.eigenvalue < 0.0 and each.radius > 1.0 for each in printed
        ),
        **about_pulses(),
    }
    return [f"not so: {text}" for text, holds in statements.items() if not holds]


def about_pulses() -> Mapping[str, bool]:
    """Statements about pulses in one sensor of a filter at rest."""
    pulses = {
        (name, y): sensor_fault(name, size, lasting=False)
        for name in MODELS
        for y, size in SENSORS.items()
    }
    return {
        "figures 1 and 3 are the same": all(
            np.array_equal(pulses["A", y], pulses["C", y]) for y in SENSORS
        ),
        "sensor 1 of B has no effect": not pulses["B", "Y1"].any(),
        "pulses are over in the end": all(
            np.abs(each[-1]).max() <= 1e-6 * max(1.0, np.abs(each).max())
            for each in pulses.values()
        ),
        "pulses grow in B only": all(
            name == "B" or peak(each[:, i]).at == 0
            for (name, _), each in pulses.items()
            for i in range(3)
        ),
    }


def markdown(tables: Mapping[str, Rows]) -> str:
    """Lay the tables out."""
    lines = ["# The effect of faults in numbers", "", "Written by `reproduce.py`."]
    for title, (head, *body) in tables.items():
        rule = ["---", *["---:"] * (len(head) - 1)]
        lines += ["", f"## {title}", ""]
        lines += ["| " + " | ".join(row) + " |" for row in (head, rule, *body)]
    return "\n".join(lines) + "\n"


def unsupported(page: str, tables: str) -> list[str]:
    """Find what the page quotes with three decimals or more and no table has."""
    return [each for each in re.findall(r"\d+\.\d{3,}", page) if each not in tables]


def main() -> None:
    """Write the tables and the figures."""
    tables = {
        "Filters at rest": rest_table(),
        "A lasting unit bias: where the estimate ends, off by": plateau_table(),
        "A unit pulse: largest |dX| (samples after it), below 1 % of it after": pulse_table(),
        "A lasting unit anomaly of the input: end, within 1 % of it after": step_table(),
        "Least bias found with power 0.9 at 0.001 false alarms": bias_table(),
        "Others": other_facts(),
    }
    text = markdown(tables)
    (HERE / "tables.md").write_text(text, encoding="utf-8")
    for name, figure in (("sensors", sensor_figures()), ("input", input_figures())):
        figure.savefig(HERE / f"{name}.png", dpi=100, metadata={"Software": None})
    print(text)
    page = (HERE / "README.md").read_text(encoding="utf-8")
    missing = [f"README.md quotes {each}" for each in unsupported(page, text)]
    if wrong := [*violations(), *missing]:
        raise SystemExit("\n".join(wrong))


if __name__ == "__main__":
    main()
