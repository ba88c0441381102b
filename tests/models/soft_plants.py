"""Plants with soft faults, and the ports that a joint distribution gives for them."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
from plants import covariance, random_model, system_of, table

import fkgen
from fkgen.oracle.exact.compression import Policy, batch_compression

#: The simulation of Lee & Lee, (48): position every fifth sample, speed at every one.
DELTA = 0.2
PAPER = {
    "A": [[1.0, DELTA], [0.0, 1.0]],
    "C": [[0.0, 1.0], [1.0, 0.0]],
    "Q": [[25 * DELTA**4 / 4, 25 * DELTA**3 / 2], [25 * DELTA**3 / 2, 25 * DELTA**2]],
    "R": [[0.01, 0.0], [0.0, 100.0]],
    "x0": [0.0, 0.0],
    "P0": [[1.0, 0.0], [0.0, 0.01]],
}

#: Rounding of double precision on well-conditioned plants.
TIGHT = 1e-11

#: P and P* carry some roundings each, and zeta divides by the faintest direction of P - P*.
ROUNDED = 1e-14


def soft(model, *, family="dfcf", host=(0,), window=4, **sections):
    """A spec with soft faults; ``groups``, ``false_alarm`` and filter options by keyword."""
    faults = {k: sections.pop(k) for k in ("groups", "false_alarm") if k in sections}
    result = table(model, family=family, **sections)
    result["faults"] = {"soft": {"host": list(host), "window": window, **faults}}
    return fkgen.Spec.from_dict(result)


def random_shape(seed):
    """Sizes, hosts and a window: n 1-5, one or two rows on each side, inputs now and then."""
    rng = np.random.default_rng(seed)
    n, host, others = int(rng.integers(1, 6)), int(rng.integers(1, 3)), int(rng.integers(1, 3))
    rows = rng.permutation(host + others)
    return n, host + others, sorted(int(r) for r in rows[:host]), int(rng.integers(1, 9))


def varying(seed, n, p, host, T, *, singular=False):
    """A model whose A, C, Q and R are parameters, entry by entry, and their random records."""
    rng = np.random.default_rng(seed)
    groups = [host, [i for i in range(p) if i not in host]]
    A = rng.standard_normal((T, n, n))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max(axis=1)[:, None, None]
    if singular:
        A[rng.random(T) < 0.7] @= np.diag(np.arange(n) > 0).astype(float)
    C = rng.standard_normal((T, p, n))
    Q = np.array([covariance(rng, n) for _ in range(T)])
    R = np.zeros((T, p, p))
    for k in range(T):
        for rows in groups:
            R[k][np.ix_(rows, rows)] = covariance(rng, len(rows))
    model = random_model(seed, n, p, 1, direct=True)
    values = {}
    for letter, matrix in {"A": A, "C": C, "Q": Q, "R": R}.items():
        rows, columns = matrix.shape[1:]
        entries = [[0.0] * columns for _ in range(rows)]
        for i in range(rows):
            for j in range(columns):
                if matrix[:, i, j].any():
                    a, b = (i, j) if letter in "AC" or i >= j else (j, i)
                    entries[i][j] = f"{letter.lower()}{a}{b}"
                    values[f"{letter.lower()}{a}{b}"] = matrix[:, a, b]
        model[letter] = entries
    defaults = {name: float(value[0]) for name, value in values.items()}
    return model, defaults, values


def thinned(rng, T, p, host, *, missing=0.4):
    """A random record with rows missing, and now and then no compressed row for a while."""
    y = 2.0 * rng.standard_normal((T, p))
    y[rng.random((T, p)) < missing] = np.nan
    if rng.random() < 0.3:
        others = [i for i in range(p) if i not in host]
        y[: int(rng.integers(1, T)), others] = np.nan
    return y


def expected(spec, y, u=None, params=None, *, first=None):
    """Ports by name, from the joint distribution of every window."""
    law, options = spec.faults.soft, spec.filter.options
    policy = Policy(
        first=law.window if first is None else first,
        test=options.test,
        reacquire=options.reacquire,
    )
    result = batch_compression(system_of(spec, len(y), params), law, policy, y, u)
    return {field.name: getattr(result, field.name) for field in fields(result)}


def case(seed, *, singular=False, **options):
    """A random spec with a random record: (spec, y, u, params); every other one varies in time."""
    n, p, host, window = random_shape(seed)
    rng = np.random.default_rng(seed + 10_000)
    T = 3 * window + 2
    if seed % 2:
        model, defaults, params = varying(seed, n, p, host, T, singular=singular)
    else:
        model, defaults, params = random_model(seed, n, p, 1, direct=True), {}, {}
        if singular:
            model["A"] = (np.array(model["A"]) @ np.diag(np.arange(n) > 0)).tolist()
    spec = soft(model, host=host, window=window, parameters=defaults, **options)
    return spec, thinned(rng, T, p, host), rng.standard_normal((T, 1)), params


def assert_ports(found, ports, tolerance=TIGHT):
    """Every port of the joint distribution agrees; the statistic as far as it is determined."""
    for name, value in ports.items():
        if name == "faintest":
            continue
        actual = np.asarray(found[name], float).reshape(value.shape)
        if name == "test_statistic":
            np.testing.assert_array_equal(np.isnan(actual), np.isnan(value))
            tested = ~np.isnan(value)
            allowed = np.maximum(tolerance, ROUNDED / ports["faintest"][tested])
            error = np.abs(actual - value)[tested]
            assert np.all(error <= allowed * (1.0 + value[tested]))
        elif name in {"test_dof", "fault_declared"}:
            np.testing.assert_array_equal(actual, value, err_msg=name)
        else:
            scale = max(1.0, float(np.nanmax(np.abs(value))))
            np.testing.assert_allclose(actual, value, rtol=0, atol=tolerance * scale, err_msg=name)
