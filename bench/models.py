"""The filters that are measured, as spec dictionaries, and records for them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Spec = dict[str, Any]

_MOTOR: Spec = {
    "A": [[0.9802, -0.0002], [0.0094, 0.9048]],
    "Q": [[1e-4, 0.0], [0.0, 1e-4]],
    "x0": [0.0, 0.0],
    "P0": [[1.0, 0.0], [0.0, 1.0]],
}
_INPUT: Spec = {"B": [[0.0198], [0.0001]], "D": [[0.0]]}


def motor() -> Spec:
    """Two states, one measurement: A dense, C = [0 1]; no input."""
    model = {**_MOTOR, "C": [[0.0, 1.0]], "R": [[0.01]]}
    return {"name": "motor", "model": model, "filter": {"family": "kf"}}


def full2() -> Spec:
    """Two states, one measurement, and not one zero."""
    model = {
        **_MOTOR,
        "C": [[0.3, 1.1]],
        "Q": [[2e-4, 1e-5], [1e-5, 3e-4]],
        "R": [[0.01]],
    }
    return {"name": "full2", "model": model, "filter": {"family": "kf"}}


def dense(n: int, p: int) -> Spec:
    """A, C and Q without a zero, R diagonal, A stable."""
    rng = np.random.default_rng(n)
    A = rng.normal(size=(n, n))
    A *= 0.95 / np.max(np.abs(np.linalg.eigvals(A)))
    F = rng.normal(size=(n, n))
    model = {
        "A": A.round(4).tolist(),
        "C": rng.normal(size=(p, n)).round(4).tolist(),
        "Q": (0.01 * np.eye(n) + 0.001 * F @ F.T).round(6).tolist(),
        "R": np.diag(0.1 + 0.1 * np.arange(p)).round(3).tolist(),
        "x0": [0.0] * n,
        "P0": np.eye(n).tolist(),
    }
    return {"name": f"dense{n}", "model": model, "filter": {"family": "kf"}}


def mkf() -> Spec:
    """The motor whose input acts with probability 0.7."""
    model = {**_MOTOR, **_INPUT, "C": [[0.0, 1.0]], "R": [[0.01]]}
    faults = {"actuator": {"success_rate": 0.7, "dependence": "common"}}
    return {"name": "motor_mkf", "model": model, "faults": faults, "filter": {"family": "mkf"}}


def mme() -> Spec:
    """The same, with an unknown success rate: five hypotheses."""
    model = {**_MOTOR, **_INPUT, "C": [[0.0, 1.0]], "R": [[0.01]]}
    bank = {"family": "mme", "hypotheses": [0.1, 0.3, 0.5, 0.7, 0.9]}
    faults = {"actuator": {"dependence": "common"}}
    return {"name": "motor_mme", "model": model, "faults": faults, "filter": bank}


def kf_models() -> dict[str, Spec]:
    """Plain Kalman filters, by the title of their row."""
    return {
        "kf n2 p1, C = [0 1]": motor(),
        "kf n2 p1, full": full2(),
        "kf n6 p3, full": dense(6, 3),
        "kf n15 p6, full": dense(15, 6),
    }


def all_models() -> dict[str, Spec]:
    """Everything that is measured."""
    return {**kf_models(), "mkf motor": mkf(), "mme motor, 5 hypotheses": mme()}


def with_code(spec: Spec, **code: str) -> Spec:
    """The same filter with other code options."""
    return {**spec, "code": {**spec.get("code", {}), **code}}


def width(spec: Spec) -> tuple[int, int, int]:
    """States, measurements, inputs."""
    model = spec["model"]
    return len(model["A"]), len(model["C"]), len(model["B"][0]) if "B" in model else 0


def record(spec: Spec, samples: int) -> tuple[Array, Array]:
    """Measurements (T, p) and inputs (T, q): noise of about the size the filter expects."""
    _, p, q = width(spec)
    rng = np.random.default_rng(0)
    return 0.1 * rng.normal(size=(samples, p)), rng.uniform(-1.0, 1.0, (samples, q))
