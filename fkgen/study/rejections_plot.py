"""Draw what compression filters were found to be: statistics over their thresholds, rejections."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from fkgen.runtime.results import Run
from fkgen.spec import SoftFaults, Spec

Array = NDArray[np.floating]

#: Ratios below this are drawn here.
_LOWEST = 1e-3


def draw_verdicts(axis: Axes, spec: Spec, time: Array, run: Run, colours: tuple[str, ...]) -> None:
    """Statistic over threshold of every group at every end of a window; crosses are rejections."""
    soft = spec.faults.soft
    if soft is None:
        return
    shape = (len(time), len(soft.groups))
    statistic, dof, declared = (
        np.asarray(run[name], float).reshape(shape)
        for name in ("test_statistic", "test_dof", "fault_declared")
    )
    for at, name in enumerate(_names(spec, soft)):
        tested, colour = dof[:, at] > 0, colours[at % len(colours)]
        ratio = statistic[tested, at] / _threshold(soft.false_alarm, dof[tested, at])
        values, rejected = np.maximum(ratio, _LOWEST), declared[tested, at] > 0
        axis.semilogy(time[tested], values, ".", ms=4, color=colour, label=name)
        axis.semilogy(time[tested][rejected], values[rejected], "x", ms=6, color=colour)
    axis.axhline(1.0, color="black", lw=0.8)
    low, high = axis.get_ylim()
    axis.set_ylim(min(low, 1e-2), max(high, 1e1))
    axis.set_ylabel("test / threshold", fontsize=9)


def _threshold(false_alarm: float, dof: Array) -> Array:
    from scipy.special import chdtri  # noqa: PLC0415 - scipy.stats would take a second

    return np.asarray(chdtri(dof, false_alarm), float)


def _names(spec: Spec, soft: SoftFaults) -> list[str]:
    """The rows of every group."""
    names = [signal.name.replace("_", " ") for signal in spec.model.outputs]
    return [", ".join(names[row] for row in group) for group in soft.groups]
