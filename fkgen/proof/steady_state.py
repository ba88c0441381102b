"""Does the covariance come to rest where python-control says that it should."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fkgen.oracle.claims.claim import Record
from fkgen.oracle.claims.gaussian import digits_at_stake
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.textbook.riccati import constant_input_noise, stationary_prediction_by_control
from fkgen.problem import Spec
from fkgen.proof.experiment import distance
from fkgen.symbolic.interpreter import Interpreter
from fkgen.symbolic.packing import triangle, unpacked
from fkgen.symbolic.recursion import Recursion
from fkgen.symbolic.validated import Claim

Array = NDArray[np.float64]

#: A covariance moves by the square of the closed-loop radius per sample; this is how near it is to
#: get, a hundredth of what a Riccati solver is trusted with.
_NEAR = 1e-9

#: Samples beyond which nobody waits: about ten seconds of interpretation.
_PATIENCE = 20_000

_SOURCE = "Anderson & Moore 1979, sec. 4.4; python-control dare"


def claims(recursion: Recursion) -> tuple[Claim, ...]:
    """One claim per filter in the recursion that has a stabilising solution."""
    spec = recursion.spec
    traits = spec.filter.traits
    if not (traits.linear or traits.models == "bank"):
        return ()
    hypotheses = _hypotheses(spec)
    found = [_stationary(spec, rates) for rates in hypotheses]
    known = [each for each in found if each is not None]
    if not known:
        return ()
    slowest = max(radius for _, radius in known)
    samples = 2 if slowest <= 0.0 else 2 + math.ceil(math.log(_NEAR) / (2.0 * math.log(slowest)))
    if samples > _PATIENCE:
        return ()
    start = max(float(np.max(np.diag(P))) for P, _ in known)
    reached = _reached(recursion, samples, start)
    tolerance = _tolerance(spec)
    return tuple(
        Claim(
            claim=f"the covariance{_of(rates)} comes to rest at the stabilising solution",
            source=_SOURCE,
            error=distance(covariance[np.newaxis], each[0][np.newaxis], symmetric=True),
            tolerance=tolerance,
        )
        for rates, each, covariance in zip(hypotheses, found, reached, strict=True)
        if each is not None
    )


def _hypotheses(spec: Spec) -> tuple[tuple[float, ...] | None, ...]:
    """What is tried for the success rates, or the one that the spec states."""
    tried: tuple[tuple[float, ...], ...] = spec.filter.option("hypotheses", ())
    return tried or (None,)


def _of(rates: tuple[float, ...] | None) -> str:
    return "" if rates is None else f" of hypothesis {', '.join(f'{rate:g}' for rate in rates)}"


def _stationary(spec: Spec, rates: tuple[float, ...] | None) -> tuple[Array, float] | None:
    system = LinearSystem.from_spec(spec, 1, None, rates)
    noise = constant_input_noise(system, np.ones(spec.model.nu))
    return stationary_prediction_by_control(system.A[0], system.C[0], *noise)


def _tolerance(spec: Spec) -> float:
    """A Riccati solver keeps about half of the digits of an ill-conditioned equation."""
    none = np.zeros((0, 0))
    record = Record(y=none, u=none, parameters={}, P0=spec.model.P0.values())
    return min(max(1e-7, digits_at_stake(spec, record)), 1e-3)


def _reached(recursion: Recursion, samples: int, size: float) -> list[Array]:
    """Covariances after many samples of a record that does not matter: they do not depend on y."""
    spec, n = recursion.spec, recursion.spec.model.nx
    hypotheses = _hypotheses(spec)
    stacked = hypotheses[0] is not None
    name = "mode_covariance" if stacked else "predicted_covariance"
    instance = Interpreter(recursion)
    prior = spec.model.P0.values() + size * np.eye(n)
    packed = np.array([prior[i, j] for i, j in triangle(n)])
    instance.values[name] = np.tile(packed, len(hypotheses))
    y, u = np.zeros(spec.model.ny), np.ones(spec.model.nu)
    for _ in range(samples):
        if not instance.step(y, u, spec.defaults):
            break
    value = unpacked(recursion.port(name), instance.values[name])
    found: Array = np.asarray(value, dtype=float)
    return list(found) if stacked else [found]
