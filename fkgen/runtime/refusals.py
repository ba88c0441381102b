"""Which equation is why a sample was refused: that part of f, h or their derivatives has no value.

The equations are evaluated again, in Python, where the instance was, which a refusal leaves as it
was. No time is spent on samples that are taken.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import FkgenError
from fkgen.problem.equations import ARRAYS, Equations, turned
from fkgen.problem.functions.finite import Fault, Look, Point
from fkgen.problem.spec import Spec
from fkgen.problem.text.expression import evaluate
from fkgen.runtime.results import Snapshot
from fkgen.symbolic.interface import UPDATED

Array = NDArray[np.float64]

#: The number of a plant, its equations, and where they are looked at: a state and its covariance.
Estimate: TypeAlias = tuple[int, Equations, Array, Array]


def reason(
    path: Path, at: Snapshot, part: str, u: Sequence[float], parameters: Sequence[float]
) -> str:
    """What of "f" or of "h" is not finite at an instance, in one line; empty if nothing is."""
    layout = at.layout
    facts: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    if not facts["written"]:  # it has matrices
        return ""
    try:
        spec = Spec.from_dict(facts["spec"])
    except FkgenError:  # its family is in a package that is not here
        return ""
    plants = [
        replace(own, written=tuple(map(tuple, written)))
        for own, written in zip(spec.equations, facts["written"], strict=True)
    ]
    known = {name: value for (name, _), value in zip(layout.parameters, parameters, strict=True)}
    instance = layout.structure().from_buffer_copy(at.data)
    updated, ports = bool(getattr(instance, UPDATED)), {name: at[name] for name in at.ports}
    where = estimates_of(ports, plants, updated=updated)
    largest = float(np.finfo(layout.dtype).max)
    found = fault_at(spec, where, part, (u, known), largest=largest)
    if found is None:
        return ""
    mode = f"mode {found[0]}: " if len(plants) > 1 else ""
    return f"{mode}{found[1].key} = {found[1].text} has {found[1].what} at {found[1].at}"


def fault_at(
    spec: Spec,
    estimates: Iterable[Estimate],
    part: str,
    given: tuple[Sequence[float], Mapping[str, float]],
    *,
    largest: float = math.inf,
) -> tuple[int, Fault] | None:
    """The first fault of "f" or of "h" where the filter looks at them, and of which plant.

    ``given``: inputs and parameters.
    """
    u, known = given
    spread = spec.filter.traits.looks == "spread"
    for number, equations, x, P in estimates:
        look = Look(
            equations=equations,
            states=spec.model.states,
            outputs=spec.model.outputs,
            slopes=not spread,
            running=True,
            largest=largest,
        )
        noises = [0.0] * len(equations.noises)
        points = [Point(x.tolist(), u, noises, known)]
        if spread:
            points = _points(points[0], P, equations, spec, part)
        for point in points:
            if found := look.fault(part, point):
                return number, found
    return None


def estimates_of(
    ports: Mapping[str, Array], plants: Sequence[Equations], *, updated: bool
) -> Iterator[Estimate]:
    """Every plant at the latest estimate, or at that of its mode where modes have their own."""
    own = "mode_filtered_" if updated else "mode_"
    whole = "filtered_" if updated else "predicted_"
    if f"{own}state" in ports:
        states, covariances = (ports[f"{own}{of}"].astype(float) for of in ("state", "covariance"))
        several = len(states) == len(plants)
        for m, (x, P) in enumerate(zip(states, covariances, strict=True)):
            for i in [m] if several else range(len(plants)):
                yield i, plants[i], x, P
    x, P = (ports[f"{whole}{of}"].astype(float) for of in ("state", "covariance"))
    yield from ((i, each, x, P) for i, each in enumerate(plants))


def _points(centre: Point, P: Array, equations: Equations, spec: Spec, part: str) -> list[Point]:
    """The points of ukf about an estimate: of the state for h, of state and noises for f."""
    root = _lower_root(P)
    if part == "f":
        variances = [evaluate(each.variance, centre.parameters) for each in equations.noises]
        if equations.period is not None:
            period = evaluate(equations.period, centre.parameters)
            variances = [each / period for each in variances]
        size = len(root) + len(variances)
        whole = np.zeros((size, size))
        whole[: len(root), : len(root)] = root
        whole[len(root) :, len(root) :] = np.diag(np.sqrt(variances))
        root = whole
    kappa = float(spec.filter.option("kappa", 0.0))
    scaled = np.sqrt(len(root) + kappa) * root.T
    return [
        replace(centre, x=_moved(centre.x, d[: len(P)], equations), w=d[len(P) :].tolist())
        if part == "f"
        else replace(centre, x=_moved(centre.x, d, equations))
        for d in (*([np.zeros(len(root))] if kappa else []), *scaled, *-scaled)
    ]


def _moved(x: Sequence[float], errors: Array, equations: Equations) -> list[float]:
    """The state that lies off by errors."""
    found: list[float] = []
    left = iter(errors.tolist())
    while len(found) < len(x):
        at = len(found)
        if at in equations.attitudes:
            by = [next(left) for _ in range(3)]
            found += map(float, turned(x[at : at + 4], by, ARRAYS))
        else:
            found.append(x[at] + next(left))
    return found


def _lower_root(P: Array) -> Array:
    """L of P = L L', with a zero column where a semidefinite P has no pivot."""
    root = np.zeros_like(P)
    for j in range(len(P)):
        column = P[j:, j] - root[j:, :j] @ root[j, :j]
        if column[0] > 0.0:
            root[j:, j] = column / np.sqrt(column[0])
    return root
