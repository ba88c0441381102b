"""Programs that are not well formed never reach the printer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from plants import generated, motor

from fkgen.backend.ir import (
    Assign,
    Copy,
    Element,
    For,
    IfPresent,
    Literal,
    Local,
    Operate,
    Operator,
    Space,
    Temp,
    walk,
)
from fkgen.backend.lower import verify
from fkgen.backend.printer import Printer
from fkgen.errors import InternalError
from fkgen.symbolic.index import packed, variable


@pytest.fixture(scope="module")
def program():
    return generated(motor("mkf")).program


def with_update(program, *more, without=()):
    body = tuple(node for node in program.update.body if node not in without)
    return replace(program, update=replace(program.update, body=(*body, *more)))


def fresh(program):
    """A temporary that no statement of the update assigns."""
    used = [n.target.index for n in walk(program.update.body) if isinstance(n, Operate | Copy)]
    return Temp(max(used) + 1)


def written(program, name):
    """Assignments of the update to a member of the instance."""
    return [n for n in program.update.body if isinstance(n, Assign) and n.target.name == name]


def test_what_the_back_end_makes_is_well_formed(program):
    assert verify(program) is program


def test_a_temporary_read_before_it_is_assigned_is_refused(program):
    node = Operate(fresh(program), Operator.ADD, (Temp(10**6), Literal(1.0)))
    with pytest.raises(InternalError, match="temporary 1000000 is read before it is assigned"):
        verify(with_update(program, node))


def test_a_temporary_that_reads_itself_is_refused(program):
    node = Operate(fresh(program), Operator.NEG, (fresh(program),))
    with pytest.raises(InternalError, match="read before it is assigned"):
        verify(with_update(program, node))


@pytest.mark.parametrize(
    "again", [lambda t: Operate(t, Operator.NEG, (Literal(1.0),)), lambda t: Copy(t, Literal(1.0))]
)
def test_a_temporary_assigned_twice_is_refused(program, again):
    node = Copy(fresh(program), Literal(2.0))
    with pytest.raises(InternalError, match="is assigned twice"):
        verify(with_update(program, node, again(fresh(program))))


def test_a_result_that_is_never_written_is_refused(program):
    missing = written(program, "filtered_state")[:1]
    with pytest.raises(InternalError, match=r"never written: \[\('filtered_state', 0\)\]"):
        verify(with_update(program, without=missing))


def test_a_result_written_twice_is_refused(program):
    with pytest.raises(InternalError, match="is written twice"):
        verify(with_update(program, written(program, "nis")[0]))


def test_a_result_written_under_a_condition_is_refused(program):
    node = written(program, "nis")[0]
    moved = with_update(program, IfPresent(0, (node,)), without=[node])
    with pytest.raises(InternalError, match="is written under a condition"):
        verify(moved)


def test_a_prediction_that_reads_the_old_instance_is_refused(program):
    source = Element(Space.SELF, "predicted_state", 0)
    target = Temp(10**6)
    body = (Copy(target, source), *program.predict.body)
    with pytest.raises(InternalError, match="reads predicted_state, which no update writes"):
        verify(replace(program, predict=replace(program.predict, body=body)))


@pytest.mark.parametrize(
    ("scalar", "value", "text"),
    [
        ("double", 0.1, "0.1"),
        ("double", 1.0, "1.0"),
        ("double", -2.5e-7, "-2.5e-07"),
        ("double", 1e300, "1.0e+300"),
        ("double", 0.0, "0.0"),
        ("float", 0.1, "0.1f"),
        ("float", 1e-10, "1.0e-10f"),
        ("float", 16777217.0, "16777216.0f"),
    ],
)
def test_literals_are_short_typed_and_read_back_as_the_same_bits(program, scalar, value, text):
    printed = Printer(replace(program, scalar=scalar)).literal(value)
    assert printed == text
    real = np.float64 if scalar == "double" else np.float32
    assert real(printed.rstrip("f")) == real(value)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_constants_that_are_no_numbers_are_never_printed(program, value):
    with pytest.raises(InternalError, match="is not finite as double"):
        Printer(program).literal(value)


def test_a_constant_beyond_float_is_never_printed_as_float(program):
    with np.errstate(over="ignore"), pytest.raises(InternalError, match="not finite as float"):
        Printer(replace(program, scalar="float")).literal(1e39)


def test_calls_are_counted_apart_from_operations():
    program = generated(motor("mme")).program
    calls = {op for op in program.operations if op.is_function}
    assert calls == {Operator.EXP, Operator.LOG} == program.functions
    total = sum(program.operations.values())
    assert program.flops == total - sum(program.operations[op] for op in calls)


# ------------------------------------------------------------------------------------- loops

I, J = variable("i"), variable("j")
STORE = Element(Space.LOCAL, "store", I)


def looped(program, body, *, index="i", begin=0, end=3, size=3):
    """A program with one more local array, and a loop at the end of its update."""
    longer = with_update(program, For(index, begin, end, tuple(body)))
    local = Local("store", size, 0.0)
    return replace(longer, update=replace(longer.update, locals=(*longer.update.locals, local)))


def test_a_loop_over_an_array_is_well_formed(program):
    verify(looped(program, [Assign(STORE, Literal(1.0))]))


@pytest.mark.parametrize(
    ("body", "options", "complaint"),
    [
        ([Assign(STORE, Literal(1.0))], {"end": 4}, "outside of its array"),
        ([Assign(STORE, Literal(1.0))], {"begin": -1}, "outside of its array"),
        ([Assign(STORE.shifted(1), Literal(1.0))], {}, "outside of its array"),
        ([Assign(STORE, STORE.shifted(-1))], {}, "outside of its array"),
        ([Assign(STORE, Literal(1.0))], {"index": "j"}, "no loop over i"),
        ([Assign(STORE, Literal(1.0))], {"end": J}, "no loop over j"),
        ([IfPresent(J, (Assign(STORE, Literal(1.0)),))], {}, "no loop over j"),
        ([For("i", 0, 2, (Assign(STORE, Literal(1.0)),))], {}, "two loops over i"),
        ([Assign(STORE, Element(Space.LOCAL, "nothing", I))], {}, "read before it is written"),
        ([Assign(Element(Space.NEXT, "filtered_state", I), Literal(1.0))], {}, "written twice"),
    ],
)
def test_a_loop_that_is_not_well_formed_is_refused(program, body, options, complaint):
    with pytest.raises(InternalError, match=complaint):
        verify(looped(program, body, **options))


def test_a_temporary_stays_in_its_loop(program):
    inside = Operate(fresh(program), Operator.NEG, (STORE,))
    longer = looped(program, [inside, Assign(STORE, inside.target)])
    verify(longer)
    outside = Assign(STORE.shifted(-1 * I), inside.target)
    with pytest.raises(InternalError, match="read outside its loop"):
        verify(with_update(longer, outside))


def test_operations_of_loops_count_as_often_as_they_run(program):
    inner = For("j", 0, I + 1, (Operate(fresh(program), Operator.NEG, (STORE,)),))
    longer = looped(program, [inner])
    assert longer.flops == program.flops + 6
    assert longer.statements == program.statements + 1


def test_results_may_be_written_by_loops(program):
    states = written(program, "filtered_state")
    store = Assign(Element(Space.NEXT, "filtered_state", I), Literal(1.0))
    shorter = with_update(program, without=states)
    verify(looped(shorter, [store], end=len(states)))
    with pytest.raises(InternalError, match="results never written"):
        verify(looped(shorter, [store], end=len(states) - 1))


@pytest.mark.parametrize(
    ("index", "text"),
    [
        (I, "i"),
        (3 * I + J - 2, "3 * i + j - 2"),
        (packed(I, J), "i * (i + 1) / 2 + j"),
        (packed(I + 1, J), "i + i * (i + 1) / 2 + j + 1"),
        (5 - 1 * I, "5 - i"),
    ],
)
def test_an_index_is_printed_as_it_counts(index, text):
    assert sorted(str(index).split(" + ")) == sorted(text.split(" + "))
    for i in range(4):
        for j in range(4):
            c = str(index).replace(" / ", " // ")
            assert eval(c, {"i": i, "j": j}) == index.at({"i": i, "j": j})  # noqa: S307
    assert I - I == 0
    assert packed(I + 1, 0) - packed(I, 0) == I + 1
