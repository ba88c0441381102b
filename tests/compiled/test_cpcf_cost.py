"""What the partial compression filter costs beside the Kalman filter: limits, and the page."""

from __future__ import annotations

import re

import pytest
from partial_plants import PAPER, cpcf
from plants import random_model, spec

from fkgen.backend.lower import lower
from fkgen.families import family
from fkgen.study.reports.starters import resource

#: FLOPs of a sample that ends no window, over those of the Kalman filter of the same rows.
MOST = 1.6


def program(filtering):
    return lower(family(filtering.filter.family).build(filtering))


def numbers(filtering):
    """FLOPs of a sample without the end of a window, and scalars stored."""
    found = program(filtering)
    return found.flops, sum(port.size for port in found.ports)


DENSE = random_model(1, 2, 2)
MODELS = {
    "the simulation": PAPER,
    "dense A": {**DENSE, "C": [[1.0, 0.0], [0.0, 1.0]]},
    "dense A and C": DENSE,
}


@pytest.mark.parametrize("maintenance", ["optimal", "paper"])
@pytest.mark.parametrize("name", MODELS)
def test_a_sample_that_ends_no_window_costs_little_more_than_a_kalman_filter(name, maintenance):
    filtering, kalman = cpcf(MODELS[name], maintenance=maintenance), spec(MODELS[name])
    assert numbers(filtering)[0] <= MOST * numbers(kalman)[0]


def test_the_end_of_a_window_is_a_function_of_its_own():
    found = program(cpcf(PAPER))
    assert 0 < found.closing_flops < 40
    assert found.operations == program(cpcf(PAPER, window=7)).operations


def test_the_cost_on_the_page_is_that_of_the_code():
    page = resource("docs/families/cpcf.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d), (\d) \| (.*) \|$", page, re.MULTILINE)
    assert len(rows) == 4
    for n, p, stated in rows:
        model, host = random_model(1, int(n), int(p)), range(1, int(p))
        filters = (spec(model), *(cpcf(model, host=host, family=f) for f in ("dfcf", "cpcf")))
        found = " | ".join("{}, {}".format(*numbers(each)) for each in filters)
        assert stated == found
