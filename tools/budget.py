"""Check the budget: ``python tools/budget.py``. Growth has to be a decision.

No module of the package above 300 lines, no function above 50, no module named for being a drawer.
Prints the sizes, so that a change shows what it costs.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
MODULE_LINES = 300
FUNCTION_LINES = 50
DRAWERS = {"common", "helpers", "misc", "util", "utils"}


def main() -> int:
    """Print sizes and excesses; return the exit status."""
    modules = sorted((ROOT / "fkgen").rglob("*.py"))
    templates = sorted(path for path in (ROOT / "templates").rglob("*") if path.is_file())
    print(summary("fkgen", modules))
    print(summary("templates", templates))
    excesses = [excess for path in modules for excess in excesses_of(path)]
    for excess in excesses:
        print(f"over budget: {excess}")
    return 1 if excesses else 0


def summary(name: str, paths: list[Path]) -> str:
    """Say how many lines there are, and where most of them."""
    lines = {path: len(text_of(path).splitlines()) for path in paths}
    text = f"{name}: {sum(lines.values())} lines in {len(paths)} files"
    if not paths:
        return text
    largest = max(paths, key=lines.__getitem__)
    return f"{text}, at most {lines[largest]} ({largest.relative_to(ROOT)})"


def excesses_of(path: Path) -> Iterator[str]:
    """Name everything in one module that is above the budget."""
    text, where = text_of(path), path.relative_to(ROOT)
    lines = len(text.splitlines())
    if path.stem in DRAWERS:
        yield f"{where} is named for nothing in particular"
    if lines > MODULE_LINES:
        yield f"{where} has {lines} lines, budget {MODULE_LINES}"
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.end_lineno is not None:
            length = node.end_lineno - node.lineno + 1
            place = f"{where}:{node.lineno} {node.name}"
            if length > FUNCTION_LINES:
                yield f"{place} has {length} lines, budget {FUNCTION_LINES}"


def text_of(path: Path) -> str:
    """Read one source file."""
    return path.read_text(encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
