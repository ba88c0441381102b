"""How long one waits in a fresh process: import, command line, building cold and from the cache."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from harness import models
from harness.report import Table, verdict
from harness.settings import Settings

_HEAVY = ("casadi", "sympy", "control", "matplotlib", "scipy")
_IMPORT, _COLD, _CACHED = 0.25, 2.0, 0.1

_LOADED = f"""
import contextlib, io, sys
{{statement}}
print(*[name for name in {_HEAVY!r} if name in sys.modules])
"""
_HELP = """
with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
    from fkgen.cli import main
    sys.argv = ["fkgen", "--help"]
    main()
"""
_BUILD = """
import json, sys, time
start = time.perf_counter()
import fkgen
spec = fkgen.Spec.from_dict(json.loads(sys.argv[1]))
read = time.perf_counter()
fkgen.build(spec)
first = time.perf_counter()
fkgen.build(spec)
print(json.dumps([first - start, first - read, time.perf_counter() - first]))
"""
_STAGES = """
import json, sys, time
marks = [("", time.perf_counter())]
def mark(name):
    marks.append((name, time.perf_counter()))
import numpy; mark("import numpy")
import fkgen
spec = fkgen.Spec.from_dict(json.loads(sys.argv[1])); mark("import fkgen, read the spec")
import casadi; mark("import casadi")
import scipy.linalg; mark("import scipy.linalg")
import fkgen.families, fkgen.proof; mark("import families and proof")
design = fkgen.validate(spec); mark("validate")
import jinja2; mark("import jinja2")
source = fkgen.generate(design); mark("generate")
fkgen.compile(source); mark("compile and load")
print(json.dumps([[b[0], b[1] - a[1]] for a, b in zip(marks, marks[1:])]))
"""


def waiting(settings: Settings) -> Table:
    """Seconds until something has happened."""
    table = Table(
        "Waiting",
        ["what", "seconds", "target", "met", "heavy imports"],
        "Wall time of fresh processes, best of several, the interpreter's own start included "
        f"({_process([sys.executable, '-c', 'pass'], 5):.3f} s). Builds are timed inside. "
        f"Heavy: {', '.join(_HEAVY)}.",
    )
    times = 3 if settings.rounds < 20 else 7
    for what, statement, command in (
        ("import fkgen", "import fkgen", ["-c", "import fkgen"]),
        ("fkgen --help", _HELP, ["-m", "fkgen", "--help"]),
    ):
        seconds = _process([sys.executable, *command], times)
        loaded = _python(_LOADED.replace("{statement}", statement)).strip() or "none"
        table.add(what, f"{seconds:.3f}", _IMPORT, verdict(seconds, _IMPORT), loaded)
    spec = json.dumps(models.mkf())
    with tempfile.TemporaryDirectory() as folder:
        cold = [_build(spec, Path(folder) / str(k)) for k in range(max(2, times // 2))]
        warm = [_build(spec, Path(folder) / "0") for _ in range(times)]
    rows = (
        ("import and build, cold", min(b[0] for b in cold), _COLD),
        ("import and build, from the cache", min(b[0] for b in warm), _CACHED),
        ("of it build(spec), from the cache", min(b[1] for b in warm), _CACHED),
        ("build(spec) again in the same process", min(b[2] for b in warm), _CACHED),
    )
    for what, seconds, target in rows:
        table.add(what, f"{seconds:.4f}", target, verdict(seconds, target), "")
    return table


def stages(settings: Settings) -> Table:
    """Where a cold build spends its time."""
    table = Table(
        "A cold build of the motor, part by part",
        ["part", "seconds"],
        "mkf, two states; each part's minimum over fresh processes with an empty cache.",
    )
    spec, found = json.dumps(models.mkf()), {}
    for _ in range(2 if settings.rounds < 20 else 5):
        with tempfile.TemporaryDirectory() as folder:
            for name, seconds in json.loads(_python(_STAGES, spec, cache=folder)):
                found[name] = min(seconds, found.get(name, seconds))
    for name, seconds in found.items():
        table.add(name, f"{seconds:.3f}")
    table.add("sum", f"{sum(found.values()):.3f}")
    return table


def _build(spec: str, folder: Path) -> list[float]:
    """Seconds of import and build, of the build alone, and of a second build."""
    taken: list[float] = json.loads(_python(_BUILD, spec, cache=str(folder)))
    return taken


def _python(script: str, *arguments: str, cache: str | None = None) -> str:
    environment = {**os.environ, **({"FKGEN_CACHE": cache} if cache else {})}
    done = subprocess.run(
        [sys.executable, "-c", script, *arguments],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(done.stderr)
    return done.stdout


def _process(command: list[str], times: int) -> float:
    taken = []
    for _ in range(times):
        start = time.perf_counter()
        subprocess.run(command, capture_output=True, check=True)
        taken.append(time.perf_counter() - start)
    return min(taken)
