"""What a compression filter costs beside the Kalman filter of the same rows, and in float."""

from __future__ import annotations

import re

import numpy as np
import pytest
from plants import built, random_model, record, run
from plants import spec as plain
from soft_plants import PAPER, soft

from fkgen.backend.lower import lower
from fkgen.families import family
from fkgen.study.reports.starters import resource

SHAPES = [
    (n, p, host)
    for n in (1, 2, 3, 4, 6, 8)
    for p in (2, 3, 4)
    for host in range(1, p)
    if (n, p) not in {(8, 2), (8, 3)}
]


def program(spec):
    return lower(family(spec.filter.family).build(spec))


def pair(n, p, host):
    model = random_model(10 * n + p, n, p)
    return program(plain(model, family="kf")), program(soft(model, host=range(host)))


def stored(program):
    return sum(port.size for port in program.ports)


@pytest.mark.parametrize(("n", "p", "host"), SHAPES)
def test_a_sample_costs_at_most_2_2_and_an_instance_is_at_most_2_5_times_the_kf(n, p, host):
    kf, dfcf = pair(n, p, host)
    assert dfcf.flops <= 2.2 * kf.flops
    assert stored(dfcf) <= 2.5 * stored(kf)


def test_the_papers_plant_costs_at_most_2_2_times_the_kf():
    kf, dfcf = program(plain(PAPER, family="kf")), program(soft(PAPER, window=150))
    assert dfcf.flops <= 2.2 * kf.flops


def test_the_table_of_costs_is_what_the_program_says():
    text = resource("docs/families/dfcf.md").read_text(encoding="utf-8")
    rows = re.findall(
        r"^\| (\d), (\d), (\d) \| (\d+) \| (\d+) \| [\d.]+ \| (\d+) \| (\d+), (\d+) \|$",
        text,
        re.MULTILINE,
    )
    assert len(rows) == 4
    for row in rows:
        n, p, host, *stated = map(int, row)
        kf, dfcf = pair(n, p, host)
        assert stated == [kf.flops, dfcf.flops, dfcf.closing_flops, stored(kf), stored(dfcf)]


def test_the_test_is_a_function_of_its_own_that_is_called_at_window_ends_only():
    from plants import generated

    text = generated(soft(PAPER, window=150)).files["plant.c"]
    ends = r"!\(next(\.|->)window_left > 0\.0\)\)\n    \{\n        status = plant_close_window"
    assert len(re.findall(ends, text)) == text.count("status = plant_close_window") == 3
    assert "INLINE plant_status_t plant_close_window" not in text


def test_in_float_the_estimates_are_those_of_double_to_single_precision():
    model = random_model(41, 3, 3, 1)
    double, single = (
        soft(model, window=5, code={"scalar": scalar}) for scalar in ("double", "float")
    )
    y, u = record(double, 41, missing=0.2)
    wide, narrow = run(double, y, u), run(single, y, u)
    np.testing.assert_array_equal(narrow.test_dof, wide.test_dof)
    scale = np.abs(wide.filtered_state).max()
    np.testing.assert_allclose(narrow.filtered_state, wide.filtered_state, atol=1e-4 * scale)
    tested = wide.test_dof > 0
    np.testing.assert_allclose(
        narrow.test_statistic[tested], wide.test_statistic[tested], rtol=0.05
    )


@pytest.mark.parametrize("seed", [45, 46, 48])
def test_in_float_a_prior_of_a_hundred_million_times_the_noise_is_survived(seed):
    model = random_model(seed, 2, 2) | {"P0": [[1e8, 0.0], [0.0, 1e8]]}
    y = np.random.default_rng(42).standard_normal((41, 2))
    result = built(soft(model, window=4, test=False, code={"scalar": "float"})).run(y)
    assert (result.status >= 0).all()
    kf = built(plain(model, family="kf")).run(y)
    found, exact = result.filtered_covariance[8::4], kf.filtered_covariance[8::4]
    assert np.abs(found - exact).max() < 1e-3 * np.abs(exact).max()
