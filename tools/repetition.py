"""Say how much of each generated .c file repeats an earlier shape, and how long its functions are.

    python tools/repetition.py          a line for each file; exit status 1 if one is over a limit

A shape is twelve lines in a row, with names and numbers masked.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

GENERATED = Path(__file__).resolve().parents[1] / "generated"
WINDOW = 12
MOST_REPEATED = 0.35
LONGEST_FUNCTION = 400

KEYWORDS = {
    "const",
    "double",
    "float",
    "if",
    "else",
    "return",
    "static",
    "int",
    "uint32_t",
    "uint64_t",
    "int32_t",
    "for",
    "while",
    "void",
    "struct",
    "typedef",
}
_WORD = re.compile(r"[A-Za-z_]\w*|(?<![A-Za-z_])\d[\w.]*(?:[eE][+-]?\d+)?")


def shape(line: str) -> str:
    """A line without comments, its names and numbers masked."""
    code = re.sub(r"/\*.*?\*/", "", line)
    return _WORD.sub(lambda m: m[0] if m[0] in KEYWORDS else "N", code).strip()


def repeated(text: str) -> float:
    """Share of the lines that lie in a window whose shape began earlier."""
    shapes = [shape(line) for line in text.splitlines()]
    seen: set[tuple[str, ...]] = set()
    covered: set[int] = set()
    for i in range(len(shapes) - WINDOW + 1):
        window = tuple(shapes[i : i + WINDOW])
        if window in seen:
            covered.update(range(i, i + WINDOW))
        seen.add(window)
    return len(covered) / max(1, len(shapes))


def longest_function(text: str) -> int:
    """Lines from the brace that opens the longest function to the one that closes it."""
    longest, start = 0, 0
    for i, line in enumerate(text.splitlines()):
        if line == "{":
            start = i
        elif line == "}":
            longest = max(longest, i - start + 1)
    return longest


def main() -> int:
    """Run as a script."""
    over = 0
    for path in sorted(GENERATED.glob("*/*.c")):
        text = path.read_text(encoding="utf-8")
        share, longest = repeated(text), longest_function(text)
        bad = share > MOST_REPEATED or longest > LONGEST_FUNCTION
        over += bad
        print(
            f"{path.name:34s} {len(text.splitlines()):6d} lines, longest function {longest:4d},"
            f" repeated {share:4.0%}{'  over the limit' if bad else ''}"
        )
    return 1 if over else 0


if __name__ == "__main__":
    sys.exit(main())
