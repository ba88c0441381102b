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

_PERIOD = 0.1
_SIGNAL = [[0.7, 0.3], [0.05, 0.95]]  # states ordered (0, 1)
_NOISE = [
    [0.8, 0.2],
    [0.8, 0.2],
]  # ordered (1, C): independent samples, so that modes can be lumped
_LUMPABLE: Spec = {
    "problem": 3,
    "gamma_chain": _SIGNAL,
    "delta_chain": _NOISE,
    "initial": [0.72, 0.18, 0.08, 0.02],
}
_GENERAL: Spec = {
    "problem": 4,
    "kernel": [
        [0.85, 0.09, 0.05, 0.01],
        [0.40, 0.50, 0.04, 0.06],
        [0.25, 0.05, 0.60, 0.10],
        [0.08, 0.22, 0.30, 0.40],
    ],
    "initial": [0.7, 0.1, 0.1, 0.1],
}


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


def chains(n: int, p: int) -> Spec:
    """Positions and velocities pulled back by springs between neighbours; p positions measured."""
    half, step = n // 2, 0.1
    stiff = 0.5 * np.eye(half)
    A = np.block([[np.eye(half), step * np.eye(half)], [-stiff * step, 0.95 * np.eye(half)]])
    order = np.arange(n).reshape(2, half).T.ravel()
    A = A[np.ix_(order, order)]
    A[2:, :-2] += 0.02 * np.diag(np.arange(n - 2) % 2)
    C = np.zeros((p, n))
    C[np.arange(p), 2 * (np.arange(p) * half // p)] = 1.0
    model = {
        "A": A.tolist(),
        "C": C.tolist(),
        "Q": np.diag(np.tile([1e-4, 1e-3], half)).tolist(),
        "R": np.diag(0.1 + 0.1 * np.arange(p)).round(3).tolist(),
        "x0": [0.0] * n,
        "P0": np.eye(n).tolist(),
    }
    return {"name": f"chains{n}", "model": model, "filter": {"family": "kf"}}


def square(n: int) -> Spec:
    """As many measurements as states; A, C, Q and R without a zero."""
    spec = dense(n, n)
    rng = np.random.default_rng(n + 1)
    F = rng.normal(size=(n, n))
    R = (0.1 * np.eye(n) + 0.01 * F @ F.T / n).round(6)
    return {**spec, "name": f"square{n}", "model": {**spec["model"], "R": R.tolist()}}


def navigation() -> Spec:
    """Errors of inertial navigation: position, velocity, attitude, biases; the first two fixed."""
    step, turn = 0.01, np.array([[0.0, -9.81, 0.3], [9.81, 0.0, -0.2], [-0.3, 0.2, 0.0]])
    one, none = np.eye(3), np.zeros((3, 3))
    A = np.block(
        [
            [one, step * one, none, none, none],
            [none, one, step * turn, none, step * one],
            [none, none, one, -step * one, none],
            [none, none, none, 0.999 * one, none],
            [none, none, none, none, 0.999 * one],
        ]
    )
    model = {
        "A": A.tolist(),
        "C": np.eye(6, 15).tolist(),
        "Q": np.diag(np.repeat([1e-6, 1e-4, 1e-6, 1e-8, 1e-6], 3)).tolist(),
        "R": np.diag(np.repeat([1.0, 0.01], 3)).tolist(),
        "x0": [0.0] * 15,
        "P0": np.diag(np.repeat([10.0, 1.0, 0.01, 1e-4, 1e-2], 3)).tolist(),
    }
    return {"name": "navigation15", "model": model, "filter": {"family": "kf"}}


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


def target(family: str, law: Spec, *, name: str, **options: Any) -> Spec:
    """A target of constant velocity in the plane whose measured position may be lost or noisy."""
    axis = np.array([[1.0, _PERIOD], [0.0, 1.0]])
    drift = np.array([[_PERIOD**3 / 3, _PERIOD**2 / 2], [_PERIOD**2 / 2, _PERIOD]])
    model = {
        "A": np.kron(np.eye(2), axis).tolist(),
        "C": np.kron(np.eye(2), [[1.0, 0.0]]).tolist(),
        "Q": np.kron(np.eye(2), 2.0 * drift).tolist(),
        "R": [[0.25, 0.0], [0.0, 0.25]],
        "x0": [0.0] * 4,
        "P0": np.diag([4.0, 9.0, 4.0, 9.0]).tolist(),
    }
    faults = {"sensor": {"noise_factor": 10.0, **law}}
    return {"name": name, "model": model, "faults": faults, "filter": {"family": family, **options}}


def imm_models() -> dict[str, Spec]:
    """Interacting multiple models with 3 and with 4 modes."""
    return {
        "imm, 3 modes": target("imm", _LUMPABLE, name="target_imm3", modes=3),
        "imm, 4 modes": target("imm", _GENERAL, name="target_imm4", modes=4),
    }


def sensor_models() -> dict[str, Spec]:
    """Every family for sensor faults."""
    independent = {"problem": 1, "gamma_rate": 0.9, "delta_nominal_rate": 0.8}
    lumpable = target("imm", _LUMPABLE, name="target_imm", modes=4)
    return {
        **imm_models(),
        "imm, 4 modes, lumpable": lumpable,
        "one_step": target("one_step", _GENERAL, name="target_one_step"),
        "linear_optimal": target("linear_optimal", independent, name="target_linear"),
        "genie": target("genie", {}, name="target_genie"),
    }


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
    actuators = {"mkf motor": mkf(), "mme motor, 5 hypotheses": mme()}
    return {**kf_models(), **actuators, **sensor_models()}


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
    if "sensor" in spec.get("faults", {}):
        return _circle(rng, samples), np.zeros((samples, 0))
    return 0.1 * rng.normal(size=(samples, p)), rng.uniform(-1.0, 1.0, (samples, q))


def _circle(rng: np.random.Generator, samples: int) -> Array:
    """What the sensor shows of a target on a circle, now and then nothing but noise."""
    kernel = np.cumsum(_GENERAL["kernel"], axis=1)
    draws, modes = rng.uniform(size=samples), np.zeros(samples, int)
    for k in range(1, samples):
        modes[k] = np.sum(kernel[modes[k - 1], :3] < draws[k])
    angle = 0.6 * _PERIOD * np.arange(samples)
    position = 5.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    noise = np.sqrt(np.where(modes % 2, 2.5, 0.25))[:, None] * rng.normal(size=(samples, 2))
    return np.where(modes < 2, 1.0, 0.0)[:, None] * position + noise
