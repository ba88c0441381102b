"""Generated C that draws trials, behind NumPy arrays: blocks of trials, on all cores."""

from __future__ import annotations

import ctypes
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fkgen.runtime import cache
from fkgen.runtime.compiler import Compiler, compile_shared, find_compiler
from fkgen.symbolic.interface import Status

if TYPE_CHECKING:
    from fkgen.problem import Spec
    from fkgen.trials.lowering import SamplerSource

Array = NDArray[np.float64]
Codes = NDArray[np.uint8]


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

    @property
    def written(self) -> tuple[Array, Array, Codes, Codes, Codes]:
        """What C fills."""
        return self.state, self.measurement, self.condition, self.coin, self.hypothesis

    def part(self, start: int, stop: int) -> Trials:
        """Trials ``start`` to ``stop - 1``, in the same memory."""
        part = slice(start, stop)
        return Trials(
            self.state[part],
            self.measurement[part],
            self.condition[part],
            self.coin[part],
            self.hypothesis[part],
            self.modes,
            self.lost,
        )


class Overflow(Exception):
    """C stopped: a parameter is out of range, or numbers grew beyond all bounds."""

    def __init__(self, status: int, trial: int, sample: int) -> None:
        self.status, self.trial, self.sample = Status(status), trial, sample
        super().__init__(f"trial {trial}, sample {sample}: {self.status.meaning}")


class CompiledSampler:
    """A compiled sampler, from its folder in the cache."""

    def __init__(self, entry: Path) -> None:
        facts = json.loads((entry / cache.LAYOUT).read_text(encoding="utf-8"))
        self.name: str = facts["name"]
        self.parameters: tuple[str, ...] = tuple(facts["parameters"])
        self.nx, self.nu, self.ny = facts["sizes"]
        self._coins, self._hypotheses = facts["coins"], facts["hypotheses"]
        self._modes, self._lost = (np.array(facts[key], np.uint8) for key in ("modes", "lost"))
        library = ctypes.CDLL(str(entry / cache.LIBRARY))
        self._sample = library[f"{self.name}_sample"]
        integers = [ctypes.c_uint64, ctypes.c_uint32, ctypes.c_int64, ctypes.c_int64]
        pointer = ctypes.c_void_p
        self._sample.argtypes = [*integers, *[pointer] * 3, ctypes.c_int64, *[pointer] * 6]
        self._block = library[f"{self.name}_block"]
        self._block.argtypes = [pointer] * 3
        self._block.restype = None
        self._quantile = library[f"{self.name}_quantile"]
        self._quantile.argtypes, self._quantile.restype = [ctypes.c_double], ctypes.c_double

    def empty(self, runs: int, steps: int) -> Trials:
        """Room for trials."""
        chain = (runs, steps) if self._modes.size else (0, 0)
        return Trials(
            np.empty((runs, steps, self.nx)),
            np.empty((runs, steps, self.ny)),
            np.empty(chain, np.uint8),
            np.empty((runs, steps, self._coins), np.uint8),
            np.empty(runs if self._hypotheses else 0, np.uint8),
            self._modes,
            self._lost,
        )

    def draw(
        self, seed: int, first: int, u: Array, parameters: Sequence[Array], room: Trials
    ) -> None:
        """Draw trials ``first``, ``first + 1``, ... into ``room``; Overflow if C refuses a sample.

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
            steps * self.nu if u.ndim == 3 else 0,
            *[array.ctypes.data for array in room.written],
            ctypes.byref(where),
        )
        if status < 0:
            raise Overflow(status, first + where.value // steps, where.value % steps)

    def block(self, counter: Sequence[int], key: Sequence[int]) -> tuple[int, ...]:
        """Four words of the generator, for tests."""
        out = (ctypes.c_uint32 * 4)()
        self._block((ctypes.c_uint32 * 4)(*counter), (ctypes.c_uint32 * 2)(*key), out)
        return tuple(out)

    def quantile(self, probability: float) -> float:
        """The normal number of a probability, for tests."""
        return float(self._quantile(probability))


def make_sampler(key: str, source: SamplerSource, compiler: Compiler) -> Path:
    """Compile a sampler into the cache; the folder of the finished entry."""

    def fill(folder: Path) -> None:
        text = folder / f"{source.name}_sampler.c"
        text.write_text(source.text, encoding="utf-8")
        compile_shared(compiler, text, folder / cache.LIBRARY, flops=source.operations)
        (folder / cache.LAYOUT).write_text(source.facts, encoding="utf-8")

    return cache.store(key, fill)


def sampler(spec: Spec) -> CompiledSampler:
    """Write the plant and the faults of a spec as C that draws trials, compile and load it."""
    compiler = find_compiler()
    key = cache.key_of("sampler", cache.own_digest(), spec.canonical(), compiler.identity)
    return CompiledSampler(cache.find(key) or make_sampler(key, _source_of(spec), compiler))


def _source_of(spec: Spec) -> SamplerSource:
    from fkgen.trials.lowering import lower_sampling, render_sampler  # noqa: PLC0415 - CasADi
    from fkgen.trials.sampling import sampling_of  # noqa: PLC0415 - CasADi

    return render_sampler(lower_sampling(sampling_of(spec)))
