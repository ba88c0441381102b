"""What a step takes on the Cortex-M4F: ``python tools/footprint.py [FILTER]... [-o FILE]``.

Float; each filter with both updates, with and without fma, straight and in loops, at -O2 and -Os:
of every figure the least with the choice that gives it, then all choices, "auto" first.
"""

from __future__ import annotations

import argparse
import itertools
import os
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import fkgen
from fkgen.proof import agreement
from fkgen.target.boards import board
from fkgen.target.elf import read_image
from fkgen.target.toolchain import compiled, linked, toolchain
from fkgen.target.verify import STEPS, on_host, tried

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "bench"))

from harness.models import dense  # noqa: E402

FIGURES = ("instructions", "step B", "text B", "stack B")
VERBS = ("init", "step", "update", "predict")
CHOICES = [
    {"update": update, "fma": fma, "form": form, "optimise": optimise}
    for update, fma, form, optimise in itertools.product(
        ("joseph", "ud"), (False, True), ("straight", "loops"), ("speed", "size")
    )
]
AUTO = [{"optimise": optimise} for optimise in ("speed", "size")]


def axes() -> dict[str, Any]:
    """Position, velocity and acceleration along two axes, and two biases; three rows."""
    axis = np.array([[1.0, 0.01, 5e-5], [0.0, 1.0, 0.01], [0.0, 0.0, 1.0]])
    A, C = np.diag([0.0] * 6 + [0.999] * 2), np.zeros((3, 8))
    A[:3, :3] = A[3:6, 3:6] = axis
    C[[0, 1, 1, 2, 2], [0, 3, 6, 1, 7]] = 1.0
    model = {
        "A": A.tolist(),
        "C": C.tolist(),
        "Q": np.diag([1e-8, 1e-5, 1e-3, 1e-8, 1e-5, 1e-3, 1e-7, 1e-7]).tolist(),
        "R": np.diag([4.0, 4.0, 0.01]).tolist(),
        "x0": [0.0] * 8,
        "P0": np.diag([100.0, 10.0, 1.0, 100.0, 10.0, 1.0, 1.0, 1.0]).tolist(),
    }
    return {"name": "axes8", "model": model, "filter": {"family": "kf"}}


def switching() -> dict[str, Any]:
    """Four states, two rows, three modes that differ in Q."""
    table = dense(4, 2)
    Q = np.array(table["model"]["Q"])
    jump = {
        "modes": [{"Q": (scale * Q).tolist()} for scale in (1.0, 10.0, 100.0)],
        "transition": [[0.9, 0.05, 0.05], [0.05, 0.9, 0.05], [0.05, 0.05, 0.9]],
    }
    return {**table, "name": "switching", "faults": {"jump": jump}, "filter": {"family": "imm"}}


def filters() -> dict[str, fkgen.Spec]:
    """The filters by name: examples, and models of the benchmarks."""
    made = {"switching": switching(), "axes8": axes()} | {
        f"dense{n}": dense(n, 3) for n in (6, 8, 12)
    }
    files = {
        "motor": "dc_motor/known_rate.toml",
        "gps_glitch": "gps_glitch/spec.toml",
        "markov_jump": "markov_jump/spec.toml",
        "wheel_drift": "wheel_drift/spec.toml",
    }
    found = {name: fkgen.load(ROOT / "examples" / path) for name, path in files.items()}
    return found | {name: fkgen.Spec.from_dict(table) for name, table in made.items()}


@dataclass(frozen=True)
class Found:
    """Figures of one choice."""

    filter: str
    choice: str
    figures: tuple[int, ...]  # As FIGURES names them; none if it cannot be generated


def one(job: tuple[str, dict[str, Any]]) -> Found:
    """Generate, build and run one choice of one filter."""
    name, options = job
    spec = filters()[name]
    spec = replace(spec, code=replace(spec.code, scalar="float", **options))
    choice = " ".join([spec.code.update, *(["fma"] if spec.code.fma else []), spec.code.form])
    choice += " -Os" if spec.code.optimise == "size" else " -O2"
    where = board("cortex-m4f")
    tools = toolchain(where)
    try:
        source, record = fkgen.generate(fkgen.validate(spec)), agreement.trial(spec, STEPS)
        claims, figures = tried(where, tools, source, record, on_host(source, record))
    except fkgen.FkgenError as refused:
        print(name, choice, refused, file=sys.stderr)
        return Found(name, choice, ())
    if not all(claim.holds for claim in claims):
        raise SystemExit(f"{name} {choice}: other bits than this machine")
    with tempfile.TemporaryDirectory(prefix="fkgen-") as place:
        objects = compiled(tools, source, (), Path(place))
        roots = [f"{spec.name}_{verb}" for verb in VERBS]
        script = Path(place) / "board.ld"
        script.write_text((ROOT / "templates/board.ld").read_text(encoding="utf-8"))
        text = read_image(linked(tools, objects, roots, Path(place) / "text.elf")).flash
    return Found(name, choice, (figures.instructions_max, figures.flash, text, figures.stack))


def least(found: list[Found], which: int) -> str:
    """The smallest of a figure, and the choice that gives it."""
    best = min((each for each in found if each.figures), key=lambda each: each.figures[which])
    return f"{best.figures[which]} ({best.choice})"


def main() -> int:
    """Run everything; print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("filters", nargs="*", metavar="FILTER", help="all, if none is given")
    parser.add_argument("-o", "--output", type=Path, help="Markdown file for all figures")
    given = parser.parse_args()
    names = given.filters or list(filters())
    jobs = [(name, options) for name in names for options in (*AUTO, *CHOICES)]
    print(f"| filter | {' | '.join(FIGURES)} |\n|{' --- |' * (1 + len(FIGURES))}")
    lines = [f"| filter | choice | {' | '.join(FIGURES)} |", f"|{' --- |' * (2 + len(FIGURES))}"]
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        every = list(pool.map(one, jobs))
    for name in names:
        found = [each for each in every if each.filter == name]
        print(f"| {name} | {' | '.join(least(found, i) for i in range(len(FIGURES)))} |")
        lines += [
            f"| {name} | {each.choice} | {' | '.join(map(str, each.figures))} |" for each in found
        ]
    if given.output is not None:
        given.output.write_text("\n".join([*lines, ""]), encoding="utf-8")
    print(*lines, sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
