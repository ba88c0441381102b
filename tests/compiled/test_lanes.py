"""Records side by side in the lanes of vectors: the bits of one record after the other."""

from __future__ import annotations

import dataclasses

import jump_plants
import nonlinear_specs
import numpy as np
import pytest
import sensor_specs
import spread
from plants import generated, random_model, spec
from toolchain import C_COMPILERS, needs_compiler, thorough

import fkgen
from fkgen.backend.lanes.text import LARGEST
from fkgen.runtime import batch as batches

pytestmark = needs_compiler()

M, T = 11, 24

DENSE = random_model(75, 9, 5, correlated=True)

JUMPING = {
    "jump_plain": {},
    "jump_chain": {"arrival_chain": jump_plants.GILBERT},
    "jump_nis": {"arrival_rate": 0.6, "detector": "nis", "alpha": 0.4, "lock_out": 2},
    "jump_energy": {"arrival_rate": 0.6, "detector": "energy", "window": 3},
}


def specs(scalar):
    """One spec for each way of each family."""
    code = {"scalar": scalar}
    table = jump_plants.random_table(71, 2, 2, 2, q=1, offsets=True, correlated=True)
    found = dict(spread.specs(scalar)) | dict(sensor_specs.every(scalar))
    for name, model in (("kf_fused", random_model(73, 4, 3)), ("kf_fused_dense", DENSE)):
        found[name] = spec(model, family="kf", code=code | {"fma": True})
    for case in nonlinear_specs.CASES:
        for family in ("ekf", "ukf", "iekf"):
            found[f"{case}_{family}"] = nonlinear_specs.spec_of(case, family, code=code)
    for name, options in JUMPING.items():
        changed = jump_plants.changed(table, **options)
        found[name] = fkgen.Spec.from_dict(changed | {"code": code})
    return found


NAMES = tuple(specs("double"))
FEW = [
    "kf",
    "kf_correlated",
    "kf_dense",
    "kf_sparse",
    "kf_fused_dense",
    "dfcf_groups",
    "mme",
    "imm_product",
    "attitude_ekf",
    "jump_nis",
]


def batch(plant, seed=8):
    """Records with rows that are missing, infinite or absurd, and parameters of their own."""
    rng = np.random.default_rng(seed)
    y = rng.standard_normal((M, T, plant.model.ny))
    y[rng.uniform(size=y.shape) < 0.2] = np.nan
    y[rng.uniform(size=y.shape) < 0.05] = np.inf
    y[rng.uniform(size=y.shape) < 0.02] = 1e300 if plant.code.scalar == "double" else 1e30
    y[rng.uniform(size=(M, T)) < 0.1] = np.nan
    y[0] = np.where(np.isfinite(y[0]), y[0], 0.5)  # a record with all its rows
    y[:, 3] = 0.25
    u = rng.standard_normal((M, T, plant.model.nu))
    u[rng.uniform(size=u.shape) < 0.02] = np.inf
    params = {name: value * rng.uniform(0.8, 1.2, (M, T)) for name, value in plant.defaults.items()}
    for values in params.values():
        values[2, 5], values[4, 7] = np.nan, -1e3
    return y, u if plant.model.nu else None, params


def starts(plant, layout):
    """A prior for each record; the moments of linear_optimal belong to that of the spec."""
    if plant.filter.family == "linear_optimal":
        return None
    rng = np.random.default_rng(3)
    n = len(layout.errors)
    F = rng.standard_normal((M, n, n))
    P0 = F @ F.swapaxes(1, 2)
    means = {} if layout.attitudes else {"x0": rng.standard_normal((M, n))}
    return means | {"P0": 0.5 * (P0 + P0.swapaxes(1, 2))}


def bits(values):
    """Bytes of the same bits: -0.0 is not 0.0, and each NaN is itself."""
    return np.ascontiguousarray(values).view(np.uint8)


@pytest.fixture(autouse=True)
def at_once(monkeypatch):
    """Lanes for every batch, however small."""
    monkeypatch.setattr(batches, "WORTH", 0)
    monkeypatch.setattr(batches, "WORTH_A_STATEMENT", 0)


def check(plant, found):
    """A batch, and the same records one by one."""
    y, u, params = batch(plant)
    told = {name: values[1] for name, values in params.items()}
    own = starts(plant, found.layout)
    for given, start in ((params, None), (told, own)):
        several = found.run_batch(y, u, given, start=start)
        assert (found._lanes.records is None) == (found.layout.statements > LARGEST)
        for m in range(M):
            mine = {name: v[m] if v.ndim == 2 else v for name, v in given.items()}
            begun = None if start is None else {name: value[m] for name, value in start.items()}
            one = found.run(y[m], None if u is None else u[m], mine, start=begun)
            for name in (*one.ports, "status", "held"):
                np.testing.assert_array_equal(
                    bits(several[name][m]), bits(one[name]), err_msg=f"{name} of {m}"
                )
    return several


@pytest.mark.parametrize(
    ("name", "scalar"),
    thorough(
        [(name, "float" if i % 3 == 2 else "double") for i, name in enumerate(NAMES)],
        [(name, "float" if i % 3 == 2 else "double") for i, name in enumerate(FEW)],
    ),
)
def test_a_batch_has_the_bits_of_its_records(name, scalar, monkeypatch):
    monkeypatch.setenv("FKGEN_CFLAGS", "-O1")  # the bits are those of every level
    plant = specs(scalar)[name]
    check(plant, fkgen.build(plant))


@pytest.mark.parametrize("compiler", C_COMPILERS)
@pytest.mark.parametrize("lanes", [2, 4, 8])
def test_so_it_has_with_any_number_of_lanes(compiler, lanes, monkeypatch):
    plant = specs("double")["imm_product"]
    monkeypatch.setenv("FKGEN_CC", C_COMPILERS[compiler][0])
    monkeypatch.setenv("FKGEN_CFLAGS", f"-O1 -D{plant.name.upper()}_LANES={lanes}")
    check(plant, fkgen.build(plant))


#: Parts of the text over lanes, and what they must not be.
MUTANTS = {
    "every lane takes a branch": (
        "return (N_lane_t)(((N_mask_t)a & mask)",
        "return a; return (N_lane_t)(((N_mask_t)a & mask)",
    ),
    "other lanes take a branch": ("taken0 = present[0];", "taken0 = ~present[0];"),
    "a refusal is not seen": ("if (bad[l])", "if (0)"),
    "an infinite result is not seen": ("bad | ~(N_mask_t)((sum - sum) >= 0.0)", "bad"),
    "all lanes have the record of the first": ("(first + l) : (stop", "first : (stop"),
}


@pytest.mark.parametrize("mutant", MUTANTS)
def test_a_mutant_of_the_text_has_other_bits(mutant):
    plant = specs("double")["kf"]
    source = generated(plant)
    old, new = (part.replace("N", plant.name) for part in MUTANTS[mutant])
    assert old in source.lanes
    changed = dataclasses.replace(source, lanes=source.lanes.replace(old, new))
    with pytest.raises(AssertionError, match="Arrays are not equal"):
        check(plant, fkgen.compile(changed))


def test_a_batch_without_lanes_is_filtered_too(monkeypatch):
    plant = specs("double")["kf"]
    monkeypatch.setenv("FKGEN_CFLAGS", f"-O1 -D{plant.name.upper()}_LANES=1")
    found = fkgen.build(plant)
    y, u, params = batch(plant)
    run = found.run_batch(y, u, params)
    assert found._lanes.records is None
    mine = {name: values[3] for name, values in params.items()}
    one = found.run(y[3], None if u is None else u[3], mine)
    np.testing.assert_array_equal(bits(run.filtered_state[3]), bits(one.filtered_state))
