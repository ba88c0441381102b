"""Probabilities of a spec: one, a distribution, a transition matrix."""

from __future__ import annotations

from fkgen.spec.place import Place, show
from fkgen.spec.section import as_list, as_number

Distribution = tuple[float, ...]

#: Largest distance of a sum from one that is taken for what a user rounded when typing.
SUM_TOLERANCE = 1e-9

#: Sums closer to one than this stay as they are; others are divided by their sum.
ROUNDING = 1e-14


def as_probability(value: object, place: Place) -> float:
    """Return a number in [0, 1]."""
    number = as_number(value, place, "a probability in [0, 1]")
    if not 0.0 <= number <= 1.0:
        raise place.error(show(number), "a probability in [0, 1]")
    return number


def as_distribution(value: object, place: Place, count: int, what: str) -> Distribution:
    """Return ``count`` probabilities that sum to one.

    Raises
    ------
    SpecError
        If there are more or fewer, one is outside [0, 1], or the sum is not 1.
    """
    expected = f"a list of {count} probabilities, {what}"
    entries = as_list(value, place, expected)
    if len(entries) != count:
        raise place.error(f"{len(entries)} entries", expected)
    found = tuple(as_probability(entry, place.item(i)) for i, entry in enumerate(entries))
    total = sum(found)
    if abs(total - 1.0) > SUM_TOLERANCE:
        raise place.error(f"probabilities that sum to {total:.12g}", "a sum of 1")
    return found if abs(total - 1.0) <= ROUNDING else tuple(each / total for each in found)


def as_transition(value: object, place: Place, order: str, count: int) -> tuple[Distribution, ...]:
    """Return a (count, count) transition matrix: row i is the law of the next state after i.

    Parameters
    ----------
    value : object
        A list of rows.
    place : Place
        Where.
    order : str
        The order of the states, for messages.
    count : int
        Number of states.

    Raises
    ------
    SpecError
        If it has another size, or a row is no distribution.
    """
    expected = f"a {count} x {count} matrix, states ordered {order}, rows that sum to 1"
    rows = as_list(value, place, expected)
    if len(rows) != count:
        raise place.error(f"{len(rows)} rows", expected)
    what = f"the law of the next state, ordered {order}"
    return tuple(as_distribution(row, place.item(i), count, what) for i, row in enumerate(rows))
