"""Sums over the trials of a block in C: once over what NumPy would go over fifty times."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping
from itertools import accumulate
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fkgen.runtime import cache
from fkgen.runtime.compiled import CompiledFilter
from fkgen.runtime.compiler import compile_shared, find_compiler
from fkgen.study.campaigns.sums import Sums
from fkgen.study.comparisons.scores import ROUNDED, TINY, Outcome
from fkgen.version import __version__

#: Within so many standard deviations.
SIGMAS = (1, 2, 3)
#: Bins of a mode's probability.
BINS = 10
#: Probabilities of a mode from which on a detector may declare it: its thresholds.
THRESHOLDS = (0.0, 0.001, 0.01, 0.05, *(k / 10 for k in range(1, 10)), 0.95, 0.99, 0.999)

_OPERATIONS = 100  # of the text, about: it is compiled with -O3


class Sizes(NamedTuple):
    """Numbers of errors, of rows that are tested, of innovations, and of modes; what there is."""

    ne: int
    tested: int
    rows: int
    modes: int
    has_nis: bool
    real: str

    @property
    def shapes(self) -> Mapping[str, tuple[int, ...]]:
        """Ratios by name: sums of a over sums of b, trial by trial."""
        modes = (self.modes, BINS)
        shapes: dict[str, tuple[int, ...]] = {"mse": (self.ne,), "claimed": (self.ne,)}
        shapes |= {"bias": (self.ne,), "coverage": (self.ne, len(SIGMAS))}
        shapes |= {"nees": (), "nis": (), "delay": (), "detected": (), "false_alarm": ()}
        shapes |= {"sensor_nis": (self.rows,), "whiteness": (self.rows,)}
        return shapes | {"calibration": modes, "predicted": modes, "excess": modes}

    @property
    def counts(self) -> int:
        """How many sums of counts there are: of each mode those of `roc`."""
        wide = 2 * len(THRESHOLDS)
        return self.modes * (wide + wide * (wide + 1) // 2)


class _Given(ctypes.Structure):
    """As in ``tally.c.j2``."""

    _fields_ = (
        ("trials", ctypes.c_int64),
        ("samples", ctypes.c_int64),
        *(
            (name, ctypes.c_void_p)
            for name in (
                *("error", "covariance", "nis", "innovation", "innovation_covariance", "y", "used"),
                *("probability", "mode", "fault", "alarm", "decided"),
            )
        ),
    )


class Tally:
    """The compiled sums for filters of some sizes; compiled anew where it is sent."""

    def __init__(self, sizes: Sizes) -> None:
        self.sizes, self._shapes = sizes, sizes.shapes
        self._numbers = sum(math.prod(shape) for shape in self._shapes.values())
        library = ctypes.CDLL(str(_library(sizes, self._numbers)))
        self._sum = library.tally
        self._sum.argtypes, self._sum.restype = (ctypes.c_void_p, ctypes.c_void_p), None

    def __reduce__(self) -> tuple[type[Tally], tuple[Sizes]]:
        return Tally, (self.sizes,)

    def sums(
        self, found: Outcome, y: NDArray[np.floating], mode: NDArray[np.integer] | None
    ) -> Sums:
        """The sums of a block.

        Parameters
        ----------
        found : Outcome
        y : (M, T, tested) ndarray
            Rows that the innovation is about; NaN = missing.
        mode : (M, T) ndarray of int, optional
            The true mode of every sample.
        """
        trials, samples = found.rows.shape
        run = found.run
        given = {"error": found.error, "covariance": found.covariance, "y": y, "used": found.used}
        for name in ("nis", "innovation", "innovation_covariance"):
            if name in run.ports:
                given[name] = run[name]
        if mode is not None:
            given |= {"probability": run["mode_probability"], "mode": mode.astype(np.uint8)}
        flags = {"fault": found.faults, "alarm": found.alarms, "decided": found.decided}
        given |= {name: each for name, each in flags.items() if each is not None}
        arrays = {name: np.ascontiguousarray(each) for name, each in given.items()}
        places = {name: each.ctypes.data for name, each in arrays.items()}
        out = np.empty(5 * self._numbers + self.sizes.counts)
        told = _Given(trials=trials, samples=samples, **places)
        self._sum(ctypes.byref(told), out.ctypes.data)
        return Sums.of(trials, self._shapes, out)


def sizes_of(compiled: CompiledFilter, ne: int, tested: int, modes: int) -> Sizes:
    """The sizes of a filter, of which ``modes`` are compared with the true ones."""
    ports = {port.name: port for port in compiled.layout.ports}
    innovation = ports.get("innovation")
    rows = 0 if innovation is None else innovation.shape[0]
    rows = rows if rows == tested and "innovation_covariance" in ports else 0
    real = "float" if compiled.scalar == "float" else "double"
    return Sizes(ne, tested, rows, modes, "nis" in ports, real)


def _library(sizes: Sizes, numbers: int) -> Path:
    compiler = find_compiler()

    def fill(folder: Path) -> None:
        from fkgen.backend.lines import filled  # noqa: PLC0415 - needs Jinja

        widths = {name: math.prod(shape) for name, shape in sizes.shapes.items()}
        starts = accumulate(widths.values(), initial=0)
        places = dict(zip(widths, zip(starts, widths.values(), strict=False), strict=True))
        unit = float(np.finfo(np.dtype("f4" if sizes.real == "float" else "f8")).eps)
        context = sizes._asdict() | {
            "bins": BINS,
            "thresholds": THRESHOLDS,
            "sigmas": len(SIGMAS),
            "places": places,
            "total": numbers,
            "rounded": repr(ROUNDED * unit),
            "tiny": repr(TINY),
            "version": __version__,
        }
        text = folder / "tally.c"
        text.write_text(filled("tally.c.j2", context), encoding="utf-8")
        compile_shared(compiler, text, folder / cache.LIBRARY, statements=_OPERATIONS)
        (folder / cache.LAYOUT).write_text("{}", encoding="utf-8")

    key = cache.key_of("tally", cache.own_digest(), repr(sizes), compiler.identity)
    return (cache.find(key) or cache.store(key, fill)) / cache.LIBRARY
