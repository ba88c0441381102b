"""Time of a step over the number of states, from 2 to 64, for everything that is installed."""

from __future__ import annotations

import time

from harness import clock, models
from harness.report import Table, ns
from harness.settings import Settings
from rivals import anchors, peers
from tables.anchors import flops, samples

_STATES = (2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)
_PATIENCE = 12.0  # seconds for a build; the next larger one is not tried
_EIGEN_MOST = 16  # compiling it takes minutes beyond
_FEW = 30  # samples for what is interpreted


def growth(settings: Settings) -> Table:
    """A row for each size; the figures hold the same numbers."""
    core = anchors.machine(settings)
    table = Table(
        "Time over size",
        ["n, p", "build, s", "operations at the peak, ns"],
        "Dense models, ns a step, contraction off, least times. Build: fkgen from spec to loaded "
        f"library; beyond {_PATIENCE:g} s the larger ones are left out. Eigen to n = "
        f"{_EIGEN_MOST}. The peak takes the flops of the cheapest dense step with mul and add "
        "apart.",
    )
    found: dict[str, list[tuple[int, float]]] = {}
    rows = []
    patient = True
    for n in _STATES:
        p = max(1, n // 4)
        spec = models.dense(n, p)
        steps, build = _measure(spec, settings, patient=patient)
        patient = patient and build <= _PATIENCE
        least = flops(n, p) / core.flops[False]
        rows.append((f"{n}, {p}", f"{build:.1f}" if "fkgen" in steps else "", ns(least), steps))
        for name, value in steps.items():
            found.setdefault(name, []).append((n, value))
    table.columns = [*table.columns, *found]
    for title, build, least, steps in rows:
        table.add(title, build, least, *[ns(steps[k]) if k in steps else "" for k in found])
    table.curves = {
        "benchmarks-time.svg": (_scaled(found, 1e9), "ns a step"),
        "benchmarks-rate.svg": (
            {
                name: [(n, flops(n, max(1, n // 4)) / value * 1e-9) for n, value in points]
                for name, points in found.items()
            },
            "GFLOP/s of the cheapest dense step",
        ),
    }
    return table


def _scaled(
    found: dict[str, list[tuple[int, float]]], factor: float
) -> dict[str, list[tuple[int, float]]]:
    return {name: [(n, factor * value) for n, value in points] for name, points in found.items()}


def _measure(
    spec: models.Spec, settings: Settings, *, patient: bool
) -> tuple[dict[str, float], float]:
    """Seconds of a step by name, and those of the build."""
    n, *_ = models.width(spec)
    y, _ = models.record(spec, max(60, samples(n)))
    calls = {
        f"form {k}": call for k, call in anchors.compiled_forms(spec, y, settings.folder).items()
    }
    counts = dict.fromkeys(calls, len(y))
    build = 0.0
    if patient:
        start = time.perf_counter()
        own = anchors.of_fkgen({**spec, "name": f"growth{n}"}, y)
        build = time.perf_counter() - start
        calls |= {"fkgen": own} if own else {}
    eigen = anchors.eigen(spec, y, settings.folder) if n <= _EIGEN_MOST else None
    calls |= {"Eigen": eigen} if eigen else {}
    for name, run in peers.available(spec).items():
        rows = y if name in peers.whole_records() else y[:_FEW]
        calls[name], counts[name] = (lambda run=run, rows=rows: run(rows)), len(rows)
    taken = clock.take_turns(calls, max(5, settings.rounds // 6), settings.seconds / 3)
    steps = {name: taken.best(name) / counts.get(name, len(y)) for name in calls}
    forms = [steps.pop(name) for name in list(steps) if name.startswith("form ")]
    return {"hand": min(forms), **steps}, build
