"""Plants with sensor faults for the tests of the reference mathematics, and laws of the modes."""

from __future__ import annotations

import numpy as np

from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.plants.sensor import SensorLaw, mode_plant

ALTERNATING = np.array([[0.1, 0.9], [0.9, 0.1]])
STICKY = np.array([[0.9, 0.1], [0.2, 0.8]])


def plant(rng, *, T, n=2, p=2, q=1):
    """A time-varying plant with correlated noise in all rows."""
    root = rng.standard_normal((T, p, p))
    return LinearSystem(
        A=rng.standard_normal((T, n, n)) / np.sqrt(n),
        B=rng.standard_normal((T, n, q)),
        C=rng.standard_normal((T, p, n)),
        D=rng.standard_normal((T, p, q)),
        Q=np.broadcast_to(np.diag([1.0] * (n - 1) + [0.3]), (T, n, n)),
        R=root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(p),
        x0=rng.standard_normal(n),
        P0=np.eye(n) + 0.4,
        rate=np.ones((T, q)),
        fault_covariance=np.zeros((T, q, q)),
    )


def example(T):
    """The scalar plant of eq. (25), without an input."""
    one = np.ones((T, 1, 1))
    return LinearSystem(
        A=-0.8 * one,
        B=np.ones((T, 1, 0)),
        C=one,
        D=np.ones((T, 1, 0)),
        Q=one,
        R=one,
        x0=np.zeros(1),
        P0=np.zeros((1, 1)),
        rate=np.ones((T, 0)),
        fault_covariance=np.zeros((T, 0, 0)),
    )


def law(kernel, initial, *, factor=10.0, rows=(0,)):
    return SensorLaw(
        kernel=np.asarray(kernel, dtype=float),
        initial=np.asarray(initial, dtype=float),
        noise_factor=factor,
        rows=rows,
    )


def any_law(rng, **options):
    """Problem 4 with a kernel that has no structure."""
    return law(rng.dirichlet(np.ones(4), size=4), rng.dirichlet(np.ones(4)), **options)


def product_law(signal, noise, *, initial=((0.5, 0.5), (0.8, 0.2)), **options):
    """Problem 3; states of the chain of gamma ordered (1, 0), of delta (1, C)."""
    return law(np.kron(signal, noise), np.kron(*initial), **options)


def inputs(rng, system):
    return rng.standard_normal((system.length, system.nu))


def with_modes(system, a_law, modes):
    """The plant as one sees it who is told the modes."""
    parts = [mode_plant(system, a_law, k, int(mode)) for k, mode in enumerate(modes)]
    C, D, R, d = (np.array(matrices) for matrices in zip(*parts, strict=True))
    return LinearSystem(
        A=system.A, B=system.B, C=C, D=D, Q=system.Q, R=R, x0=system.x0, P0=system.P0,
        rate=system.rate, fault_covariance=system.fault_covariance, c=system.c, d=d,
    )  # fmt: skip


def close(actual, expected, ports, *, rtol=1e-10, rows=slice(None)):
    """Compare ports of two results; absolute tolerance relative to the largest entry."""
    for port in ports:
        a, b = getattr(actual, port)[rows], getattr(expected, port)[rows]
        atol = rtol * np.nanmax(np.abs(b), initial=1.0)
        np.testing.assert_allclose(a, b, rtol=rtol, atol=atol, err_msg=port)
