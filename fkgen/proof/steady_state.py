"""Does the covariance come to rest where python-control says that it should."""

from __future__ import annotations

import math

import numpy as np

from fkgen.oracle.claims.claim import Array
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.textbook.riccati import constant_input_noise, stationary_prediction_by_control
from fkgen.problem import Spec
from fkgen.proof.validate import digits, distance, put
from fkgen.symbolic.interpreter import Interpreter
from fkgen.symbolic.recursion import Recursion
from fkgen.symbolic.validated import Claim

#: A covariance moves by the square of the closed-loop radius per sample; this is how near it is to
#: get, a hundredth of what a Riccati solver is trusted with.
_NEAR = 1e-9

#: Samples beyond which nobody waits: about ten seconds of interpretation.
_PATIENCE = 20_000


def claims(recursion: Recursion) -> tuple[Claim, ...]:
    """One claim per filter in the recursion that has a stabilising solution."""
    spec, traits = recursion.spec, recursion.spec.filter.traits
    if not (traits.linear or traits.models == "bank"):
        return ()
    tried: tuple[tuple[float, ...], ...] = spec.filter.option("hypotheses", ())
    found = [_stationary(spec, rates) for rates in tried or (None,)]
    known = [each for each in found if each is not None]
    if not known:
        return ()
    slowest = max(radius for _, radius in known)
    samples = 2 if slowest <= 0.0 else 2 + math.ceil(math.log(_NEAR) / (2.0 * math.log(slowest)))
    if samples > _PATIENCE:
        return ()
    start = max(float(np.max(np.diag(P))) for P, _ in known)
    name = "mode_covariance" if tried else "predicted_covariance"
    reached = _reached(recursion, name, samples, start).reshape(len(found), *known[0][0].shape)
    rates = [f" of hypothesis {', '.join(f'{rate:g}' for rate in each)}" for each in tried] or [""]
    # A Riccati solver keeps about half of the digits of an ill-conditioned equation.
    tolerance = min(max(1e-7, digits(spec)), 1e-3)
    return tuple(
        Claim(
            claim=f"the covariance{of} comes to rest at the stabilising solution",
            source="Anderson & Moore 1979, sec. 4.4; python-control dare",
            error=distance(covariance[np.newaxis], each[0][np.newaxis], symmetric=True),
            tolerance=tolerance,
        )
        for of, each, covariance in zip(rates, found, reached, strict=True)
        if each is not None
    )


def _stationary(spec: Spec, rates: tuple[float, ...] | None) -> tuple[Array, float] | None:
    system = LinearSystem.from_spec(spec, 1, None, rates)
    noise = constant_input_noise(system, np.ones(spec.model.nu))
    return stationary_prediction_by_control(system.A[0], system.C[0], *noise)


def _reached(recursion: Recursion, name: str, samples: int, size: float) -> Array:
    """Covariances after many samples of a record that does not matter: they do not depend on y."""
    spec, instance = recursion.spec, Interpreter(recursion)
    put(instance, name, spec.model.P0.values(spec.defaults) + size * np.eye(spec.model.nx))
    y, u = np.zeros(spec.model.ny), np.ones(spec.model.nu)
    for _ in range(samples):
        if not instance.step(y, u, spec.defaults):
            break
    return np.asarray(recursion.port(name).unpacked(instance.values[name]), dtype=float)
