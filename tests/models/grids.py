"""Bayes' rule by sums over a grid: plants of one or two states, and of modes that jump."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import product

import numpy as np

#: Half of the width of a grid in deviations: beyond it is 1e-12 of the mass.
WIDTH = 7.0


@dataclass(frozen=True)
class Mode:
    """x[k+1] = f(x) + N(0, Q), y = h(x) + N(0, R); f and h take points (N, n)."""

    f: object
    h: object
    Q: np.ndarray
    R: np.ndarray


@dataclass(frozen=True)
class Plant:
    """Modes, and their chain: which one holds at k + 1 moves x[k] to x[k+1]."""

    modes: list
    x0: np.ndarray
    P0: np.ndarray
    transition: np.ndarray = field(default_factory=lambda: np.eye(1))
    initial: np.ndarray = field(default_factory=lambda: np.ones(1))


def density(apart, S):
    """Of a normal law: rows of differences (..., m)."""
    square = np.einsum("...i,ij,...j->...", apart, np.linalg.inv(S), apart)
    return np.exp(-0.5 * square) / np.sqrt(np.linalg.det(2.0 * np.pi * S))


def grid(mean, P, points):
    """Points (N, n), and the volume of each."""
    half = WIDTH * np.sqrt(np.diag(P))
    axes = [np.linspace(m - w, m + w, points) for m, w in zip(mean, half, strict=True)]
    return np.array(list(product(*axes))), float(np.prod(2.0 * half / (points - 1)))


def moments(weights, x):
    mean = weights @ x
    return mean, (weights[:, None] * (x - mean)).T @ (x - mean)


def bayes(plant, y, points):
    """Ports of a record, by grids that follow the plant."""
    x, volume = grid(plant.x0, plant.P0, points)
    held = np.outer(plant.initial, volume * density(x - plant.x0, plant.P0))
    rows = []
    for now in y:
        seen = np.isfinite(now)
        if seen.any():
            R = [mode.R[np.ix_(seen, seen)] for mode in plant.modes]
            apart = [(now - mode.h(x))[:, seen] for mode in plant.modes]
            held = held * np.array(list(map(density, apart, R)))
        evidence = held.sum()
        held /= evidence
        row = {"log_likelihood": np.log(evidence), "mode_probability": held.sum(axis=1)}
        row |= dict(zip(FILTERED, moments(held.sum(axis=0), x), strict=True))
        mixed = plant.transition.T @ held
        whole = np.concatenate([mode.f(x) for mode in plant.modes])
        mean, P = moments(mixed.ravel(), whole)
        there, volume = grid(mean, P + max(mode.Q.max() for mode in plant.modes), points)
        held = np.array([
            volume * density(there[:, None] - mode.f(x)[None], mode.Q) @ mass
            for mode, mass in zip(plant.modes, mixed, strict=True)
        ])  # fmt: skip
        x = there
        row |= dict(zip(PREDICTED, moments(held.sum(axis=0), x), strict=True))
        rows.append(row)
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


FILTERED = ("filtered_state", "filtered_covariance")
PREDICTED = ("predicted_state", "predicted_covariance")
