"""Halve and double every number that was chosen: ``python sensitivity.py``.

Prints the second table of the page.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from prepare import Record, read
from run import content, judge, missed, run

import fkgen

STEP = 0.027  # s, the step that the chains are made for
ROWS = ("barometer", "GPS height", "GPS speed")


def chain(every: float, lasts: float) -> list[list[float]]:
    """Transition matrix of a condition that sets in and goes, states ordered (absent, present)."""
    return [[1 - STEP / every, STEP / every], [STEP / lasts, 1 - STEP / lasts]]


def scaled_noise(row: int, factor: float) -> dict[str, Any]:
    """Scale the standard deviation of one row of y."""
    varied = content()
    varied["model"]["R"][row][row] *= factor**2
    return varied


def scaled_motion(states: tuple[int, ...], factor: float) -> dict[str, Any]:
    """Scale the process noise of some states, a standard deviation."""
    varied = content()
    for i in states:
        for j in states:
            varied["model"]["Q"][i][j] = f"{factor**2} * ({varied['model']['Q'][i][j]})"
    return varied


def law(**changes: Any) -> dict[str, Any]:
    """Change keys of the law of faults."""
    varied = content()
    varied["faults"]["sensor"] |= changes
    return varied


def variations() -> Iterator[tuple[str, dict[str, Any], dict[str, Any]]]:
    """Yield what is scaled, halved, and doubled."""
    for row, name in enumerate(ROWS):
        yield f"{name} noise, sd", scaled_noise(row, 0.5), scaled_noise(row, 2.0)
    for name, states in (("acceleration", (0, 1)), ("offset drift", (2,))):
        yield f"{name}, sd", scaled_motion(states, 0.5), scaled_motion(states, 2.0)
    factors = law(noise_factor=200.0), law(noise_factor=800.0)
    yield "noise factor of a glitch", *factors
    frequent, rare = (law(delta_chain=chain(every, 20.0)) for every in (300.0, 1200.0))
    yield "time between glitches", frequent, rare
    short, long = (law(delta_chain=chain(600.0, lasts)) for lasts in (10.0, 40.0))
    yield "length of a glitch", short, long


def figures(varied: dict[str, Any], flight: Record) -> str:
    """Filter with a varied spec and tell the three numbers, in bold if one misses its bound."""
    verdict = judge(flight, run(fkgen.build(fkgen.Spec.from_dict(varied)), flight))
    text = f"{verdict.false:.1%}, {verdict.found:.0%}, {verdict.farthest:.1f} m"
    return f"**{text}**" if missed(verdict) else text


def zero_at(height: float, flight: Record) -> tuple[dict[str, Any], Record]:
    """Count all heights from another zero."""
    varied = content()
    varied["model"]["x0"][0] -= height
    return varied, Record(flight.t, flight.dt, flight.y - np.array([height, height, 0.0]))


def main() -> None:
    """Print the table."""
    flight = read()
    print("| | halved | doubled |")
    print("| --- | --- | --- |")
    for name, halved, doubled in variations():
        print(f"| {name} | {figures(halved, flight)} | {figures(doubled, flight)} |", flush=True)
    for height in (1816.0, 1826.0):
        print(f"zero at {height:.0f} m: {figures(*zero_at(height, flight))}")
    varied = content()
    varied["filter"]["modes"] = 3
    print(f"three modes: {figures(varied, flight)}")


if __name__ == "__main__":
    main()
