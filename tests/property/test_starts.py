"""Where a filter starts: any prior is that of a spec which states it, and a snapshot goes on."""

from __future__ import annotations

import pickle
from functools import cache
from itertools import chain

import numpy as np
import pytest
import sensor_specs
import spread
from jump_plants import EXAMPLE_A, EXAMPLE_B, random_table, spec_of
from nonlinear_specs import spec_of as spec_of_equations
from plants import covariance, generated, motor, random_model, spec
from toolchain import needs_compiler, run_main

import fkgen
from fkgen.backend.execute import Machine
from fkgen.backend.lower import lower
from fkgen.errors import DataError, StepRefused
from fkgen.families import family
from fkgen.runtime.results import Snapshot

pytestmark = needs_compiler()

#: Of the spread; sensors and modes are below.
KINDS = ("kf_correlated", "kf_functions", "mkf_independent", "mme", "mme_independent")
KINDS += ("dfcf", "dfcf_groups", "compression_full", "cpcf")


@cache
def plants(scalar="double"):
    """One spec of every kind by name; forms do not follow the prior."""
    code = {"scalar": scalar, "update": "joseph"}
    result = {name: spread.specs(scalar)[name] for name in KINDS}
    result |= sensor_specs.every(scalar)
    jumps = {
        "mjls": random_table(7, 3, 2, 2, q=1, offsets=True),
        "mjls_plain": EXAMPLE_A,
        "mjls_tested": EXAMPLE_A | {"name": "plant"},
        "mjls_chain": EXAMPLE_A,
        "mjls_stationary": EXAMPLE_B,
    }
    options = {
        "mjls_tested": {"arrival_rate": 0.6, "detector": "llr", "reinitialise": True},
        "mjls_chain": {"arrival_chain": [[0.4, 0.6], [0.1, 0.9]], "arrival": "unknown"},
        "mjls_stationary": {"arrival_rate": 0.6, "gain": "stationary"},
    }
    result |= {name: spec_of(table, **options.get(name, {})) for name, table in jumps.items()}
    return {name: changed(each, code=code) for name, each in result.items()}


def changed(plant, **tables):
    table = plant.to_dict()
    for key, values in tables.items():
        table[key] = table.get(key, {}) | values
    return fkgen.Spec.from_dict(table)


#: One of each kind of start.
ONES = ("kf_functions", "mme", "dfcf_groups", "compression_full", "cpcf", "genie", "one_step")
ONES += ("imm", "linear_absorbing", "augmented", "mjls")
#: Without a constant term the mean has to stay where it is.
CENTRED = {"linear_absorbing", "linear_moments"}
NAMES = tuple(plants())


def prior(name, seed=5):
    """Another prior: (x0, P0)."""
    rng, n = np.random.default_rng(seed), plants()[name].model.nx
    x0 = np.zeros(n) if name in CENTRED else rng.standard_normal(n)
    return x0, covariance(rng, n)


def data(plant, T, seed=3):
    rng = np.random.default_rng(seed)
    y = 2.0 * rng.standard_normal((T, plant.model.ny))
    y[rng.random(y.shape) < 0.2] = np.nan
    u = rng.standard_normal((T, plant.model.nu)) if plant.model.nu else None
    return y, u, {key: np.full(T, value) for key, value in plant.defaults.items()}


def instance(plant):
    """The bits of an instance that starts as a spec says, from its statements in NumPy."""
    machine = Machine(lower(family(plant.filter.family).build(plant)))
    beside = [0.0] * (1 + len(machine.program.repeats or ()))
    kind = np.float32 if plant.code.scalar == "float" else np.float64
    return np.array([*chain(*machine.ports.values()), *beside], kind).tobytes()


SCALARS = ["double", pytest.param("float", marks=pytest.mark.exhaustive)]


@pytest.mark.parametrize("scalar", SCALARS)
@pytest.mark.parametrize("name", NAMES)
def test_a_start_is_the_prior_of_a_spec_that_states_it(name, scalar):
    plant, (x0, P0) = plants(scalar)[name], prior(name)
    x0, P0 = (np.asarray(value, np.float32).astype(float) for value in (x0, P0))
    stated = instance(changed(plant, model={"x0": x0.tolist(), "P0": P0.tolist()}))
    y, u, params = data(plant, 5)
    found = fkgen.build(plant)
    assert found.snapshot().data.startswith(instance(plant))  # the hash of the model comes last
    run = found.run(y, u, params, start={"x0": x0, "P0": P0})
    starts = {"x0": np.stack([x0, x0]), "P0": np.stack([P0, P0])}
    batch = found.run_batch(np.stack([y, y]), u, params, start=starts)
    found.reset(x0, P0)
    assert found.snapshot().data.startswith(stated)
    for k in range(len(y)):
        now = {key: float(value[k]) for key, value in params.items()}
        last = found.step(y[k], None if u is None else u[k], now or None)
        for port in (port for port in found.ports if port != "innovation"):
            np.testing.assert_array_equal(run[port][k], last[port])
            np.testing.assert_array_equal(batch[port][:, k], np.stack([last[port]] * 2))


@pytest.mark.parametrize("name", ONES)
def test_a_prior_of_parameters_is_the_prior_of_their_values(name):
    plant, (x0, P0) = plants()[name], prior(name)
    n, own = len(x0), plant.model.P0.values(plant.defaults)
    mean = [f"mean_{i}" for i in range(n)] if name not in CENTRED else [0.0] * n
    both = [[f"prior_{max(i, j)}_{min(i, j)}" for j in range(n)] for i in range(n)]
    defaults = {both[i][j]: float(own[i, j]) for i in range(n) for j in range(i + 1)}
    defaults |= {each: 0.5 for each in mean if each}
    y, u, params = data(plant, 5)
    expected = fkgen.build(plant).run(y, u, params, start={"x0": x0, "P0": P0})
    varying = changed(plant, model={"x0": mean, "P0": both}, parameters=defaults)
    told = {both[i][j]: P0[i, j] for i in range(n) for j in range(i + 1)}
    told |= {each: x0[i] for i, each in enumerate(mean) if each}
    found = fkgen.build(varying).run(y, u, params | told)
    np.testing.assert_array_equal(found.status, expected.status)
    for port in expected.ports:
        np.testing.assert_allclose(found[port], expected[port], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_a_record_goes_on_where_a_snapshot_was_taken(name):
    plant, at = plants()[name], 5
    y, u, params = data(plant, 14)
    y[at, 0], y[at + 3, 0] = np.inf, -np.inf
    if u is not None:
        u[at + 1] = np.nan
    found = fkgen.build(plant)
    whole = found.run(y, u, params)
    for k in range(at):
        now = {key: float(value[k]) for key, value in params.items()}
        found.step(y[k], None if u is None else u[k], now or None)
    saved = pickle.loads(pickle.dumps(found.snapshot()))  # noqa: S301
    rest = {key: value[at:] for key, value in params.items()}
    part = found.run(y[at:], None if u is None else u[at:], rest, start=saved)
    assert found.snapshot() == saved
    np.testing.assert_array_equal(part.held, whole.held[at:])
    for port in found.ports:
        np.testing.assert_array_equal(part[port], whole[port][at:])


def spoilt(found):
    """A snapshot whose covariances, or whose factors, have lost their positivity."""
    before, kind = found.snapshot(), np.dtype(found.layout.dtype)
    values = np.frombuffer(before.data, kind, len(before.data) // kind.itemsize).copy()
    at = 0
    for port in found.layout.ports:
        if "covariance" in port.name or "factors" in port.name or "moment" in port.name:
            values[at : at + port.size] = -np.abs(values[at : at + port.size])
        at += port.size
    return Snapshot(before.layout, values.tobytes(), before.status)


MORE = {name: spread.specs()[name] for name in ("dfcf_ud",)}
LOST = (*ONES, "kf_correlated", "mkf_independent", "ekf", "iekf", "ukf", "dfcf_ud")


@pytest.mark.parametrize("name", LOST)
def test_a_start_leads_out_of_a_covariance_that_is_none(name):
    nonlinear = name in {"ekf", "iekf", "ukf"}
    plant = spec_of_equations("circle", name) if nonlinear else {**plants(), **MORE}[name]
    y, u, params = data(plant, 4)
    told = [{key: float(value[k]) for key, value in params.items()} or None for k in range(4)]
    known, found = [None if u is None else u[k] for k in range(4)], fkgen.build(plant)
    y[0] = 0.1
    lost = spoilt(found)
    found.restore(lost)
    for _ in range(2):
        with pytest.raises(StepRefused, match="NOT_POSITIVE_DEFINITE"):
            found.step(y[0], known[0], told[0])
        assert found.snapshot() == lost
    found.reset()
    other = fkgen.build(plant)
    for k in range(4):
        assert found.step(y[k], known[k], told[k]) == other.step(y[k], known[k], told[k])
        assert other.snapshot().status >= 0


def test_records_of_a_batch_may_start_apart():
    plant = plants()["kf_correlated"]
    y, u, _ = data(plant, 6)
    found, n = fkgen.build(plant), plant.model.nx
    rng = np.random.default_rng(8)
    x0, P0 = rng.standard_normal((3, n)), np.array([covariance(rng, n) for _ in range(3)])
    for start in ({"x0": x0, "P0": P0}, {"x0": x0}, {"P0": P0}, {"x0": x0[0], "P0": P0}):
        batch = found.run_batch(np.stack([y] * 3), u, start=start)
        for m in range(3):
            own = {k: v[m] if len(v) == 3 and np.ndim(v) > (k == "P0") + 1 else v
                   for k, v in start.items()}  # fmt: skip
            single = found.run(y, u, start=own)
            np.testing.assert_array_equal(batch.filtered_state[m], single.filtered_state)


def test_a_filter_comes_back_from_its_text_where_the_cache_is_empty(tmp_path, monkeypatch):
    found = fkgen.build(plants()["mme"])
    y, u, _ = data(plants()["mme"], 4)
    found.step(y[0], u[0])
    saved = pickle.dumps(found)
    monkeypatch.setenv("FKGEN_CACHE", str(tmp_path))
    other = pickle.loads(saved)  # noqa: S301
    assert other.folder.parent == tmp_path
    assert other.step(y[1], u[1]) == found.step(y[1], u[1])


BAD = [
    ({"x0": [1.0]}, r"x0: given shape \(1,\); expected shape \(2,\)"),
    ({"x0": [1.0, np.nan]}, r"x0\[1\]: given nan; expected a finite number"),
    ({"x0": ["a", "b"]}, r"x0\[0\]: given text 'a'"),
    ({"P0": np.eye(3)}, r"P0: given shape \(3, 3\)"),
    ({"P0": [[1.0, np.inf], [np.inf, 1.0]]}, r"P0\[0\]\[1\]: given inf"),
    ({"P0": [[1.0, 0.5], [0.1, 1.0]]}, r"P0: given \[0\]\[1\] = 0.5 and \[1\]\[0\] = 0.1"),
    ({"P0": [[1.0, 2.0], [2.0, 1.0]]}, "P0: given .*eigenvalue.*positive semidefinite"),
    ({"P0": [[-1.0, 0.0], [0.0, 1.0]]}, "P0: given the variance -1"),
    ({"x": [0.0, 0.0]}, r"start\.x: given an unknown key; expected 'x0'"),
    ([0.0, 0.0], "start: given list; expected a Snapshot or a mapping"),
]


@pytest.mark.parametrize(("start", "message"), BAD)
def test_a_start_that_is_none_is_refused_in_one_line(start, message):
    found = fkgen.build(motor("kf"))
    before = found.snapshot()
    y, u = np.zeros(3), np.zeros(3)
    calls = [
        lambda: found.run(y, u, start=start),
        lambda: found.run_batch(y.reshape(1, 3, 1), u[:, None], start=start),
    ]
    if isinstance(start, dict) and set(start) <= {"x0", "P0"}:
        calls.append(lambda: found.reset(**start))
    for call in calls:
        with pytest.raises(DataError, match=message) as caught:
            call()
        assert "\n" not in str(caught.value)
    assert found.snapshot() == before


def test_a_snapshot_of_another_filter_is_refused():
    found, other = fkgen.build(motor("kf")), fkgen.build(motor("kf", code={"update": "joseph"}))
    for wrong in (other.snapshot(), None, "snapshot"):
        with pytest.raises(DataError, match="snapshot: given"):
            found.restore(wrong)
    with pytest.raises(DataError, match="snapshot: given one of the filter 'plant', spec"):
        found.run([0.0], [0.0], start=other.snapshot())


def test_a_mean_that_a_filter_has_no_term_for_is_refused():
    found = fkgen.build(plants()["linear_absorbing"])
    with pytest.raises(StepRefused, match="PARAMETER_OUT_OF_RANGE"):
        found.reset(np.ones(len(found.layout.states)))


PRELUDE = """
#include "plant.h"
#include <math.h>
#include <stdio.h>
#include <string.h>
#define SHOW(call) printf("%d\\n", (int)(call))
"""


def test_a_start_in_c_is_a_transaction(tmp_path):
    plant = spec(random_model(91, 2, 2), family="kf")
    generated(plant).write(tmp_path / "out")
    body = """
    plant_t f, before, other;
    double x[2] = {1.0, 2.0}, P[3] = {1.0, 0.5, 2.0}, nan[2] = {NAN, 0.0};
    double minus[3] = {1.0, 0.0, -1.0}, inf[3] = {INFINITY, 0.0, 1.0};
    SHOW(plant_init(&f));
    before = f;
    SHOW(plant_start(NULL, x, P)); SHOW(plant_start(&f, NULL, P)); SHOW(plant_start(&f, x, NULL));
    SHOW(plant_start(&f, nan, P)); SHOW(plant_start(&f, x, inf)); SHOW(plant_start(&f, x, minus));
    SHOW(memcmp(&f, &before, sizeof f));
    SHOW(plant_step(&f, x, 3u));
    SHOW(plant_start(&other, f.filtered_state, f.filtered_covariance));
    SHOW(plant_start(&f, f.filtered_state, f.filtered_covariance));
    SHOW(memcmp(&f, &other, sizeof f));
    """
    text = f"{PRELUDE}\nint main(void)\n{{\n{body}\n    return 0;\n}}\n"
    expected = ["0", "-1", "-1", "-1", "-2", "-2", "-3", "0", "0", "0", "0", "0"]
    assert run_main(tmp_path / "out", text, "plant.c", flags=["-lm"]) == expected
