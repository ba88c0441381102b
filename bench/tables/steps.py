"""One step of the compiled C, a call per sample: fkgen, the hand-written reference, libraries."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from harness import clock, models
from harness.report import Table, ns, times
from harness.settings import Settings
from rivals import contenders, peers

Call = Callable[[], object]

#: Samples of a record, by number of states: about a millisecond each, short beside a time slice.
_SAMPLES = {2: 20000, 4: 4000, 6: 4000, 15: 300}
_TARGET = 1.10


def against_hand(settings: Settings) -> Table:
    """Generated steps beside straight-line C written for the same model."""
    columns = ["filter", "compiler", "fkgen, ns", "hand, ns", "hand with checks, ns"]
    columns += ["fkgen / hand", "fkgen / hand with checks"]
    columns += ["instructions: fkgen", "hand", "hand with checks"] if settings.callgrind else []
    table = Table(
        "One step: generated against hand-written C",
        columns,
        "-O2, the step in a translation unit of its own, called once per sample. The hand-written "
        "step stores the same outputs (filtered and predicted state and covariance, innovation, "
        "its covariance, NIS, log-likelihood by libm's log). It leaves out: tests of rows for NaN "
        "and infinity, of variances, pivots and results, the transaction, `valid`, status codes "
        "and NULL tests. With checks it tests rows, variances, pivots and results, and stores "
        f"after all tests. Target: fkgen at most {_TARGET} of the hand-written step. Times are "
        "minima; ratios are medians over the quietest rounds of the ratio within a round.",
    )
    for title, spec in models.kf_models().items():
        for cc in settings.compilers:
            table.add(title, cc, *_compare(spec, cc, settings))
    return table


def _compare(spec: models.Spec, cc: str, settings: Settings) -> list[str]:
    folder = settings.folder
    rivals = {
        "fkgen": contenders.of_fkgen(spec, folder),
        "hand": contenders.of_hand(spec, folder, checks=False),
        "checked": contenders.of_hand(spec, folder, checks=True),
    }
    y, u = models.record(spec, _SAMPLES[models.width(spec)[0]])
    places = {name: folder / f"{spec['name']}-{cc}-{name}" for name in rivals}
    libraries = {name: contenders.library(c, places[name], cc) for name, c in rivals.items()}
    _agree({name: run(y, u) for name, run in libraries.items()}, spec["name"])
    taken = clock.take_turns(
        {n: _bound(run, y, u) for n, run in libraries.items()}, settings.rounds
    )
    cells = [ns(taken.best(name) / len(y)) for name in rivals]
    cells += [times(taken.ratio("fkgen", name)) for name in ("hand", "checked")]
    if settings.callgrind:
        cells += [_count(c, places[name], cc) for name, c in rivals.items()]
    return cells


def _count(contender: contenders.Contender, place: Path, cc: str, level: str = "-O2") -> str:
    return f"{clock.instructions(contenders.program(contender, place, cc, level)):.0f}"


def _bound(run: Callable[..., object], *arguments: object) -> Call:
    return lambda: run(*arguments)


def _agree(results: dict[str, float], what: str) -> None:
    values = list(results.values())
    if not np.allclose(values, values[0], rtol=1e-9, atol=1e-12):
        raise RuntimeError(f"{what}: the contenders do not compute the same: {results}")


def against_libraries(settings: Settings) -> Table:
    """The same filters with Eigen, filterpy, numba and NumPy."""
    names = ["Eigen", *peers.available(models.motor())]
    table = Table(
        "One step: other libraries",
        ["filter", "fkgen, ns", *[f"{name} / fkgen" for name in names]],
        "gcc -O2. Eigen: fixed sizes, textbook form, Cholesky of S. filterpy: `update` and "
        "`predict`. numba: the textbook in NumPy under `njit`, one call per record. NumPy: the "
        "same, interpreted. statsmodels and simdkalman where they are installed.",
    )
    for title, spec in models.kf_models().items():
        y, u = models.record(spec, _SAMPLES[models.width(spec)[0]])
        few = y[: max(20, len(y) // 100)]
        place = settings.folder / spec["name"]
        runs: dict[str, Call] = {}
        fkgen = contenders.library(
            contenders.of_fkgen(spec, settings.folder), place.with_name(f"{spec['name']}-peer")
        )
        runs["fkgen"] = _bound(fkgen, y, u)
        samples = {"fkgen": len(y), "Eigen": len(y)}
        results = {}
        if Path("/usr/include/eigen3").is_dir():
            eigen = contenders.library(
                contenders.of_eigen(spec, settings.folder), place.with_name(f"{spec['name']}-eigen")
            )
            runs["Eigen"] = _bound(eigen, y, u)
            results["Eigen"] = eigen(few, u)
        for name, run in peers.available(spec).items():
            record = y if name in peers.whole_records() else few
            runs[name], samples[name] = _bound(run, record), len(record)
            results[name] = float(run(few)[0])
        _agree({"fkgen": fkgen(few, u), **results}, spec["name"])
        taken = clock.take_turns(runs, max(5, settings.rounds // 3), settings.seconds)
        own = taken.best("fkgen") / len(y)
        scale = {name: samples[name] / len(y) for name in runs}
        cells = [
            times(taken.ratio(name, "fkgen") / scale[name]) if name in runs else "absent"
            for name in names
        ]
        table.add(title, ns(own), *cells)
    return table


def families(settings: Settings) -> Table:
    """Scalar types and optimisation levels of everything that fkgen generates."""
    levels = ("-O1", "-O2", "-O3")
    columns = ["filter", "compiler", "double -O2, ns", *[f"double {v}" for v in levels]]
    columns += [f"float {v}" for v in levels]
    columns += ["instructions, double -O2"] if settings.callgrind else []
    table = Table(
        "One step: families, scalar types and optimisation levels",
        columns,
        "Columns after the first time are ratios to double at -O2 of the same compiler. In "
        "float the covariance update is Joseph's by default, which has more operations.",
    )
    for title, spec in models.all_models().items():
        for cc in settings.compilers:
            table.add(title, cc, *_variants(spec, cc, settings, levels))
    return table


def _variants(spec: models.Spec, cc: str, settings: Settings, levels: tuple[str, ...]) -> list[str]:
    y, u = models.record(spec, _SAMPLES[models.width(spec)[0]])
    runs: dict[str, Call] = {}
    count = ""
    for scalar, kind in (("double", np.float64), ("float", np.float32)):
        folder = settings.folder / scalar
        folder.mkdir(exist_ok=True)
        contender = contenders.of_fkgen(models.with_code(spec, scalar=scalar), folder)
        for level in levels:
            place = folder / f"{spec['name']}-{cc}{level}"
            run = contenders.library(contender, place, cc, level)
            runs[scalar + level] = _bound(run, y.astype(kind), u.astype(kind))
            if settings.callgrind and scalar + level == "double-O2":
                count = _count(contender, place, cc, level)
    taken = clock.take_turns(runs, settings.rounds, settings.seconds)
    cells = [ns(taken.best("double-O2") / len(y))]
    cells += [times(taken.ratio(name, "double-O2")) for name in runs]
    return [*cells, count] if settings.callgrind else cells
