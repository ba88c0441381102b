"""`run` over a record against a bare C loop that stores the same, and `step` from Python."""

from __future__ import annotations

import ctypes
import subprocess
from collections.abc import Callable, Sequence

import numpy as np
from harness import clock, models
from harness.report import Table, ns, times, verdict
from harness.settings import Settings
from rivals import contenders

import fkgen
from fkgen.symbolic.interface import Port

_SAMPLES = 100_000
_RUN, _STEP = 1.3, 3e-6


def runs(settings: Settings) -> Table:
    """Cost of a sample of `run`."""
    table = Table(
        f"`run` over {_SAMPLES} samples",
        [
            "filter",
            "kept",
            "run, ns",
            "run / loop, new arrays",
            "run / loop, same arrays",
        ],
        "Per sample. The loop calls the generated step and stores the same arrays (symmetric "
        "matrices in full) and the status, same compiler and flags. `run` allocates its arrays, "
        "so does the first loop, the second writes into the same ones again. "
        f"Target: at most {_RUN} of the loop.",
    )
    picked = ("kf n2 p1, C = [0 1]", "kf n6 p3, full", "mkf motor", "mme motor, 5 hypotheses")
    for title in picked:
        spec = models.all_models()[title]
        motor = fkgen.build(fkgen.Spec.from_dict(spec))
        for kept in (("filtered_state",), motor.ports):
            label = "all ports" if len(kept) > 1 else kept[0]
            table.add(title, label, *_compare(spec, motor, kept, settings))
    return table


def _compare(
    spec: models.Spec, motor: fkgen.CompiledFilter, kept: Sequence[str], settings: Settings
) -> list[str]:
    y, u = models.record(spec, _SAMPLES)
    q = u.shape[1]
    ports = [port for port in motor.layout.ports if port.name in kept]
    loop = _bare_loop(spec, ports, settings)
    same = _arrays(ports)
    calls: dict[str, Callable[[], object]] = {
        "run": lambda: motor.run(y, u if q else None, keep=list(kept)),
        "new": lambda: loop(y, u, _arrays(ports)),
        "same": lambda: loop(y, u, same),
    }
    expected, (values, _) = motor.run(y, u if q else None, keep=list(kept)), same
    loop(y, u, same)
    for port, array in zip(ports, values, strict=True):
        if not np.array_equal(expected[port.name], array, equal_nan=True):
            raise RuntimeError(f"{spec['name']}: run and the loop disagree on {port.name}")
    taken = clock.take_turns(calls, settings.rounds, settings.seconds)
    ratios = [taken.ratio("run", other) for other in ("new", "same")]
    cells = [ns(taken.best("run") / _SAMPLES)]
    return cells + [f"{times(ratio)} ({verdict(ratio, _RUN)})" for ratio in ratios]


Arrays = tuple[list[models.Array], np.ndarray]


def _arrays(ports: Sequence[Port]) -> Arrays:
    return [np.empty((_SAMPLES, *port.shape)) for port in ports], np.empty(_SAMPLES, np.int32)


def _bare_loop(
    spec: models.Spec, ports: Sequence[Port], settings: Settings
) -> Callable[[models.Array, models.Array, Arrays], None]:
    name = spec["name"]
    contenders.of_fkgen(spec, settings.folder)
    source = settings.folder / f"loop-{name}-{len(ports)}.c"
    source.write_text(_loop_text(spec, ports))
    library = source.with_suffix(".so")
    command = ["cc", "-O2", "-shared", *contenders.FLAGS, f"-I{settings.folder / name}"]
    subprocess.run([*command, str(source), "-o", str(library)], check=True)
    run = ctypes.CDLL(str(library)).run
    run.argtypes = [ctypes.c_int64, *[ctypes.c_void_p] * 4]
    run.restype = None

    def call(y: models.Array, u: models.Array, arrays: Arrays) -> None:
        values, status = arrays
        places = (ctypes.c_void_p * len(values))(*[value.ctypes.data for value in values])
        run(len(y), y.ctypes.data, u.ctypes.data, status.ctypes.data, places)

    return call


def _loop_text(spec: models.Spec, ports: Sequence[Port]) -> str:
    name = spec["name"]
    _, p, q = models.width(spec)
    u = f"u + k * {q}, " if q else ""
    stores = [
        f"        out[{i}][k * {int(np.prod(port.shape))} + {at}] = f.{port.name}{member};"
        for i, port in enumerate(ports)
        for at, member in _members(port)
    ]
    return "\n".join(
        [
            f'#include "{name}.c"',
            "#include <stdint.h>",
            '__attribute__((visibility("default")))',
            "void run(int64_t n, const double *y, const double *u, int32_t *status, double **out)",
            "{",
            f"    {name}_t f;",
            f"    (void)u; (void){name}_init(&f);",
            "    for (int64_t k = 0; k < n; ++k)",
            "    {",
            f"        status[k] = {name}_step(&f, {u}y + k * {p}, 0xffffffffu);",
            *stores,
            "    }",
            "}\n",
        ]
    )


def _members(port: Port) -> list[tuple[int, str]]:
    """Position in the full array, and the member that holds the value."""
    if not port.shape:
        return [(0, "")]
    if not port.symmetric:
        return [(i, f"[{i}]") for i in range(int(np.prod(port.shape)))]
    n = port.shape[-1]
    packed = n * (n + 1) // 2
    return [
        (m * n * n + i * n + j, f"[{m * packed + max(i, j) * (max(i, j) + 1) // 2 + min(i, j)}]")
        for m in range(int(np.prod(port.shape[:-2])))
        for i in range(n)
        for j in range(n)
    ]


def python_steps(settings: Settings) -> Table:
    """Cost of one call of `step`, and of `update` and `predict` in its place."""
    table = Table(
        "`step` from Python",
        ["filter", "rows", "step, us", f"target {_STEP * 1e6:.0f} us", "step / C", "both / step"],
        "One call per sample; the snapshot that it returns is not read. C is the same step called "
        "through ctypes with the same arguments in place; both are `update` and `predict`, which "
        "return a snapshot each.",
    )
    for title in ("kf n2 p1, C = [0 1]", "kf n6 p3, full", "mkf motor"):
        spec = models.all_models()[title]
        motor = fkgen.build(fkgen.Spec.from_dict(spec))
        y, u = models.record(spec, 500)
        arrays = list(zip(y, u, strict=True)) if u.shape[1] else [(row,) for row in y]
        lists = [tuple(part.tolist() for part in row) for row in arrays]
        for held, rows in (("arrays", arrays), ("lists", lists)):
            taken = clock.take_turns(_calls(motor, rows), settings.rounds, settings.seconds)
            each = taken.best("step") / len(y)
            ratios = taken.ratio("step", "C"), taken.ratio("both", "step")
            table.add(title, held, f"{each * 1e6:.2f}", verdict(each, _STEP), *map(times, ratios))
    return table


def _calls(
    motor: fkgen.CompiledFilter, rows: Sequence[tuple[object, ...]]
) -> dict[str, Callable[[], None]]:
    """A record in steps, in updates and predictions, and in bare calls of the same C."""

    def step() -> None:
        for row in rows:
            motor.step(*row)

    def both() -> None:
        for row in rows:
            motor.update(*row)
            motor.predict(*row[1:])

    def bare() -> None:
        for _ in rows:
            motor._step(motor._call)  # noqa: SLF001

    return {"step": step, "both": both, "C": bare}
