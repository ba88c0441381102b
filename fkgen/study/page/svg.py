"""Figures as SVG inside a page: with a title and a description, in the page's colours and font."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from html import escape
from itertools import groupby
from typing import Any

import matplotlib as mpl
from markupsafe import Markup
from matplotlib.figure import Figure

#: Colours of figures, and what they are on a dark page.
COLOURS = {
    "#000000": "#e6e6e6",
    "#6b6b6b": "#a3a3a3",
    "#1f5a94": "#6fb1f0",
    "#d9741a": "#f0954a",
    "#4c9a6a": "#6cc090",
    "#a14a76": "#d888b2",
    "#c9a227": "#e0bf55",
    "#6a7fc1": "#98a9e6",
    "#7b5b3a": "#b8977a",
    "#5fa8b8": "#80c8d8",
}
_STYLE: Any = {"svg.hashsalt": "fkgen", "svg.fonttype": "none", "path.simplify_threshold": 0.3}
#: Dots of one kind in a panel at most, and sides of the squares of which one each is drawn.
_DOTS, _SIDES = 4000, (0.25, 0.5, 1.0, 2.0, 3.0, 4.0, 6.0)
#: Pixels of a point: where figures of 9 inches are as wide as the page, and on a phone.
_SCALE, _LEAST = 1.53, 1.1
_EDGE = 1.0  # line round a dot
#: Vertices from which on those of a path that share a column are thinned out, and its width.
_LONG, _COLUMN = 3000, 0.5

_PATH = re.compile(r'(<path[^>]*? d=")([^"]*)"')
_USE = r'<use xlink:href="#(\w+)" x="([-\d.]+)" y="([-\d.]+)" style="([^"]*)"/>'
_USES = re.compile(rf"(?:{_USE}\s*){{2,}}")
_ROUND = re.compile(r'<path id="(\w+)" d="M 0 ([\d.]+)\s+C[^"]*"')
_TAG = re.compile(r"<[^>]*>")
_NUMBER = re.compile(r"-?\d+\.\d{3,}")
_REFERRED = re.compile(r'(?:href="#|url\(#)(\w+)')
_FONT = re.compile(r"font-family: [^;\"]*|font: (?P<size>[\d.]+px) [^;\"]*")

Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure in a page."""

    title: str
    text: str
    svg: str

    @classmethod
    def of(cls, figure: Figure, key: str, title: str, text: str) -> Picture:
        """Draw a figure; ``key`` begins what names its parts."""
        return cls(title, text, Markup(inline(figure, key, title, text)))  # noqa: S704 - our own


def inline(figure: Figure, key: str, title: str, text: str) -> str:
    """A figure as an element of a page; ``key`` begins what names its parts."""
    out = io.StringIO()
    with mpl.rc_context(_STYLE):
        figure.savefig(out, format="svg", metadata={"Date": None}, transparent=True)
    drawn = out.getvalue()
    drawn = drawn[drawn.index("<svg") :]
    head, body = drawn[: drawn.index(">")], drawn[drawn.index("</defs>") + len("</defs>") :]
    box = re.search(r'viewBox="[^"]*"', head)
    dots = {mark: 2.0 * float(radius) for mark, radius in _ROUND.findall(body)}
    body = _USES.sub(lambda found: _as_dots(found[0], dots), body)
    body = _PATH.sub(lambda found: f'{found[1]}{_thinned(found[2])}"', body)
    body = _TAG.sub(lambda tag: _NUMBER.sub(_shortened, tag[0]), body)  # not what texts say
    for light in COLOURS:
        body = body.replace(light, f"var(--{light[1:]})")
    body = _FONT.sub(lambda found: f"font-size: {found['size']}" if found["size"] else "", body)
    body = _named(body.replace("xlink:href", "href"), key)
    names = f'<title id="{key}-title">{escape(title)}</title><desc id="{key}-desc">{escape(text)}'
    label = f'role="img" aria-labelledby="{key}-title {key}-desc"'
    view = ""
    if box is not None:
        width = float(box[0].split()[2])
        sides = f"min-width: {_LEAST * width:.0f}px; max-width: {_SCALE * width:.0f}px"
        view = f'{box[0]} style="{sides}"'
    packed = re.sub(r">\s+<", "><", body).strip()
    return f"<svg {view} {label}>{names}</desc>{packed}"


def _shortened(number: re.Match[str]) -> str:
    return f"{float(number[0]):.2f}".rstrip("0").rstrip(".")


def _named(body: str, key: str) -> str:
    """Names are numbers of this figure, whatever they were made of; unused ones go."""
    for i, kept in enumerate(dict.fromkeys(_REFERRED.findall(body))):
        body = re.sub(rf'(id="|#){kept}\b', rf"\g<1>{key}-{i}", body)
    return re.sub(rf' id="(?!{key}-)[^"]*"', "", body)


def _as_dots(uses: str, dots: Mapping[str, float]) -> str:
    """Dots as one path of points with round ends, which takes a fifth of the room."""
    found = re.findall(_USE, uses)
    parts = []
    for (mark, style), group in groupby(found, key=lambda use: (use[0], use[3])):
        points = [(float(x), float(y)) for _, x, y, _ in group]
        colour = re.search(r"fill: ([^;]*)|stroke: ([^;]*)", style)
        if mark not in dots or colour is None:
            shared = (f'<use xlink:href="#{mark}" x="{x}" y="{y}"/>' for x, y in points)
            parts.append(f'<g style="{style}">{"".join(shared)}</g>')
            continue
        path = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in _fewer(points))
        line = f"fill: none; stroke: {colour[1] or colour[2]}; stroke-linecap: round"
        width = f"{dots[mark] + _EDGE:g}"
        parts.append(f'<path d="{path}" style="{line}; stroke-width: {width}"/>')
    return "".join(parts)


def _fewer(points: list[Point]) -> list[Point]:
    """One point for each square, of the smallest squares that leave few enough."""
    kept = points
    for side in _SIDES:
        if len(kept) <= _DOTS:
            break
        kept = list({(round(x / side), round(y / side)): (x, y) for x, y in kept}.values())
    return kept


def _thinned(path: str) -> str:
    """A long path of straight lines: in every column the first, lowest, highest and last point."""
    words = path.split()
    if len(words) < 3 * _LONG or set(words[0::3]) - {"M", "L", "z"}:
        return " ".join(words)
    ends = "z" if words[-1] == "z" else ""
    moves = list(zip(words[0::3], words[1::3], words[2::3], strict=False))
    points = [(letter, float(x), float(y)) for letter, x, y in moves]
    return " ".join(f"{a}{x:.1f} {y:.1f}" for a, x, y in _of_columns(points)) + ends


def _of_columns(
    points: list[tuple[str, float, float]],
) -> Iterator[tuple[str, float, float]]:
    for _, group in groupby(points, key=lambda each: round(each[1] / _COLUMN)):
        column = list(group)
        if any(letter == "M" for letter, _, _ in column[1:]):
            yield from column  # a gap
            continue
        heights = [y for _, _, y in column]
        kept = {0, heights.index(min(heights)), heights.index(max(heights)), len(column) - 1}
        yield from (column[i] for i in sorted(kept))
