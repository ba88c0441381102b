"""What a gate leaves out counts as missing, and it leaves out what chi-square quantiles say."""

from __future__ import annotations

import numpy as np
import pytest
from plants import common, distance, random_model, record, spec
from scipy.stats import chi2

import fkgen
from fkgen.oracle.exact.gate import batch_gated
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.proof.selftest import claims, compilers
from fkgen.symbolic.interface import Status

CORRELATED = random_model(3, 3, 3, 2, direct=True, correlated=True)
#: Rows without noise, one of them said twice.
EXACT = random_model(4, 3, 3) | {"R": [[0.0] * 3] * 3}
EXACT["C"][2] = EXACT["C"][0]
CASES = {
    "correlated": (CORRELATED, {}),
    "short": (random_model(5, 2, 2, 1), {"code": {"update": "short"}}),
    "exact": (EXACT, {}),
    "mkf": (random_model(6, 2, 3, 1, correlated=True), {"family": "mkf", "actuator": common(0.7)}),
    "sensed": (CORRELATED, {"family": "mkf", "actuator": common(0.6)}),
    "genie": (random_model(7, 2, 2), {"family": "genie", "sensor": {"noise_factor": 9.0}}),
}
MODES = ("row", "sample")
T, GATE = 60, 0.9


def drawn(case):
    """A record with what no gate lets pass, what every one does, and gaps."""
    model, sections = CASES[case]
    stated = spec(model, **sections)
    rng = np.random.default_rng(11)
    y, u = record(stated, T, seed=2, missing=0.15)
    out = rng.random(y.shape) < 0.15
    y += out * rng.uniform(-30.0, 30.0, y.shape)
    if case == "exact":
        y[:, 2] = y[:, 0]
    params = {}
    if case == "genie":
        params = {"gamma": (rng.random(T) < 0.7) * 1.0, "delta": rng.choice([1.0, 9.0], T)}
    return y, (u if stated.model.nu else None), params


@pytest.mark.parametrize("by", MODES)
@pytest.mark.parametrize("case", CASES)
def test_what_is_left_out_counts_as_missing(case, by):
    model, sections = CASES[case]
    y, u, params = drawn(case)
    gated = fkgen.build(spec(model, **sections, gate=GATE, gate_by=by)).run(y, u, params)
    assert gated.rejected.dtype == bool
    assert gated.rejected.shape == y.shape
    assert not gated.rejected[np.isnan(y)].any()
    found = gated.rejected.any(axis=1)
    assert 10 < found.sum() < T - 10
    np.testing.assert_array_equal(gated.status == Status.FAULT_DECLARED.value, found)
    kept = np.where(gated.rejected, np.nan, y)
    plain = fkgen.build(spec(model, **sections)).run(kept, u, params)
    for port in plain.ports:
        expected = (
            np.where(np.isnan(kept), np.nan, gated[port]) if port == "innovation" else gated[port]
        )
        assert distance(plain[port], expected) <= 1e-11, port  # rows in another order of roundings


@pytest.mark.parametrize("by", MODES)
@pytest.mark.parametrize("case", CASES)
def test_what_passes_is_inside_the_quantile(case, by):
    model, sections = CASES[case]
    y, u, params = drawn(case)
    gated = fkgen.build(spec(model, **sections, gate=GATE, gate_by=by)).run(y, u, params)
    counted = 0
    for nu, S, out in zip(
        gated.innovation, gated.innovation_covariance, gated.rejected, strict=True
    ):
        rows = np.flatnonzero(np.isfinite(nu))
        if by == "sample":
            if rows.size:
                nis = nu[rows] @ np.linalg.pinv(S[np.ix_(rows, rows)], rcond=1e-10) @ nu[rows]
                assert (nis > chi2.ppf(GATE, rows.size)) == out.any() == out[rows].all()
                counted += 1
            continue
        before = []
        for i in rows:
            K = S[i, before] @ np.linalg.pinv(S[np.ix_(before, before)], rcond=1e-10)
            s = S[i, i] - K @ S[before, i]
            if s > 1e-9 * S[i, i]:  # else the rows before it say what it is
                error = nu[i] - K @ nu[before]
                assert (error**2 > chi2.ppf(GATE, 1) * s) == out[i]
                counted += 1
            before += [] if out[i] else [i]
    assert counted > T // 2


@pytest.mark.parametrize("case", ["correlated", "sensed"])
@pytest.mark.parametrize("by", MODES)
def test_the_joint_distribution_of_what_passes_gives_the_same(case, by):
    model, sections = CASES[case]
    y, u, _ = drawn(case)
    stated = spec(model, **sections, gate=GATE, gate_by=by)
    found = fkgen.build(stated).run(y[:12], u[:12])
    system = LinearSystem.from_spec(stated, 12)
    expected = batch_gated(system, y[:12], u[:12], GATE, together=by == "sample")
    for port, values in vars(expected).items():
        assert distance(found[port], values) <= 1e-9, port


@pytest.mark.parametrize("by", MODES)
@pytest.mark.parametrize(("factor", "rejected"), [(1.0 - 1e-9, False), (1.0 + 1e-9, True)])
def test_the_edge_of_the_gate_is_the_quantile(by, factor, rejected):
    model = {"A": [[1.0]], "C": [[1.0]], "Q": [[0.0]], "R": [[3.0]], "x0": [0.5], "P0": [[1.0]]}
    gated = fkgen.build(spec(model, gate=0.9999, gate_by=by))
    edge = 0.5 + np.sqrt(chi2.ppf(0.9999, 1) * 4.0) * factor
    assert gated.step(edge).rejected.tolist() == [rejected]


def test_bits_of_many_rows_are_words_as_those_of_valid():
    rng = np.random.default_rng(1)
    p = 35
    model = {"A": [[0.9]], "C": np.ones((p, 1)).tolist(), "Q": [[0.1]], "R": np.eye(p).tolist()}
    stated = spec(model | {"x0": [0.0], "P0": [[1.0]]}, gate=0.99)
    gated, y = fkgen.build(stated), rng.standard_normal((6, p))
    y[2, [0, 31, 32, 34]] = 40.0
    y[4] = np.nan
    out = gated.run(y).rejected
    assert np.flatnonzero(out[2]).tolist() == [0, 31, 32, 34]
    assert not out[4].any()
    gated.run(y)
    for now in y[:3]:
        snapshot = gated.step(now)
    words = np.frombuffer(snapshot.data[-16:], np.uint32)  # before the hash, and a gap
    assert words[:2].tolist() == [1 | 1 << 31, 1 | 1 << 2]
    np.testing.assert_array_equal(snapshot.rejected, out[2])
    assert gated.snapshot() == snapshot
    source = fkgen.generate(fkgen.validate(stated))
    assert "uint32_t rejected[PLANT_VALID_WORDS];" in source.files["plant.h"]
    assert all(claim.holds for claim in claims(source, compilers()[0]))


@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"gate": 1.0}, "filter.gate"),
        ({"gate": 0}, "filter.gate"),
        ({"gate": "x"}, "filter.gate"),
        ({"gate": float("nan")}, "filter.gate"),
        ({"gate_by": "row"}, "filter.gate"),
        ({"gate": 0.9, "gate_by": "rows"}, "filter.gate_by"),
        ({"gate": 0.9, "family": "imm"}, "filter.gate"),
    ],
)
def test_what_is_no_gate_is_refused_where_it_stands(options, key):
    with pytest.raises(fkgen.SpecError) as fault:
        spec(CORRELATED, **options)
    assert fault.value.key == key
    assert "\n" not in str(fault.value)
