"""Routines are found where a program does the same more than once, and say exactly what it did."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest
import sensor_specs
import spread
from plants import generated, motor, random_model

from fkgen.backend import routines
from fkgen.backend.expressions import joined
from fkgen.backend.ir import (
    Assign,
    Call,
    Expression,
    Heading,
    Literal,
    Operate,
    Operator,
    Phase,
    Require,
    Temp,
    walk,
)
from fkgen.backend.lower import lower
from fkgen.backend.routines import Outline, expanded, form_of, lines_of, outline
from fkgen.families import family
from fkgen.symbolic.interface import Kind, Status


def program_of(spec):
    return lower(family(spec.filter.family).build(spec))


@pytest.fixture(scope="module")
def bank():
    return program_of(motor("mme"))


def calls_of(body):
    return [node for node in walk(body) if isinstance(node, Call)]


def test_every_hypothesis_of_a_bank_is_a_call_of_one_routine(bank):
    outlined = outline(bank)
    names = [call.routine for body in outlined.bodies for call in calls_of(body)]
    hypotheses = [name for name in names if name.startswith("hypothesis")]
    assert max(hypotheses.count(name) for name in hypotheses) >= 4


def test_calls_of_one_routine_differ_in_numbers_or_arrays(bank):
    for routine in outline(bank).routines:
        if len(routine.constants) > 1 and routine.constants[0]:
            assert len(set(routine.constants)) > 1


@pytest.mark.parametrize("name", ["kf_wide", "mme_independent", "dfcf_groups", "cpcf"])
def test_no_function_is_longer_than_a_reader_bears(name):
    outlined = outline(program_of(spread.specs("double")[name]))
    for body in [p.body for p in outlined.phases] + [r.body for r in outlined.routines]:
        assert lines_of(body) <= 400


def test_a_call_with_the_row_or_the_array_of_another_says_something_else(bank):
    outlined = outline(bank)
    routine = next(r for r in outlined.routines if len(r.constants) > 1 and r.constants[0])
    own = {local.name: local.name for local in routine.locals}
    bodies = [p.body for p in outlined.phases] + [r.body for r in outlined.routines]
    one, other = [c for body in bodies for c in calls_of(body) if c.routine == routine.name][:2]
    honest = form_of(expanded(routine, one, own))
    assert form_of(expanded(routine, replace(one, constants=other.constants), own)) != honest
    assert form_of(expanded(routine, replace(one, arguments=other.arguments), own)) != honest


def test_the_same_statements_on_other_arrays_have_one_form():
    def statements(array, number):
        element = routines.Element(routines.Space.LOCAL, array, 0)
        return (
            Operate(Temp(3), Operator.MUL, (element, Literal(number))),
            Assign(replace(element, index=1), Temp(3)),
        )

    one, other = form_of(statements("a", 2.0)), form_of(statements("b", 5.0))
    assert one.shape == other.shape
    assert (one.literals, other.literals) == ((2.0,), (5.0,))


def body_of(*statements, fits=True):
    phase = Phase(locals=(), body=statements, reads_input=False, reads_parameters=False)
    return joined(Outline((phase,), ()), lambda _, __: fits).phases[0].body


ELEMENT = routines.Element(routines.Space.LOCAL, "a", 0)
PRODUCT = Operate(Temp(0), Operator.MUL, (Literal(2.0), Literal(3.0)))


def test_a_result_that_is_read_once_is_stored_by_its_operation():
    value = Expression(Operator.MUL, (Literal(2.0), Literal(3.0)))
    assert body_of(PRODUCT, Assign(ELEMENT, Temp(0))) == (Assign(ELEMENT, value),)


def test_a_result_that_is_read_again_keeps_its_temporary():
    twice = (PRODUCT, Assign(ELEMENT, Temp(0)), Assign(replace(ELEMENT, index=1), Temp(0)))
    assert body_of(*twice) == twice


def test_an_element_that_is_still_read_is_not_overwritten_early():
    body = body_of(
        PRODUCT,
        Operate(Temp(1), Operator.ADD, (ELEMENT, Literal(1.0))),
        Assign(ELEMENT, Temp(0)),
        Assign(replace(ELEMENT, index=1), Temp(1)),
    )
    places = [node.target.index for node in body if isinstance(node, Assign)]
    assert places == [1, 0]


def test_values_are_joined_in_the_order_in_which_they_are_computed():
    """The first of two factors stays a name where the second does: their order is kept."""
    other = Operate(Temp(1), Operator.DIV, (Literal(1.0), ELEMENT))
    total = Operate(Temp(2), Operator.SUB, (Temp(0), Temp(1)))
    body = body_of(PRODUCT, other, total, Assign(replace(ELEMENT, index=1), Temp(2)))
    (only,) = body
    assert [each.operator for each in only.value.arguments] == [Operator.MUL, Operator.DIV]
    assert len(body_of(PRODUCT, other, total, fits=False)) == 3


def test_elements_that_are_copied_in_a_row_are_one_copy():
    pairs = [
        (replace(ELEMENT, index=i), replace(ELEMENT, name="b", index=i + 2)) for i in range(40)
    ]
    (copy,) = body_of(*(Assign(*pair) for pair in pairs))
    assert (copy.target, copy.source, copy.size) == (*pairs[0], 40)
    *rows, last = body_of(*(Assign(*pair) for pair in pairs[:2] + pairs[5:]))
    assert rows == [Assign(*pair) for pair in pairs[:2]]
    assert last.size == 35


def test_few_copies_are_not_worth_a_function():
    pairs = [(replace(ELEMENT, index=i), replace(ELEMENT, name="b", index=i)) for i in range(7)]
    assert body_of(*(Assign(*pair) for pair in pairs)) == tuple(Assign(*pair) for pair in pairs)


def test_a_number_and_an_array_of_one_have_one_form():
    single = replace(ELEMENT, name="b", index=None)
    forms = [form_of((PRODUCT, Assign(each, Temp(0)))) for each in (ELEMENT, single)]
    assert forms[0].shape == forms[1].shape


def test_what_is_required_with_one_status_is_asked_at_once():
    required = [
        Require((replace(ELEMENT, index=i),), kind, Status.NOT_POSITIVE_DEFINITE)
        for i, kind in enumerate([Kind.POSITIVE, Kind.POSITIVE, Kind.FINITE])
    ]
    first, last = body_of(*required)
    assert first == replace(required[0], values=(required[0].values + required[1].values))
    assert last == required[2]


def test_a_block_in_which_every_cut_is_crossed_by_many_values_is_cut_all_the_same():
    made = [Operate(Temp(i), Operator.MUL, (Literal(2.0), ELEMENT)) for i in range(400)]
    read = [Assign(replace(ELEMENT, name="b", index=i), Temp(i)) for i in range(400)]
    phase = Phase((), (*made, *read), reads_input=False, reads_parameters=False, chunks=((0, ""),))
    program = replace(program_of(motor("kf")), update=phase)
    outlined = outline(program)
    assert all(lines_of(body) < 400 for body in outlined.bodies)


def test_a_heading_between_two_blocks_that_do_the_same_does_not_hide_it():
    steps = [Operate(Temp(i), Operator.MUL, (Literal(2.0 + i), ELEMENT)) for i in range(20)]
    there = [replace(ELEMENT, name="b", index=i) for i in range(40)]
    one = (*steps, *(Assign(to, Temp(i)) for i, to in enumerate(there[:20])))
    two = (*steps, *(Assign(to, Temp(i)) for i, to in enumerate(there[20:])))
    body = (*one, Heading("again"), *two)
    starts = ((0, ""), (len(one) + 1, ""))  # the heading stands at the end of the first block
    phase = Phase((), body, reads_input=False, reads_parameters=False, chunks=starts)
    outlined = outline(replace(program_of(motor("kf")), update=phase))
    assert len(calls_of(outlined.phases[0].body)) == 2


@pytest.mark.parametrize("rows", [1, 2])
def test_no_caller_reads_y_which_a_prediction_does_not_have(rows):
    """Where a prediction passes a sample y is NULL: calls of routines are given its address."""
    law = sensor_specs.PROBLEMS["4"] | {"rows": [0]}
    plant = sensor_specs.sensed(random_model(7, 3, rows), law, family="imm")
    text = generated(plant).files["plant.c"]
    assert not re.findall(r"(?<!double )(?<!&)\by\[\d\][,)]", text)
