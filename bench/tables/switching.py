"""Interacting multiple models for sensor faults: generated, written by hand in C, in Python."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from harness import clock, models
from harness.report import Table, ns, times, verdict
from harness.settings import Settings
from rivals import contenders, switching_peers
from rivals.contenders import Contender

import fkgen

_SAMPLES, _FEW = 4000, 20
_HAND, _PYTHON = 0.6, 1000  # fkgen / hand at most, filterpy / fkgen at least
_WORK, _TIME = 877, 180e-9  # operations, and how long so many may take

Call = Callable[[], object]


def models_side_by_side(settings: Settings) -> Table:
    """Generated steps beside C from a textbook, filterpy and NumPy."""
    columns = ["filter", "compiler", "fkgen, ns", "hand, ns", "fkgen / hand"]
    columns += ["operations", f"fkgen, ns per {_WORK} operations"]
    columns += ["NumPy by hand / fkgen", "filterpy / fkgen"]
    columns += ["instructions: fkgen", "hand"] if settings.callgrind else []
    table = Table(
        "One step: interacting multiple models",
        columns,
        "Sensor faults on a target of constant velocity in the plane, position measured: 4 states, "
        "2 measurements. 3 modes: problem 3 with delta independent from sample to sample; 4 modes: "
        "problem 4, no structure in the kernel. -O2, a call per sample. By hand: full matrices, "
        "loops, the 2 x 2 inverse in closed form, exp and log of libm, likelihoods not in the log "
        "domain, no correction under gamma = 0, no checks, no missing rows; it stores x, P and the "
        "probabilities, but neither the combined prediction nor the innovation, S and NIS of the "
        "mixture. Before timing, x, P, the probabilities and the log-likelihood of all samples are "
        "compared to 1e-9. filterpy: `IMMEstimator`, gamma = 0 as H = 0; a mode whose density is a "
        f"mixture it cannot express. Targets: fkgen at most {_HAND} of the hand-written step, "
        f"{_TIME * 1e9:.0f} ns per {_WORK} operations; filterpy at least {_PYTHON} times slower.",
    )
    for title, spec in models.imm_models().items():
        for row in _rows(spec, settings):
            table.add(title, *row)
    return table


@dataclass(frozen=True)
class _Built:
    """A compiled contender: its loop without and with the outputs kept."""

    contender: Contender
    place: Path
    run: Call
    trace: models.Array


def _rows(spec: models.Spec, settings: Settings) -> Iterator[list[str]]:
    """A row per compiler; all contenders take turns together."""
    y, u = models.record(spec, _SAMPLES)
    flops = fkgen.generate(fkgen.validate(fkgen.Spec.from_dict(spec))).program.flops
    rivals = {"fkgen": _of_fkgen(spec, settings.folder), "hand": _of_hand(spec, settings.folder)}
    built = {
        f"{name} {cc}": _build(rival, settings.folder / f"{spec['name']}-{cc}-{name}", cc, y, u)
        for cc in settings.compilers
        for name, rival in rivals.items()
    }
    peers = switching_peers.available(spec)
    _agree(spec, y, {name: each.trace for name, each in built.items()}, peers)
    runs: dict[str, Call] = {name: each.run for name, each in built.items()}
    runs |= {name: _bound(run, y[:_FEW]) for name, run in peers.items()}
    taken = clock.take_turns(runs, settings.rounds, settings.seconds)
    for cc in settings.compilers:
        own, hand = f"fkgen {cc}", f"hand {cc}"
        each = [taken.best(name) / _SAMPLES for name in (own, hand)]
        share, work = taken.ratio(own, hand), each[0] * _WORK / flops
        row = [cc, *map(ns, each), f"{times(share)} ({verdict(share, _HAND)})", str(flops)]
        row.append(f"{ns(work)} ({verdict(work, _TIME)})")
        slower = {name: taken.ratio(name, own) * _SAMPLES / _FEW for name in peers}
        row.append(times(slower["NumPy by hand"]))
        row.append(_at_least(slower.get("filterpy"), spec))
        if settings.callgrind:
            row += [_count(built[name], cc) for name in (own, hand)]
        yield row


def _at_least(slower: float | None, spec: models.Spec) -> str:
    if slower is None:
        return "absent" if spec["filter"]["modes"] == 4 else "cannot"
    return f"{times(slower)} ({verdict(_PYTHON, slower)})"


def _count(built: _Built, cc: str) -> str:
    return f"{clock.instructions(contenders.program(built.contender, built.place, cc)):.0f}"


def _of_fkgen(spec: models.Spec, folder: Path) -> Contender:
    n, modes = 4, spec["filter"]["modes"]
    packed = n * (n + 1) // 2
    members = [f"filtered_state[{i}]" for i in range(n)]
    members += [f"filtered_covariance[{i}]" for i in range(packed)]
    members += [f"mode_probability[{i}]" for i in range(modes)]
    return _with_outputs(contenders.of_fkgen(spec, folder), [*members, "log_likelihood"])


def _of_hand(spec: models.Spec, folder: Path) -> Contender:
    """The textbook in C over a table of the model."""
    model, n = switching_peers.switching(spec), 4
    modes = len(model.initial)
    table = folder / f"hand_{spec['name']}.inc"
    doubles = ("A", "C", "Q", "R", "P0", "signal", "noise", "share", "kernel", "initial")
    lines = [_array("double", name.upper(), getattr(model, name)) for name in doubles]
    table.write_text("\n".join([*lines, _array("int", "MODE", model.mode), ""]))
    header = (
        '#include "hand_imm.h"\n#define TYPE hand_t\n#define INIT(f) hand_init(f)\n'
        "#define STEP(f, u, y) hand_step(f, y)\n#define RESULT(f) ((f)->x[0])\n"
    )
    defines = {"NX": n, "NY": len(model.C), "NU": 0, "NM": modes, "MODEL": f'"{table}"'}
    rows, columns = np.tril_indices(n)
    members = [f"x[{i}]" for i in range(n)]
    members += [f"P[{i}][{j}]" for i, j in zip(rows, columns, strict=True)]
    members += [f"probability[{i}]" for i in range(modes)]
    source = contenders.HERE / "c" / "hand_imm.c"
    return _with_outputs(Contender(source, header, defines), [*members, "log_likelihood"])


def _array(kind: str, name: str, values: models.Array) -> str:
    shape = "".join(f"[{length}]" for length in values.shape)
    text = str(values.tolist()).replace("[", "{ ").replace("]", " }")
    return f"static const {kind} {name}_{shape} = {text};"


def _with_outputs(contender: Contender, members: list[str]) -> Contender:
    """The loop keeps these members, if asked to."""
    stores = " ".join(f"(to)[{i}] = (f)->{member};" for i, member in enumerate(members))
    text = f"#define WIDTH {len(members)}\n#define OUTPUTS(f, to) do {{ {stores} }} while (0)\n"
    return replace(contender, header=contender.header + text)


def _build(contender: Contender, place: Path, cc: str, y: models.Array, u: models.Array) -> _Built:
    run = contenders.library(contender, place, cc)
    trace = ctypes.CDLL(str(place.with_suffix(".so"))).trace
    trace.argtypes, trace.restype = [ctypes.c_int64, *[ctypes.c_void_p] * 3], None
    kept = np.empty((len(y), contender.header.count("(to)[")))
    trace(len(y), y.ctypes.data, u.ctypes.data, kept.ctypes.data)
    return _Built(contender, place, _bound(run, y, u), kept)


def _bound(run: Callable[..., object], *arguments: object) -> Call:
    return lambda: run(*arguments)


def _agree(
    spec: models.Spec,
    y: models.Array,
    traces: dict[str, models.Array],
    peers: dict[str, switching_peers.Filter],
) -> None:
    """All outputs of all samples in C; those of the last of a few in Python."""
    (first, reference), *others = traces.items()
    scale = np.abs(reference).max(axis=0)
    found = {name: np.abs(trace - reference).max(axis=0) / scale for name, trace in others}
    last = reference[_FEW - 1, :-1]
    found |= {name: np.abs(run(y[:_FEW]) - last) / scale[:-1] for name, run in peers.items()}
    wrong = {name: error.max() for name, error in found.items() if not error.max() <= 1e-9}
    if wrong:
        raise RuntimeError(f"{spec['name']}: not what {first} computes: {wrong}")


def missing_sample(settings: Settings) -> Table:
    """Probabilities of the modes after a missing sample, against a computation by hand."""
    table = Table(
        "A missing sample",
        ["probability of", "(1,1)", "(1,C)", "(0,1)", "(0,C)", "largest error"],
        "The imm of 4 modes after one sample, at (4, 3), and a missing one. By hand: the predicted "
        "probabilities, as nothing was measured. filterpy's `update(None)` keeps the innovation "
        "covariances of the sample before and weighs the modes by their densities at 0.",
    )
    spec = models.imm_models()["imm, 4 modes"]
    y = np.array([[4.0, 3.0], [np.nan, np.nan]])
    by_hand = switching_peers.after_missing(switching_peers.switching(spec), y[0])
    built = _build(
        _of_fkgen(spec, settings.folder), settings.folder / "missing", settings.compilers[0], y,
        np.zeros((2, 0)),
    )  # fmt: skip
    found = {"fkgen": built.trace[-1, -5:-1]}
    found |= {name: run(y)[-4:] for name, run in switching_peers.available(spec).items()}
    table.add("by hand", *(f"{value:.4f}" for value in by_hand["right"]), "")
    for name, probability in found.items():
        # filterpy has to be wrong in the way that is known: else it is another version's.
        expected = by_hand["filterpy" if name == "filterpy" else "right"]
        if not np.allclose(probability, expected, rtol=1e-9, atol=1e-12):
            raise RuntimeError(f"{name} after a missing sample: {probability}, not {expected}")
        error = np.abs(probability - by_hand["right"]).max()
        table.add(name, *(f"{value:.4f}" for value in probability), f"{error:.1e}")
    return table
