"""A figure of times over sizes as SVG: the same bytes for the same numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

_MARKS = "osD^vP*X"


def growth(
    target: Path, curves: Mapping[str, Sequence[tuple[int, float]]], title: str, unit: str
) -> None:
    """Curves of (n, value) on logarithmic axes."""
    import matplotlib as mpl  # noqa: PLC0415 - only for this

    mpl.use("Agg")
    mpl.rcParams["svg.hashsalt"] = "bench"
    from matplotlib import pyplot as plt  # noqa: PLC0415 - after the backend

    figure, axes = plt.subplots(figsize=(7.0, 4.6), layout="constrained")
    for mark, (name, points) in zip(_MARKS, curves.items(), strict=False):
        if points:
            n, value = zip(*points, strict=True)
            axes.loglog(n, value, marker=mark, markersize=4, linewidth=1.2, label=name)
    sizes = sorted({n for points in curves.values() for n, _ in points})
    axes.set_xticks(sizes, [str(n) for n in sizes], minor=False)
    axes.minorticks_off()
    axes.set(xlabel="states n, measurements n / 4", ylabel=unit, title=title)
    axes.grid(visible=True, linewidth=0.3)
    axes.legend(fontsize=8)
    figure.savefig(target, metadata={"Date": None})
    plt.close(figure)
