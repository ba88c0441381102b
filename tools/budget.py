"""Check the budget: ``python tools/budget.py``. Growth has to be a decision.

No room above 12 files, no function above 50 lines, no module named for being a drawer.
Prints the sizes, so that a change shows what it costs.
"""

from __future__ import annotations

import ast
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
ROOM_FILES = 12
PACKAGE_LINES = 53_300
FUNCTION_LINES = 50
DRAWERS = {"common", "helpers", "misc", "util", "utils"}


def main() -> int:
    """Print sizes and excesses; return the exit status."""
    modules = sorted((ROOT / "fkgen").rglob("*.py"))
    templates = sorted(path for path in (ROOT / "templates").rglob("*") if path.is_file())
    print(summary("fkgen", modules))
    print(summary("templates", templates))
    excesses = [*crowded(modules), *(excess for path in modules for excess in excesses_of(path))]
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


def crowded(modules: list[Path]) -> Iterator[str]:
    """Name every room with too many files, and the package if it has too many lines."""
    for room, files in sorted(Counter(path.parent for path in modules).items()):
        allowed = 2 + len(families()) if room.name == "families" else ROOM_FILES
        if files > allowed:
            yield f"{room.relative_to(ROOT)} has {files} files, budget {allowed}"
    lines = sum(len(text_of(path).splitlines()) for path in modules)
    if lines > PACKAGE_LINES:
        yield f"fkgen has {lines} lines, budget {PACKAGE_LINES}"


def families() -> list[Path]:
    """The files of ``fkgen/families`` that hold a family."""
    files = (ROOT / "fkgen" / "families").glob("*.py")
    return [path for path in files if "FAMILY = Family(" in text_of(path)]


def excesses_of(path: Path) -> Iterator[str]:
    """Name everything in one module that is above the budget."""
    text, where = text_of(path), path.relative_to(ROOT)
    if path.stem in DRAWERS:
        yield f"{where} is named for nothing in particular"
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
