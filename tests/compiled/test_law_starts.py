"""Starts that depend on parameters: the prior and the law of the first mode, those of sample 0."""

from __future__ import annotations

import numpy as np
import pytest
from laws import ARRIVALS, JUMP, MODEL, MODES, SENSOR, START, ports_of, record, spec
from plants import assert_agree, built, generated
from toolchain import needs_compiler, run_main

import fkgen
from fkgen.errors import DataError, SpecError, StepRefused

pytestmark = needs_compiler()

#: Laws of the first mode with p = 0.8, q = 0.1, and with these numbers in their place; None for the
#: stationary one of a chain with parameters.
BEGUN = ["p - q", "q", "0.9 - p", 0.1], START
RESTING = None, None
ONE = {"problem": 1, "gamma_rate": 0.7, "delta_nominal_rate": 0.9}


def sensor(family, laws, initial, factor, **options):
    tables = [{key: each[key] for key in each if key != "initial"} for each in laws]
    tables = [t if i is None else t | {"initial": i} for t, i in zip(tables, initial, strict=True)]
    given = zip(factor, tables, strict=True)
    return [(family, {"sensor": {"noise_factor": f, **t}}, options) for f, t in given]


def jump(family, initial, more=({}, {}), **options):
    tables = [{"modes": MODES, **law, **each} for law, each in zip(JUMP, more, strict=True)]
    tables = [t if i is None else t | {"initial": i} for t, i in zip(tables, initial, strict=True)]
    return [(family, {"jump": table}, options) for table in tables]


THREE = ["p - q", 0.2, "0.8 - p + q"], [0.7, 0.2, 0.1]
LAWS = {
    "3 resting": (SENSOR["3"], RESTING),
    "4 resting": (SENSOR["4"], RESTING),
    "4 begun": ((SENSOR["4"][1],) * 2, BEGUN),
    "1 begun": ((ONE, ONE), BEGUN),
}
CASES = {
    **{
        f"{family} {name}": sensor(family, *law, ("p*5", 4.0))
        for family in ("one_step", "imm", "linear_optimal")
        for name, law in LAWS.items()
    },
    "augmented": sensor("linear_optimal", *LAWS["4 begun"], (4.0, 4.0), form="augmented"),
    "imm jump resting": jump("imm", RESTING),
    "imm jump begun": jump("imm", THREE),
    "mjls resting": jump("mjls_lmmse", RESTING),
    "mjls begun": jump("mjls_lmmse", THREE),
    "mjls arrivals": jump("mjls_lmmse", THREE, ARRIVALS),
    "mjls known": jump("mjls_lmmse", RESTING, [each | {"arrival": "known"} for each in ARRIVALS]),
    "mjls tested": jump("mjls_lmmse", RESTING, ARRIVALS, detector="nis"),
}


@pytest.mark.parametrize("name", list(CASES))
def test_a_first_law_with_parameters_is_the_law_with_numbers(name):
    given, numbers = CASES[name]
    varying = spec(*given, p=0.7, q=0.05)
    assert fkgen.Spec.from_dict(varying.to_dict()) == varying
    expected = built(spec(*numbers)).run(record())
    found = built(varying).run(record(), params={"p": 0.8, "q": 0.1})
    np.testing.assert_array_equal(found.status, expected.status)
    ports = [port for port in ports_of(expected) if port in found]  # one that rests has fewer
    assert_agree(found, expected, ports, 1e-12)  # some roundings of 1 - p


@pytest.mark.parametrize("name", ["imm 4 begun", "imm jump resting", "mjls arrivals"])
def test_the_law_of_sample_0_is_that_of_its_own_parameters(name):
    given, numbers = CASES[name]
    filtering, p, q = built(spec(*given, p=0.7, q=0.05)), np.full(14, 0.8), np.full(14, 0.1)
    p[0], q[0] = 0.75, 0.12
    whole = filtering.run(record(), params={"p": p, "q": q})
    batch = filtering.run_batch(
        np.stack([record()] * 2), params={"p": np.stack([p, p[::-1]]), "q": np.stack([q, q[::-1]])}
    )
    filtering.reset(params={"p": 0.75, "q": 0.12})
    for k in range(14):
        found = filtering.step(record()[k], params={"p": p[k], "q": q[k]})
        for port in (port for port in filtering.ports if port != "innovation"):
            np.testing.assert_array_equal(found[port], whole[port][k])
            np.testing.assert_array_equal(found[port], batch[port][0, k])
    expected = built(spec(*numbers)).run(record())
    np.testing.assert_array_equal(
        filtering.run_batch(
            np.stack([record()] * 2), params={"p": np.full(14, 0.8), "q": np.full(14, 0.1)}
        ).status[0],
        expected.status,
    )


def rested(P):
    values, vectors = np.linalg.eig(np.asarray(P).T)
    law = np.real(vectors[:, np.argmin(np.abs(values - 1.0))])
    return law / law.sum()


@pytest.mark.parametrize(("p", "q"), [(0.8, 0.1), (0.3, 0.05), (1.0, 0.2), (0.6, 0.0), (1.0, 0.0)])
def test_a_chain_begins_in_the_law_that_it_keeps(p, q):
    filtering = built(spec(*CASES["imm jump resting"][0], p=0.7, q=0.05))
    transition = [[p, 1 - p, 0.0], [q, 0.7, 0.3 - q], [0.3, 0.3, 0.4]]
    filtering.reset(params={"p": p, "q": q})
    found = filtering.snapshot().predicted_mode_probability
    np.testing.assert_allclose(found, rested(transition), atol=1e-14)


#: Three modes: 0 and 1 lead to 2, from where r leads back.
ABSORBING = {
    "transition": [["1 - r", 0.0, "r"], [0.0, 0.5, 0.5], ["s", "s", "1 - 2*s"]],
    "modes": MODES,
}


def test_a_chain_without_one_law_to_begin_in_is_refused_and_changes_nothing():
    filtering = built(spec("imm", {"jump": ABSORBING}, r=0.2, s=0.1))
    filtering.reset(params={"r": 0.1, "s": 0.2})
    law = filtering.snapshot().mode_probability
    np.testing.assert_allclose(law, rested([[0.9, 0.0, 0.1], [0.0, 0.5, 0.5], [0.2, 0.2, 0.6]]))
    before = filtering.snapshot()
    for wrong in ({"r": 0.0, "s": 0.0}, {"r": 1.1}, {"s": -0.01}):
        with pytest.raises(StepRefused) as caught:
            filtering.reset(params=wrong)
        assert caught.value.status == -4
        with pytest.raises(StepRefused):
            filtering.run(record(), params=wrong)
    with pytest.raises(DataError):
        filtering.reset(params={"r": "x"})
    assert filtering.snapshot() == before


C = """
    plant_t f, before;
    plant_params_t params;
    double x[2] = {1.0, 2.0}, P[3] = {1.0, 0.0, 1.0};
    SHOW(plant_params_init(&params));
    params.p = 0.8; params.q = 0.1;
    SHOW(plant_init(NULL, &params)); SHOW(plant_init(&f, NULL));
    SHOW(plant_init(&f, &params));
    printf("%.12f\\n%.12f\\n", f.mode_probability[0], f.predicted_state[1]);
    before = f;
    params.p = 1.5; SHOW(plant_init(&f, &params)); SHOW(plant_start(&f, &params, x, P));
    params.p = NAN; SHOW(plant_init(&f, &params)); SHOW(plant_start(&f, &params, x, P));
    SAME(f, before);
    params.p = 0.75;
    SHOW(plant_start(&f, NULL, x, P)); SHOW(plant_start(&f, &params, x, P));
    printf("%.12f\\n%.12f\\n", f.mode_probability[0], f.predicted_state[1]);
    SHOW(plant_selftest());
"""


def test_c_takes_the_parameters_of_sample_0(tmp_path):
    model = {"x0": ["p", "2*p"], "P0": [["q", 0.0], [0.0, 1.0]]}
    plant = spec(*CASES["imm jump begun"][0], model=MODEL | model, p=0.7, q=0.05)
    generated(plant).write(tmp_path / "out")
    show = '#define SHOW(call) printf("%d\\n", (int)(call))'
    same = '#define SAME(a, b) printf("%d\\n", memcmp(&(a), &(b), sizeof(a)) == 0)'
    include = '#include "plant.h"\n#include <math.h>\n#include <stdio.h>\n#include <string.h>'
    text = "\n".join([include, show, same, f"int main(void)\n{{{C}    return 0;\n}}\n"])
    found = run_main(tmp_path / "out", text, "plant.c", "plant_selftest.c", flags=["-lm"])
    first, second = ["0.700000000000", "1.600000000000"], ["0.650000000000", "2.000000000000"]
    refused = ["-4", "-4", "-4", "-4", "1", "-1", "0"]
    assert found == ["0", "-1", "-1", "0", *first, *refused, *second, "0"]


def test_a_prior_with_parameters_is_mixed_with_what_is_given():
    model = MODEL | {"x0": ["p", "exp(q)"], "P0": [["p**2", "p*q/2"], ["p*q/2", "q**2"]]}
    filtering = built(spec("kf", {}, model=model, p=2.0, q=3.0))
    at = {"p": 0.5, "q": 1.5}
    P0 = np.array([[0.25, 0.375], [0.375, 2.25]])
    for start, x0, covariance in (
        (None, [0.5, np.exp(1.5)], P0),
        ({"x0": [7.0, 8.0]}, [7.0, 8.0], P0),
        ({"P0": np.eye(2)}, [0.5, np.exp(1.5)], np.eye(2)),
    ):
        missing = np.full((1, 2), np.nan)
        found = filtering.run(missing, params=at, start=start)
        np.testing.assert_allclose(found.filtered_state[0], x0, rtol=1e-14)
        np.testing.assert_allclose(found.filtered_covariance[0], covariance, rtol=1e-14)
    with pytest.raises(SpecError, match=r"model.P0: given the variance"):
        spec("kf", {}, model=MODEL | {"P0": [["p - 3", 0.0], [0.0, 1.0]]}, p=2.0)
    drawn = fkgen.simulate(spec("kf", {}, model=model, p=2.0, q=3.0), 4000, 1, params=at).state
    np.testing.assert_allclose(drawn[:, 0].mean(axis=0), [0.5, np.exp(1.5)], atol=0.1)
    np.testing.assert_allclose(np.cov(drawn[:, 0].T), P0, atol=0.15)  # 4000 trials: 2 %
