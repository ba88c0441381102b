"""Filter the flight with and without the delay in the model: ``python run.py``.

Prints the table of the page and draws late_gps.png; exit status 1 if a bound is missed.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from prepare import Floats, Record, read

import fkgen

HERE = Path(__file__).resolve().parent
WAYS = ("in time", "late, and known to be", "late, taken as fresh")
SETTLED = 5.0  # s after which errors count
WITHIN = 1.3  # times the error with fixes in time, that of the delay in the model
BEYOND = 2.0  # times the error of the delay in the model, that without it, to the east
SHOWN = (60.0, 80.0)  # s of the figure
COLOURS = ("#3f8f4f", "#1f5a94", "#d9741a")


def estimates(flight: Record) -> tuple[dict[str, Floats], Floats]:
    """Filtered states (T, 4) by way, and those of a smoother that had every fix in time."""
    compiled = fkgen.build(fkgen.load(HERE / "spec.toml"))
    dt = {"dt": flight.dt}
    runs = {
        WAYS[0]: compiled.run(flight.in_time, params=dt),
        WAYS[1]: compiled.run(flight.y, params=dt | flight.delays()),
        WAYS[2]: compiled.run(flight.y, params=dt),
    }
    if any((run.status < 0).any() for run in runs.values()):
        raise SystemExit("refused samples")
    smoothed = compiled.smooth(flight.in_time, params=dt)
    return {way: run.filtered_state for way, run in runs.items()}, smoothed.state


def errors(flight: Record, found: dict[str, Floats], smoothed: Floats) -> dict[str, Floats]:
    """Root mean square distance from the smoother, (4,), by way."""
    settled: NDArray[np.bool_] = flight.t > SETTLED
    return {
        way: np.sqrt(np.mean((states - smoothed)[settled] ** 2, axis=0))
        for way, states in found.items()
    }


def missed(rms: dict[str, Floats]) -> list[str]:
    """What is not as the page says."""
    in_time, known, fresh = (rms[way] for way in WAYS)
    wrong = []
    if not (known[:2] <= WITHIN * in_time[:2]).all():
        wrong.append(f"with the delay in the model the position is off by {known[:2]} m")
    if not fresh[0] >= BEYOND * known[0]:
        wrong.append(f"without it only by {fresh[0]:.2f} m to the east")
    return wrong


def draw(flight: Record, found: dict[str, Floats], smoothed: Floats, path: Path) -> None:
    """Draw the flight to the east, and how far it is off."""
    figure = Figure(figsize=(9.0, 5.0), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    t = flight.t
    above.plot(t, smoothed[:, 0], color="#cfdcea", lw=6, label="all fixes, in time, with hindsight")
    come = np.isfinite(flight.y[:, 0])
    above.plot(t[come], flight.y[come, 0], ".", color="#8a8a8a", label="fixes when they come")
    for way, colour in zip(WAYS, COLOURS, strict=True):
        above.plot(t, found[way][:, 0], color=colour, lw=1, label=way)
        below.plot(t, found[way][:, 0] - smoothed[:, 0], color=colour, lw=1, label=way)
    above.set(ylabel="east, m", xlim=SHOWN)
    inside = (t >= SHOWN[0]) & (t <= SHOWN[1])
    low, high = smoothed[inside, 0].min(), smoothed[inside, 0].max()
    above.set_ylim(low - 4.0, high + 4.0)
    below.set(ylabel="off by, m", xlabel="time, s", ylim=(-2.0, 2.0))
    below.axhline(0.0, color="#8a8a8a", lw=0.5)
    above.legend(ncols=1, frameon=False, fontsize=8, loc="lower left")
    figure.savefig(path, dpi=120)


def main() -> None:
    """Print the table, draw the figure, judge."""
    flight = read()
    found, smoothed = estimates(flight)
    rms = errors(flight, found, smoothed)
    print(f"{'fixes':24}{'east':>8}{'north':>8}{'v_east':>8}{'v_north':>8}")
    for way in WAYS:
        print(f"{way:24}" + "".join(f"{value:8.2f}" for value in rms[way]))
    draw(flight, found, smoothed, HERE / "late_gps.png")
    wrong = missed(rms)
    for each in wrong:
        print(f"missed: {each}")
    raise SystemExit(1 if wrong else 0)


if __name__ == "__main__":
    main()
