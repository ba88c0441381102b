"""Records through the hand-written forms, Eigen and fkgen; and what the core itself can do."""

from __future__ import annotations

import ctypes
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from forms.augmented import augmented
from forms.lanes import lanes
from forms.scalar import scalar
from forms.sparse import sparse
from forms.straight import straight
from harness import clock, models
from harness.settings import Settings

import fkgen

HERE = Path(__file__).resolve().parent
EIGEN = Path("/usr/include/eigen3")
FLAGS = ("-O3", "-march=native", "-fPIC", "-shared", "-fno-tree-slp-vectorize", "-w")
ROUNDING = {False: "-ffp-contract=off", True: "-ffp-contract=fast"}
_SPARSE = 0.4  # of A: fewer nonzeros than that, and sums over them are worth trying
_ERROR = 1e-9

Call = Callable[[], object]


@dataclass(frozen=True)
class Machine:
    """What one core does in a second, at most.

    Attributes
    ----------
    flops : mapping of whether fused to float
    cycles : float
    """

    flops: dict[bool, float]
    cycles: float


def machine(settings: Settings) -> Machine:
    """Measure it."""
    place = settings.folder / "peak.so"
    source = HERE / "c" / "peak.c"
    command = ["gcc", "-O2", "-march=native", "-fPIC", "-shared", str(source), "-o", str(place)]
    subprocess.run(command, check=True)
    library = ctypes.CDLL(str(place))
    rates = {}
    for name, work in (("fused", 80), ("apart", 80), ("cycles", 20)):
        call = getattr(library, name)
        call.argtypes = [ctypes.c_int64]
        best = np.inf
        for _ in range(200):
            start = time.perf_counter()
            call(5000)
            best = min(best, time.perf_counter() - start)
        rates[name] = 5000 * work / best
    return Machine({True: rates["fused"], False: rates["apart"]}, rates["cycles"])


def forms_for(spec: models.Spec) -> dict[str, str]:
    """C of every form that may be the best for a model."""
    n, p, _ = models.width(spec)
    model = spec["model"]
    found = {"augmented": augmented(model)}
    if n <= 8 and p <= 4:
        found["straight"] = straight(model)
    if (n, p) == (2, 1):
        found["scalar"] = scalar(model)
    if np.count_nonzero(model["A"]) < _SPARSE * n * n:
        found["sparse"] = sparse(model)
    return found


def compiled_forms(
    spec: models.Spec, y: models.Array, folder: Path, *, fused: bool = False
) -> dict[str, Call]:
    """Each form, compiled and found right."""
    calls = {}
    for name, text in forms_for(spec).items():
        place = folder / f"{_sized(spec)}-{name}{'-fma' if fused else ''}.so"
        source = place.with_suffix(".c")
        source.write_text(text)
        command = ["gcc", "-std=gnu99", *FLAGS, ROUNDING[fused], f"-I{HERE.parent / 'forms'}"]
        _make([*command, str(source)], place)
        calls[name] = record(place, spec, y, missing=True)
    return calls


def eigen(spec: models.Spec, y: models.Array, folder: Path) -> Call | None:
    """Fixed sizes, contraction as gcc likes; None without Eigen."""
    if not EIGEN.is_dir():
        return None
    n, p, _ = models.width(spec)
    place = folder / f"{_sized(spec)}-eigen.so"
    table = place.with_suffix(".inc")
    lines = []
    for name in ("A", "C", "Q", "R", "P0"):
        values = ", ".join(repr(float(v)) for row in spec["model"][name] for v in row)
        lines.append(f"static const double {name}_[] = {{ {values} }};\n")
    table.write_text("".join(lines))
    defines = ["-DNDEBUG", f"-DNX={n}", f"-DNY={p}", f'-DMODEL="{table}"', f"-I{EIGEN}"]
    flags = [flag for flag in FLAGS if "slp" not in flag]
    source = HERE / "c" / "eigen_record.cpp"
    _make(["g++", *flags, *defines, str(source)], place)
    return record(place, spec, y, missing=False)


def _sized(spec: models.Spec) -> str:
    """A name that no other model has."""
    return f"{spec['name']}_{models.width(spec)[1]}"


def _make(command: list[str], place: Path) -> None:
    """Compile, unless another table did: names are those of models."""
    if not place.exists():
        with clock.unpinned():
            subprocess.run([*command, "-o", str(place)], check=True)


def record(place: Path, spec: models.Spec, y: models.Array, *, missing: bool) -> Call:
    """The compiled record as a call over y, after a test against the textbook."""
    run: Any = ctypes.CDLL(str(place)).form_run
    run.restype, run.argtypes = ctypes.c_int64, [ctypes.c_int64, *[ctypes.c_void_p] * 4]
    n = models.width(spec)[0]

    def bound(rows: models.Array) -> tuple[Call, models.Array, models.Array]:
        state, last = np.zeros((len(rows), n)), np.zeros((n, n))
        status = np.zeros(len(rows), np.int32)

        def call() -> int:
            given = (rows, status, state, last)
            return int(run(len(rows), *[each.ctypes.data for each in given]))

        return call, state, last

    few = y[:40].copy()
    if missing:
        few[7, 0], few[9] = np.nan, np.nan
    call, state, last = bound(few)
    expected, covariance = textbook(spec, few)
    wrong = max(_apart(state, expected), _apart(last, covariance))
    if (
        call() != len(few)
        or not (wrong := max(_apart(state, expected), _apart(last, covariance))) <= _ERROR
    ):
        raise RuntimeError(f"{place.stem}: off the textbook by {wrong:.1e}")
    return bound(y)[0]


def _apart(value: models.Array, expected: models.Array) -> float:
    return float(np.abs(value - expected).max() / np.abs(expected).max())


def textbook(spec: models.Spec, y: models.Array) -> tuple[models.Array, models.Array]:
    """x(k|k) of all samples and P(T|T) from P(0|0) = P0, in NumPy; NaN rows are missing."""
    A, C, Q, R, P = (np.array(spec["model"][k], float) for k in ("A", "C", "Q", "R", "P0"))
    x, states = np.zeros(len(A)), []
    for row in y:
        x, P = A @ x, A @ P @ A.T + Q
        some = np.isfinite(row)
        H = C[some]
        gain = np.linalg.solve(H @ P @ H.T + R[np.ix_(some, some)], H @ P).T
        x = x + gain @ (row[some] - H @ x)
        P = P - gain @ H @ P
        states.append(x)
    return np.array(states), P


def compiled_lanes(spec: models.Spec, y: models.Array, folder: Path) -> Call:
    """Records (M, T, p) by fours, found right."""
    place = folder / f"{spec['name']}-lanes.so"
    source = place.with_suffix(".c")
    source.write_text(lanes(spec["model"]))
    command = ["gcc", "-std=gnu99", *FLAGS, ROUNDING[False], f"-I{HERE.parent / 'forms'}"]
    subprocess.run([*command, str(source), "-o", str(place)], check=True)
    run: Any = ctypes.CDLL(str(place)).form_batch
    run.restype, run.argtypes = ctypes.c_int64, [*[ctypes.c_int64] * 2, *[ctypes.c_void_p] * 3]
    state = np.zeros((*y.shape[:2], models.width(spec)[0]))
    status = np.zeros(y.shape[:2], np.int32)

    def call() -> int:
        return int(run(*y.shape[:2], *[each.ctypes.data for each in (y, status, state)]))

    if call() != len(y):
        raise RuntimeError(f"{place.stem}: a record was refused")
    wrong = _apart(state[3], textbook(spec, y[3])[0])
    if not wrong <= _ERROR:
        raise RuntimeError(f"{place.stem}: off the textbook by {wrong:.1e}")
    return call


def of_fkgen(spec: models.Spec, y: models.Array, **code: Any) -> Call | None:
    """`run` of what is generated, or None if this fkgen has no such option."""
    try:
        with clock.unpinned():
            built = fkgen.build(fkgen.Spec.from_dict(models.with_code(spec, **code)))
    except fkgen.UserError:
        return None
    if y.ndim == 3:
        return lambda: built.run_batch(y, keep=["filtered_state"])
    return lambda: built.run(y, keep=["filtered_state"])
