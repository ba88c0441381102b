"""A record beside the best that can be written by hand, Eigen, and SLinGen's published cycles."""

from __future__ import annotations

from dataclasses import dataclass

from harness import clock, models
from harness.report import Table, ns, times, verdict
from harness.settings import Settings
from rivals import anchors

_DENSE = ((2, 1), (4, 2), (6, 3), (8, 2), (12, 3), (15, 6), (16, 4), (32, 8))
_CHAINS = ((6, 3), (16, 4), (32, 8))
_EIGEN = {4: 0.80, 6: 0.80, 32: 0.60}  # of the dense models, else _EIGEN_ELSE
_EIGEN_ELSE, _HAND = 0.45, 1.00
_SLINGEN = {4: 732, 12: 9349, 20: 34371, 28: 86274}
_CYCLES = 0.32
_WORK = 1e-3  # seconds of a record, about


@dataclass(frozen=True)
class Measured:
    """Seconds of a step, and ratios within rounds.

    Attributes
    ----------
    form : str
        The best one.
    step : mapping of str to float
        Of fkgen, hand and Eigen.
    ratio : mapping of (str, str) to float
    """

    form: str
    step: dict[str, float]
    ratio: dict[tuple[str, str], float]


def samples(n: int) -> int:
    """Of a record of about a millisecond."""
    return int(_WORK / (1e-9 * (20 + 0.14 * n**3)))


def measure(spec: models.Spec, settings: Settings, *, fused: bool = False) -> Measured | None:
    """All take turns; the best form is the one with the least time. None if fkgen cannot fuse."""
    y, _ = models.record(spec, max(60, samples(models.width(spec)[0])))
    own = anchors.of_fkgen(spec, y, **({"fma": True} if fused else {}))
    if fused and own is None:
        return None
    calls = anchors.compiled_forms(spec, y, settings.folder, fused=fused)
    forms = list(calls)
    others = {"fkgen": own, "Eigen": anchors.eigen(spec, y, settings.folder)}
    calls |= {name: call for name, call in others.items() if call}
    taken = clock.take_turns(calls, settings.rounds, settings.seconds / 2)
    form = min(forms, key=taken.best)
    step = {"hand": taken.best(form) / len(y)}
    step |= {name: taken.best(name) / len(y) for name in others if name in calls}
    names = {"hand": form, **{name: name for name in others if name in calls}}
    ratio = {(a, b): taken.ratio(names[a], names[b]) for a in names for b in names if a != b}
    return Measured(form, step, ratio)


def flops(n: int, p: int) -> int:
    """Of the cheapest dense step: T, prediction, V, update, S."""
    return 2 * n**3 + n * n * (n + 1) + 2 * p * n * n + p * n * (n + 1) + 2 * p * p * n


def _judged(ratio: float | None, limit: float) -> str:
    return "absent" if ratio is None else f"{times(ratio)} ({verdict(ratio, limit)})"


def hand(settings: Settings) -> Table:
    """The dense models, the chains and the navigation model."""
    table = Table(
        "One record: the best hand-written forms and Eigen",
        [
            "model",
            "sums",
            "fkgen, ns",
            "hand, ns",
            "form",
            "Eigen, ns",
            "fkgen / hand",
            "fkgen / Eigen",
            "hand / Eigen",
            "of peak: fkgen",
            "hand",
        ],
        "A step of `run(..., keep=['filtered_state'])` beside records in C, all at -O3 "
        "-march=native, the fkgen library by its own flags. Hand: GCC vector types (bench/forms), "
        "with missing rows, infinite y, pivots, finite results, nis and status, but unlike fkgen "
        "without log-likelihood, packed ports, tests of predicted variances, and ending the "
        "record where a pivot or result is refused; Eigen: fixed sizes, textbook form, none of "
        "these. With fma: contraction on, `code.fma`, if fkgen "
        "has it. All found equal to NumPy first. Peak: independent multiply-adds of one core, "
        f"measured: {{peak}}. Share of it: flops of the cheapest dense step. Targets: {_HAND:g} of "
        f"the hand-written form; of Eigen {_EIGEN_ELSE}, {_EIGEN[4]} at n4 and n6, {_EIGEN[32]} "
        "at n32.",
    )
    core = anchors.machine(settings)
    apart, fused = (f"{core.flops[kind] * 1e-9:.1f} GFLOP/s" for kind in (False, True))
    table.note = table.note.replace("{peak}", f"{apart} apart, {fused} fused")
    specs = {f"n{n} p{p}": models.dense(n, p) for n, p in _DENSE}
    specs |= {f"chains n{n} p{p}": models.chains(n, p) for n, p in _CHAINS}
    specs["navigation n15 p6"] = models.navigation()
    for title, spec in specs.items():
        for fuse in (False, True):
            found = measure(spec, settings, fused=fuse)
            if found:
                dense = title in {f"n{n} p{p}" for n, p in _DENSE}
                peak = core.flops[fuse] if dense else None
                table.add(title, "fma" if fuse else "no fma", *_cells(spec, found, peak))
    return table


def _cells(spec: models.Spec, found: Measured, peak: float | None) -> list[str]:
    """Of a row; shares of the peak for dense models only."""
    n, p, _ = models.width(spec)
    step = {name: ns(value) for name, value in found.step.items()}
    limit = _EIGEN.get(n, _EIGEN_ELSE) if peak else 1.0
    both = found.ratio.get(("hand", "Eigen"))
    cells = [step.get("fkgen", "absent"), step["hand"], found.form, step.get("Eigen", "absent")]
    cells.append(_judged(found.ratio.get(("fkgen", "hand")), _HAND))
    cells.append(_judged(found.ratio.get(("fkgen", "Eigen")), limit))
    cells.append("absent" if both is None else times(both))
    for name in ("fkgen", "hand"):
        share = flops(n, p) / found.step[name] / peak if peak and name in found.step else None
        cells.append("" if share is None else f"{share:.0%}")
    return cells


def slingen(settings: Settings) -> Table:
    """As many measurements as states, in cycles."""
    core = anchors.machine(settings)
    table = Table(
        "One record: cycles beside SLinGen",
        ["n = p", "fkgen", "hand", "Eigen", "SLinGen", "fkgen / SLinGen", "hand / SLinGen"],
        "A, C, Q and R dense. SLinGen (Spampinato, Fabregat-Traver, Bientinesi & Pueschel, CGO "
        "2018) generates for given sizes and tunes by running; published: one step with AVX, no "
        "fma. Cycles here: time times the clock, which is that of adds that wait for each other: "
        f"{core.cycles * 1e-9:.2f} GHz. Target: at most {_CYCLES} of SLinGen.",
    )
    for n, published in _SLINGEN.items():
        found = measure(models.square(n), settings)
        if found is None:
            continue
        cycles = {name: value * core.cycles for name, value in found.step.items()}
        cells = [
            f"{cycles[name]:.0f}" if name in cycles else "absent"
            for name in ("fkgen", "hand", "Eigen")
        ]
        own = cycles["fkgen"] / published
        row = [*cells, published, f"{own:.2f} ({verdict(own, _CYCLES)})"]
        table.add(n, *row, f"{cycles['hand'] / published:.2f}")
    return table
