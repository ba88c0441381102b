"""Time of a step beside its operations: every kind of filter at the rate of a Kalman filter."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from harness import clock, models
from harness.report import Table, ns, verdict
from harness.settings import Settings
from rivals import contenders

import fkgen

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
_RATE, _SAMPLES = 1.2, 4000
_REFERENCE = "kf n6 p3, full"


def rates(settings: Settings) -> Table:
    """Jumping plants and compression filters beside the Kalman filter."""
    table = Table(
        "One step: time and operations",
        ["filter", "compiler", "step, ns", "operations", "time / operations, kf n6 p3 = 1"],
        "-O2, a call per sample, all in turn. Operations are those of a step with every row "
        "present that ends no window; calls of log and exp and work at ends of windows are in "
        f"the time only. Target for jumping plants: at most {_RATE}.",
    )
    chosen = {_REFERENCE: models.dense(6, 3), **_jumping(), **_compressing()}
    for cc in settings.compilers:
        runs: dict[str, Callable[[], object]] = {}
        operations = {}
        for name, spec in chosen.items():
            place = settings.folder / f"rate-{spec['name']}-{cc}"
            run = contenders.library(contenders.of_fkgen(spec, settings.folder), place, cc)
            runs[name] = partial(run, *models.record(spec, _SAMPLES))
            design = fkgen.validate(fkgen.Spec.from_dict(spec))
            operations[name] = fkgen.generate(design).program.flops
        taken = clock.take_turns(runs, settings.rounds, settings.seconds)
        for name in chosen:
            own = taken.ratio(name, _REFERENCE) * operations[_REFERENCE] / operations[name]
            judged = f" ({verdict(own, _RATE)})" if name.startswith("mjls") else ""
            step = ns(taken.best(name) / _SAMPLES)
            table.add(name, cc, step, operations[name], f"{own:.2f}{judged}")
    return table


def _read(example: str, file: str, name: str, **options: Any) -> models.Spec:
    """The spec of an example, with other options of its filter."""
    table: models.Spec = tomllib.loads((EXAMPLES / example / file).read_text(encoding="utf-8"))
    table["filter"] = table["filter"] | options
    return table | {"name": name}


def _jumping() -> dict[str, models.Spec]:
    """Three modes of three states, one measurement."""
    plain = {"detector": "none"}
    found = {
        "mjls_lmmse, losses at a rate": _read("markov_jump", "spec.toml", "jump_rate", **plain),
        "mjls_lmmse, no losses": _read("markov_jump", "spec.toml", "jump_always", **plain),
        "mjls_lmmse, llr": _read("markov_jump", "spec.toml", "jump_llr"),
    }
    found["mjls_lmmse, no losses"]["faults"]["jump"]["arrival"] = "always"
    return found


def _compressing() -> dict[str, models.Spec]:
    """Position and velocity, the position compressed over 150 samples; kf on the same rows."""
    dfcf = _read("soft_fault", "dfcf.toml", "soft_dfcf")
    kf = {"name": "soft_kf", "model": dfcf["model"], "filter": {"family": "kf"}}
    cpcf = _read("soft_fault", "cpcf.toml", "soft_cpcf")
    return {"kf, position and velocity": kf, "dfcf": dfcf, "cpcf": cpcf}
