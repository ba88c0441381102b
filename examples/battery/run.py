"""Filter the pulse test with drop-outs of the current sensor: ``python run.py``.

Prints the tables of the page and draws battery.png.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from prepare import SEED, Record, drop_outs, read

import fkgen

HERE = Path(__file__).resolve().parent
Floats = NDArray[np.floating[Any]]
FILTERS = ("imm", "one_step", "ekf", "ekf, sensor of 5 A")
SEEDS = range(1, 9)
AFTER = 1800.0  # s from the start on, errors count
AT_MOST = 2.0  # percent
SUSPICIOUS = 5.0  # A, the noise of a sensor that is not trusted
STARTS = (-0.5, -0.4, -0.3, -0.2, -0.1, 0.1, 0.2)
BLUE, ORANGE, GREEN, RED = "#1f5a94", "#d9741a", "#3f8f4f", "#b3261e"
LIGHT, GREY = "#cfdcea", "#8a8a8a"


def content() -> dict[str, Any]:
    """Read spec.toml, to be varied."""
    return tomllib.loads((HERE / "spec.toml").read_text(encoding="utf-8"))


def built(name: str) -> fkgen.CompiledFilter:
    """Build the filter of this name."""
    varied = content()
    varied["filter"] = {"family": name.split(",", maxsplit=1)[0]}
    if name.startswith("ekf"):
        del varied["faults"]
    if name.endswith("5 A"):
        varied["model"]["R"][0][0] = SUSPICIOUS**2
    return fkgen.build(fkgen.Spec.from_dict(varied, file="spec.toml"))


def filters(names: Iterable[str] = FILTERS) -> dict[str, fkgen.CompiledFilter]:
    """Build what is compared."""
    return {name: built(name) for name in names}


def run(
    compiled: fkgen.CompiledFilter,
    record: Record,
    seed: int,
    params: dict[str, float] | None = None,
    **start: Any,
) -> fkgen.Run:
    """Filter the record with the drop-outs of a seed."""
    y = np.column_stack([drop_outs(record, seed), record.voltage])
    out = compiled.run(y, params={"dt": record.dt} | (params or {}), **start)
    if np.any(out.status < 0):
        raise SystemExit(f"{compiled.family}: refused samples")
    return out


def errors(soc: Floats, record: Record) -> tuple[float, float]:
    """Largest and root mean square error half an hour after the start and later, percent."""
    late = record.t >= record.t[0] + AFTER
    wrong = 100.0 * (soc - record.soc)[late]
    return float(np.abs(wrong).max()), float(np.sqrt(np.mean(wrong**2)))


def counted(record: Record, seed: int) -> Floats:
    """State of charge by the sensor alone, from the right start."""
    flow = drop_outs(record, seed)[1:] * record.dt[:-1] / 3600.0
    return np.asarray(1.0 + np.append(0.0, np.cumsum(flow)) / content()["parameters"]["capacity"])


def table(compiled: dict[str, fkgen.CompiledFilter], record: Record) -> dict[str, Floats]:
    """Errors by filter, seed, and kind."""
    found = {
        name: np.array(
            [errors(run(each, record, seed).filtered_state[:, 0], record) for seed in SEEDS]
        )
        for name, each in compiled.items()
    }
    alone = np.array([errors(counted(record, seed), record) for seed in SEEDS])
    return found | {"the sensor alone, from the right start": alone}


def starts(imm: fkgen.CompiledFilter, record: Record) -> dict[float, Floats]:
    """Largest errors by what the start is wrong by, and seed."""
    x0 = np.array(content()["model"]["x0"])
    result = {}
    for wrong in STARTS:
        x0[0] = 1.0 + wrong
        runs = [run(imm, record, seed, start={"x0": x0}) for seed in SEEDS]
        result[wrong] = np.array([errors(out.filtered_state[:, 0], record)[0] for out in runs])
    return result


def draw(results: dict[str, fkgen.Run], record: Record) -> Figure:
    """Draw state of charge, error, current and probability."""
    figure = Figure(figsize=(9.0, 10.0), layout="constrained")
    axes = figure.subplots(4, 1, sharex=True, height_ratios=(1.5, 1.3, 1.0, 0.8))
    hours = (record.t - record.t[0]) / 3600.0
    draw_charge(axes[0], hours, results, record)
    draw_errors(axes[1], hours, results, record)
    draw_current(axes[2], hours, results["imm"], record)
    signal = results["imm"].mode_probability[:, :2].sum(axis=1)
    axes[3].fill_between(hours, signal, color=LIGHT, lw=0)
    axes[3].set_ylim(0.0, 1.0)
    axes[3].set_ylabel("Pr(signal)")
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
        axis.margins(x=0.0)
    axes[-1].set_xlabel("time (h)")
    return figure


def draw_charge(axis: Axes, hours: Floats, results: dict[str, fkgen.Run], record: Record) -> None:
    """Draw states of charge."""
    axis.plot(hours, record.soc, color="black", lw=3.0, alpha=0.25, label="counted by the tester")
    axis.plot(hours, counted(record, SEED), color=GREY, lw=1.0, ls="--", label="by the sensor")
    for (name, out), colour in zip(results.items(), (ORANGE, BLUE), strict=True):
        axis.plot(hours, out.filtered_state[:, 0], color=colour, lw=1.2, label=name)
    axis.set_ylabel("state of charge")
    axis.set_title("A start that is 30 % wrong, and a sensor whose contact opens", loc="left")
    axis.legend(frameon=False, loc="lower left")


def draw_errors(axis: Axes, hours: Floats, results: dict[str, fkgen.Run], record: Record) -> None:
    """Draw errors, and two deviations of imm."""
    axis.axhspan(-AT_MOST, AT_MOST, color=LIGHT, lw=0, label="within 2 %")
    for (name, out), colour in zip(results.items(), (ORANGE, BLUE), strict=True):
        wrong = 100.0 * (out.filtered_state[:, 0] - record.soc)
        axis.plot(hours, wrong, color=colour, lw=1.0, label=name)
    spread = 200.0 * np.sqrt(results["imm"].filtered_covariance[:, 0, 0])
    for side in (spread, -spread):
        axis.plot(hours, side, color=BLUE, lw=0.6, ls=":")
    axis.axvline(AFTER / 3600.0, color="black", lw=0.7, ls=":")
    axis.set_ylim(-10.0, 10.0)
    axis.set_ylabel("error (%)")
    axis.legend(frameon=False, loc="lower left", ncols=3)


def draw_current(axis: Axes, hours: Floats, imm: fkgen.Run, record: Record) -> None:
    """Draw the current."""
    axis.plot(hours, record.current, color="black", lw=2.5, alpha=0.25, label="true")
    axis.plot(hours, drop_outs(record, SEED), ".", color=RED, ms=1.0, label="sensor")
    axis.plot(hours, imm.filtered_state[:, 2], color=BLUE, lw=0.6, label="imm")
    axis.set_ylabel("current (A)")
    axis.legend(frameon=False, loc="lower left", ncols=3, markerscale=6)


def main() -> None:
    """Print the errors, draw the figure, and fail where imm is not good enough."""
    record, compiled = read(), filters()
    found = table(compiled, record)
    print("| filter | largest error, 8 seeds | rms error |")
    print("| --- | ---: | ---: |")
    for name, each in found.items():
        (low, _), (high, _) = each.min(axis=0), each.max(axis=0)
        print(f"| {name} | {low:.2f} to {high:.2f} % | {each[:, 1].mean():.2f} % |")
    print("\n| start wrong by | largest error of imm, 8 seeds |")
    print("| ---: | ---: |")
    for wrong, largest in starts(compiled["imm"], record).items():
        print(f"| {100 * wrong:+.0f} % | {largest.min():.2f} to {largest.max():.2f} % |")
    shown = {name: run(compiled[name], record, SEED) for name in ("ekf", "imm")}
    draw(shown, record).savefig(HERE / "battery.png", dpi=110, metadata={"Software": None})
    if found["imm"][:, 0].max() > AT_MOST:
        raise SystemExit(f"missed: within {AT_MOST:.0f} %")


if __name__ == "__main__":
    main()
