"""Generated C that draws trials, behind NumPy arrays: blocks of trials, on all cores."""

from __future__ import annotations

import ctypes
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import DataError
from fkgen.problem import Spec
from fkgen.runtime import cache
from fkgen.runtime.compiler import Compiler, compile_shared, find_compiler, travelled
from fkgen.symbolic.interface import Status

Array = NDArray[np.float64]
Codes = NDArray[np.uint8]

_WRITTEN = ("state", "measurement", "condition", "coin", "hypothesis")  # what C fills


@dataclass(frozen=True, slots=True, eq=False)
class Trials:
    """A block of trials, as C wrote it; empty where there is nothing of the kind."""

    state: Array  # (M, T, n)
    measurement: Array  # (M, T, p)
    condition: Codes  # (M, T), of the chain
    coin: Codes  # (M, T, c)
    hypothesis: Codes  # (M,)
    modes: Codes  # (K,), the mode of each condition
    lost: Codes  # (K,), whether the sample is lost in it

    def part(self, start: int, stop: int) -> Trials:
        """Trials ``start`` to ``stop - 1``, in the same memory."""
        return replace(self, **{name: getattr(self, name)[start:stop] for name in _WRITTEN})


class CompiledSampler:
    """A compiled sampler, from its folder in the cache."""

    def __init__(self, entry: Path) -> None:
        self.folder = entry
        facts = json.loads((entry / cache.LAYOUT).read_text(encoding="utf-8"))
        self._nx, self._nu, self._ny = facts["sizes"]
        self._coins, self._hypotheses = facts["coins"], facts["hypotheses"]
        self._modes, self._lost = (np.array(facts[key], np.uint8) for key in ("modes", "lost"))
        library, name = ctypes.CDLL(str(entry / cache.LIBRARY)), facts["name"]
        self._sample = library[f"{name}_sample"]
        integers = [ctypes.c_uint64, ctypes.c_uint32, ctypes.c_int64, ctypes.c_int64]
        pointer = ctypes.c_void_p
        self._sample.argtypes = [*integers, *[pointer] * 3, ctypes.c_int64, *[pointer] * 6]
        self._block = library[f"{name}_block"]
        self._block.argtypes = [pointer] * 3
        self._block.restype = None
        self._quantile = library[f"{name}_quantile"]
        self._quantile.argtypes, self._quantile.restype = [ctypes.c_double], ctypes.c_double

    def __reduce__(self) -> tuple[Any, ...]:
        """Rebuild from the cache, or from the generated C where that is gone."""
        files = [*self.folder.glob("*.c"), self.folder / cache.LAYOUT]
        texts = {path.name: path.read_text(encoding="utf-8") for path in files}
        return _revived, (self.folder.name, texts, cache.processor())

    def empty(self, runs: int, steps: int) -> Trials:
        """Room for trials."""
        chain = (runs, steps) if self._modes.size else (0, 0)
        return Trials(
            np.empty((runs, steps, self._nx)),
            np.empty((runs, steps, self._ny)),
            np.empty(chain, np.uint8),
            np.empty((runs, steps, self._coins), np.uint8),
            np.empty(runs if self._hypotheses else 0, np.uint8),
            self._modes,
            self._lost,
        )

    def draw(
        self, seed: int, first: int, u: Array, parameters: Sequence[Array], room: Trials
    ) -> None:
        """Draw trials ``first``, ``first + 1``, ... into ``room``; DataError if C refuses a sample.

        ``u`` is (T, q) or (M, T, q), each parameter one number or T, all of it contiguous.
        """
        runs, steps = room.state.shape[:2]
        pointers = (ctypes.c_void_p * max(1, len(parameters)))(*[p.ctypes.data for p in parameters])
        strides = np.array([int(p.size > 1) for p in parameters] or [0], np.int64)
        where = ctypes.c_int64(0)
        status = self._sample(
            seed,
            first,
            runs,
            steps,
            pointers,
            strides.ctypes.data,
            u.ctypes.data,
            steps * self._nu if u.ndim == 3 else 0,
            *[getattr(room, name).ctypes.data for name in _WRITTEN],
            ctypes.byref(where),
        )
        if status < 0:
            trial, sample = divmod(where.value, steps)
            at = f"at sample {sample} of trial {first + trial}"
            if status == Status.PARAMETER_OUT_OF_RANGE.value:
                given = f"out of range, or with a variance below 0 or a rate outside [0, 1], {at}"
                law = "values in range, with which Q and R are covariances, rates probabilities"
                raise DataError("params", given=given, expected=law)
            given = f"{steps}, and numbers that overflow {at}"
            stable = "fewer steps: the plant is not stable, and its state grows without bounds"
            raise DataError("steps", given=given, expected=stable)

    def block(self, counter: Sequence[int], key: Sequence[int]) -> tuple[int, ...]:
        """Four words of the generator, for tests."""
        out = (ctypes.c_uint32 * 4)()
        self._block((ctypes.c_uint32 * 4)(*counter), (ctypes.c_uint32 * 2)(*key), out)
        return tuple(out)

    def quantile(self, probability: float) -> float:
        """The normal number of a probability, for tests."""
        return float(self._quantile(probability))


def sampler(spec: Spec) -> CompiledSampler:
    """Write the plant and the faults of a spec as C that draws trials, compile and load it."""
    compiler = find_compiler()

    def fill(folder: Path) -> None:
        from fkgen.trials.sampling import render_sampler  # noqa: PLC0415 - CasADi

        source = render_sampler(spec)
        _fill(compiler, folder, {f"{spec.name}_sampler.c": source.text, cache.LAYOUT: source.facts})

    laws = repr(spec.faults) if spec.faults.law_names else ""  # with their numbers at sample 0
    key = cache.key_of("sampler", cache.own_digest(), spec.canonical(), laws, compiler.identity)
    return CompiledSampler(cache.find(key) or cache.store(key, fill))


def _fill(compiler: Compiler, folder: Path, texts: Mapping[str, str]) -> None:
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    (source,) = folder.glob("*_sampler.c")
    statements = json.loads(texts[cache.LAYOUT])["operations"]
    compile_shared(compiler, source, folder / cache.LIBRARY, statements=statements)


def _revived(key: str, texts: Mapping[str, str], processor: str) -> CompiledSampler:
    """A sampler that was pickled."""

    def fill(compiler: Compiler, folder: Path) -> None:
        _fill(compiler, folder, texts)

    return CompiledSampler(travelled(key, texts, processor, fill))
