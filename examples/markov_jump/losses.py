"""The plants of this example, their losses, many records of them, and the filters."""

from __future__ import annotations

import copy
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import fkgen

HERE = Path(__file__).resolve().parent
SAMPLES = 500
OUTAGE = slice(200, 230)
Floats = NDArray[np.floating[Any]]
Table = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Study:
    """A plant and the way in which its samples are lost.

    Attributes
    ----------
    title : str
    plant : dict
        The sections model and faults.jump of a spec.
    rate : float
        Pr(a sample arrives), as the filters are told it.
    outage : bool
        Samples 200 to 229 are lost and no others; else each is lost by itself.
    """

    title: str
    plant: Table
    rate: float
    outage: bool = False


@dataclass(frozen=True)
class Records:
    """M runs of T samples.

    Attributes
    ----------
    state : (M, T) ndarray
        The first component of x.
    whole, measured : (M, T, 1) ndarray
        Measurements without losses, and with: noise alone where the sample is lost.
    lost : (M, T) ndarray of bool
    """

    state: Floats
    whole: Floats
    measured: Floats
    lost: NDArray[np.bool_]


def target() -> Table:
    """Read model and modes of the target from spec.toml."""
    content = tomllib.loads((HERE / "spec.toml").read_text(encoding="utf-8"))
    jump = content["faults"]["jump"]
    for key in ("arrival", "arrival_rate"):
        del jump[key]
    return {"model": content["model"], "jump": jump}


def scalar() -> Table:
    """Make a plant with one state and offsets that keep it near 10: far from zero, losses show."""
    modes: list[Table] = [{"c": [1.0]}, {"A": [[0.7]], "Q": [[0.36]], "R": [[0.49]], "c": [3.6]}]
    model = {"A": [[0.9]], "C": [[1.0]], "Q": [[0.09]], "R": [[0.25]], "x0": [10.0], "P0": [[1.0]]}
    law = {"transition": [[0.95, 0.05], [0.10, 0.90]], "initial": [0.5, 0.5]}
    return {"model": model, "jump": {**law, "modes": modes}}


STUDIES = (
    Study("target, 15 % lost", target(), 0.85),
    Study("target, one outage", target(), 0.95, outage=True),
    Study("scalar, 15 % lost", scalar(), 0.85),
)


def simulate(study: Study, runs: int, seed: int) -> Records:
    """Draw records: mode k drives y[k] and the step from x[k] to x[k+1]."""
    rng = np.random.default_rng(seed)
    spec = _spec(study, {"family": "mjls_lmmse"}, {})
    faults, model = spec.faults.jump, spec.model
    if faults is None:
        raise SystemExit("no modes")
    transition = np.array(faults.transition)
    A, C, Q, R, c = (
        np.array([getattr(mode, letter).values() for mode in faults.modes]) for letter in "ACQRc"
    )
    root = np.array([_root(each) for each in Q])
    n = model.nx
    x = model.x0.values()[:, 0] + rng.standard_normal((runs, n)) @ _root(model.P0.values()).T
    mode = _draw(np.tile(faults.initial, (runs, 1)), rng)
    state, noise = np.empty((2, runs, SAMPLES))
    signal = np.empty((runs, SAMPLES))
    for k in range(SAMPLES):
        state[:, k] = x[:, 0]
        signal[:, k] = np.einsum("mi,mi->m", C[mode, 0], x)
        noise[:, k] = np.sqrt(R[mode, 0, 0]) * rng.standard_normal(runs)
        w = np.einsum("mij,mj->mi", root[mode], rng.standard_normal((runs, n)))
        x = np.einsum("mij,mj->mi", A[mode], x) + c[mode, :, 0] + w
        mode = _draw(transition[mode], rng)
    lost = rng.random((runs, SAMPLES)) >= study.rate
    if study.outage:
        lost[:] = False
        lost[:, OUTAGE] = True
    measured = np.where(lost, noise, signal + noise)
    return Records(state, (signal + noise)[..., None], measured[..., None], lost)


def _root(covariance: Floats) -> Floats:
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.maximum(values, 0.0))


def _draw(law: Floats, rng: np.random.Generator) -> NDArray[np.intp]:
    """One mode per run from the rows of ``law``."""
    bounds = np.cumsum(law, axis=1)[:, :-1]
    return (rng.random((len(law), 1)) > bounds).sum(axis=1)


#: What a filter is: options of [filter], keys about arrivals, and what it sees of a record.
TRUTH, KNOWN, BLIND, NAHI = (
    "no losses at all",
    "told the losses",
    "no detection",
    "linear, rate only",
)
LLR, IMM_TRUTH, IMM = "llr", "imm, no losses at all", "imm, loss as a mode"
IMM_PAIRS = "imm over pairs, no losses at all"
DETECTORS: Mapping[str, Table] = {
    LLR: {"detector": "llr"},
    "nis, alpha .01": {"detector": "nis", "alpha": 0.01},
    "nis, alpha .001": {"detector": "nis", "alpha": 0.001},
    "energy (the paper's rule)": {"detector": "energy"},
    "energy, constant gain": {"detector": "energy", "gain": "stationary"},
    "energy, kappa 9": {"detector": "energy", "kappa": 9.0},
    "energy, mean of 5": {"detector": "energy", "window": 5},
}
ENERGY, CONSTANT = "energy (the paper's rule)", "energy, constant gain"


def filters(study: Study) -> dict[str, fkgen.Spec]:
    """Make every filter of the table."""
    lmmse = {"family": "mjls_lmmse"}
    channel = {"arrival": "unknown", "arrival_rate": study.rate}
    return {
        TRUTH: _spec(study, lmmse, {}),
        KNOWN: _spec(study, lmmse, {"arrival": "known", "arrival_rate": study.rate}),
        **{name: _spec(study, lmmse | own, channel) for name, own in DETECTORS.items()},
        NAHI: _spec(study, lmmse, channel),
        BLIND: _spec(study, lmmse, {}),
        IMM_TRUTH: _spec(study, {"family": "imm"}, {}),
        IMM_PAIRS: _of_pairs(study),
        IMM: _with_loss_as_mode(study),
    }


def seen(name: str, records: Records) -> Floats:
    """What a filter gets of the records."""
    if name in {TRUTH, IMM_TRUTH, IMM_PAIRS}:
        return records.whole
    if name == KNOWN:
        return np.where(records.lost[..., None], np.nan, records.measured)
    return records.measured


def _spec(study: Study, options: Table, channel: Table) -> fkgen.Spec:
    jump = {**copy.deepcopy(study.plant["jump"]), **channel}
    return _over(study, jump, options)


def _over(study: Study, jump: Table, options: Table) -> fkgen.Spec:
    table = {"name": "filter", "model": study.plant["model"], "filter": options}
    return fkgen.Spec.from_dict({**table, "faults": {"jump": jump}})


def _with_loss_as_mode(study: Study) -> fkgen.Spec:
    """Twice as many modes: every one with a signal, and without (C = 0)."""
    jump, p = copy.deepcopy(study.plant["jump"]), study.rate
    nothing = [[0.0] * len(study.plant["model"]["A"])]
    jump["modes"] += [{**mode, "C": nothing} for mode in jump["modes"]]
    chance = np.array([p, 1.0 - p])
    jump["transition"] = np.kron(np.outer([1.0, 1.0], chance), jump["transition"]).tolist()
    jump["initial"] = np.kron(chance, jump["initial"]).tolist()
    return _over(study, jump, {"family": "imm"})


def _of_pairs(study: Study) -> fkgen.Spec:
    """A mode per pair (mode before, mode), because imm takes the step into a sample for its mode's.

    The step is that of the first, the measurement that of the second.
    """
    jump = study.plant["jump"]
    modes, law, N = jump["modes"], np.array(jump["transition"]), len(jump["modes"])
    pairs = [
        {key: value for key, value in before.items() if key in {"A", "Q", "c"}}
        | {key: value for key, value in now.items() if key in {"C", "R"}}
        for before in modes
        for now in modes
    ]
    transition = np.einsum("jk,jl->jkl", np.eye(N), law).reshape(N, N * N)
    initial = np.kron(np.eye(N)[0], jump["initial"])
    own = {"modes": pairs, "transition": np.tile(transition, (N, 1)), "initial": initial}
    return _over(study, {**own, "transition": own["transition"].tolist()}, {"family": "imm"})
