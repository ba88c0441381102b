"""Sums over trials do not depend on the order in which they were added up."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from fkgen.study.campaigns.sums import Sums, merged

NUMBERS = st.floats(-1e200, 1e200, allow_nan=False)


def of(rows):
    """One ratio of one number over blocks of one trial."""
    return [Sums.of(1, {"a": ()}, np.array(row)[:, None]) for row in rows]


@given(st.lists(st.lists(NUMBERS, min_size=5, max_size=5), min_size=2, max_size=9), st.data())
def test_any_order_and_any_grouping_gives_the_same_bits_and_the_exact_sum(rows, data):
    once = merged(of(rows))
    left = data.draw(st.permutations(of(rows)))
    while len(left) > 1:
        count = data.draw(st.integers(2, len(left)))
        left = data.draw(st.permutations([merged(left[:count]), *left[count:]]))
    assert left[0].parts.tobytes() == once.parts.tobytes()
    assert left[0].trials == once.trials == len(rows)
    for i, column in enumerate(zip(*rows, strict=True)):
        assert sum(map(Fraction, once.parts[:, i].tolist())) == sum(map(Fraction, column))


def test_what_cancels_is_not_lost():
    rows = [[1e200] * 5, [1.0] * 5, [-1e200] * 5, [2.0**-300] * 5]
    assert sum(map(Fraction, merged(of(rows)).parts[:, 0].tolist())) == 1 + Fraction(1, 2**300)
