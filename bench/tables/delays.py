"""What rows that may be late cost: beside the filter of the same plant that takes none."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from harness import clock, models
from harness.report import Table, ns, times
from harness.settings import Settings
from rivals import contenders

_SAMPLES = 4000
_MOST = 8
_LEVELS = ("-O2", "-O3 -march=native")
_TARGET = 1.3


def late_rows(settings: Settings) -> Table:
    """Rows that may be late and are not, and one that is."""
    columns = ["filter", "compiler", "kf, ns", "none late / kf", "one late / kf", "numbers beyond"]
    n, p = 6, 3
    room = (_MOST + 2) * n * (n + 1)
    table = Table(
        "Late rows",
        columns,
        f"kf with n = {n}, {p} rows, each up to {_MOST} samples late. None late / kf: samples on "
        f"which no row is late, beside the same filter without `max_delay`; target: at most "
        f"{_TARGET}. One late: a row on every sample that is {_MOST} samples old. Numbers beyond: "
        "of the instance, beyond those of kf, parameters and rows of the last samples not "
        f"counted; target: at most (8 + 2) n (n + 1) = {room}.",
    )
    for title, spec in (("full", models.dense(n, p)), ("nearly empty", models.chains(n, p))):
        for cc in settings.compilers:
            for level in _LEVELS:
                table.add(f"{title}, {level}", cc, *_compared(spec, cc, level, settings))
    return table


def _compared(spec: models.Spec, cc: str, level: str, settings: Settings) -> list[str]:
    """The cells of one row."""
    outputs = [{"name": f"row_{i}", "max_delay": _MOST} for i in range(models.width(spec)[1])]
    late = {**spec, "name": f"{spec['name']}_late", "model": {**spec["model"], "outputs": outputs}}
    plain, may = (contenders.of_fkgen(each, settings.folder) for each in (spec, late))
    is_late = replace(may, header=may.header.replace("{ 0.0", f"{{ {float(_MOST)!r}"))
    y, u = models.record(spec, _SAMPLES)
    runs = {}
    for name, contender in (("kf", plain), ("none late", may), ("one late", is_late)):
        place = settings.folder / f"{spec['name']}-{cc}{level.replace(' ', '')}-{name}"
        runs[name] = partial(contenders.library(contender, place, cc, level), y, u)
    if abs(runs["kf"]() - runs["none late"]()) > 1e-9:
        raise RuntimeError(f"{spec['name']}: rows that are not late are not those of kf")
    taken = clock.take_turns(runs, settings.rounds, settings.seconds)
    cells = [ns(taken.best("kf") / len(y))]
    cells += [times(taken.ratio(name, "kf")) for name in ("none late", "one late")]
    return [*cells, str(_kept(spec, late))]


def _kept(spec: models.Spec, late: models.Spec) -> int:
    """Numbers of the instance beyond those of kf, without rows and parameters."""
    sizes = [contenders.sizes(each) for each in (spec, late)]
    beyond = {name: size for name, size in sizes[1].items() if name not in sizes[0]}
    past = ("past_rows", "past_delay", "past_parameters", "past_inputs")
    return sum(size for name, size in beyond.items() if name not in past)
