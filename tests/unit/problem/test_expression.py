"""The expression language: the same numbers as Python, and nothing but numbers."""

from __future__ import annotations

import copy
import math
import pickle

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fkgen.errors import SpecError
from fkgen.problem.table.place import Place
from fkgen.problem.text.expression import (
    MAX_DEPTH,
    Name,
    Number,
    Operation,
    depth,
    evaluate,
    names,
    parse,
    product,
    size,
    to_text,
    total,
)

VALUES = {"a": 0.7, "b": -1.3, "tau": 2.5}


def atan2(y: float, x: float) -> float:
    """Refuse zeros: the sign of a zero, which folding does not keep, would change the angle."""
    if y == 0.0 or x == 0.0:
        raise ArithmeticError
    return math.atan2(y, x)


def python_value(text: str) -> float | None:
    """Return what Python itself makes of the text, None where it is not finite and real."""
    functions = {key: getattr(math, key) for key in ("exp", "log", "sqrt", "sin", "cos", "tan")}
    scope = {"__builtins__": {}, "abs": abs, "atan2": atan2, **functions, **VALUES}
    try:
        value = eval(text, scope)  # noqa: S307 - text drawn by the strategy below
    except (ArithmeticError, ValueError):
        return None
    return value if isinstance(value, float) and math.isfinite(value) else None


FORMS = [
    *(f"({{0}} {operator} {{1}})" for operator in "+-*/"),
    *(f"{name}({{0}})" for name in ("exp", "log", "sqrt", "sin", "cos", "tan", "abs", "-", "+")),
    *(f"({{0}}) ** {exponent}.0" for exponent in range(-3, 4)),
    "atan2({0}, {1})",
]
LEAVES = st.one_of(
    st.sampled_from(sorted(VALUES)),
    st.floats(0, 1e6, allow_nan=False).map(repr),
    st.integers(0, 1000).map(lambda value: f"{value}.0"),
)
TEXTS = st.recursive(
    LEAVES,
    lambda inner: st.tuples(st.sampled_from(FORMS), inner, inner).map(
        lambda drawn: drawn[0].format(drawn[1], drawn[2])
    ),
)


@given(TEXTS)
def test_values_are_those_of_python(text: str) -> None:
    expected = python_value(text)
    try:
        value = evaluate(parse(text), VALUES)
    except (SpecError, ArithmeticError):
        assert expected is None
        return
    # Folding x * 0 may define what Python leaves undefined; it may not change a defined value.
    if expected is not None:
        assert value == pytest.approx(expected, rel=1e-13, abs=0.0)


@given(TEXTS)
def test_text_and_tree_are_the_same_thing(text: str) -> None:
    try:
        tree = parse(text)
    except SpecError:
        return
    assert parse(to_text(tree)) == tree


@pytest.mark.parametrize(
    ("text", "tree"),
    [
        ("2*3", Number(6.0)),
        ("-0.0", Number(0.0)),
        ("1_000", Number(1000.0)),
        ("tau*0", Number(0.0)),
        ("0*tau", Number(0.0)),
        ("tau*1", Name("tau")),
        ("1*tau", Name("tau")),
        ("tau+0", Name("tau")),
        ("0+tau", Name("tau")),
        ("tau-0", Name("tau")),
        ("tau/1", Name("tau")),
        ("tau**1", Name("tau")),
        ("--tau", Name("tau")),
        ("0-tau", Operation("neg", (Name("tau"),))),
        ("  tau\n + tau ", Operation("+", (Name("tau"), Name("tau")))),
        ("a-b", Operation("-", (Name("a"), Name("b")))),
        ("-a**2", Operation("neg", (Operation("**", (Name("a"), Number(2.0))),))),
        ("atan2(a, 2)", Operation("atan2", (Name("a"), Number(2.0)))),
        ("2**3**2", Number(512.0)),
        ("abs(-3)", Number(3.0)),
    ],
)
def test_trees_are_folded(text: str, tree: object) -> None:
    assert parse(text) == tree


INJECTIONS = [
    "__import__('os').system('true')",
    "().__class__",
    "tau.real",
    "tau[0]",
    "[tau]",
    "{tau}",
    "{'a': tau}",
    "(tau, tau)",
    "lambda: tau",
    "lambda x: x",
    "[x for x in tau]",
    "(x for x in tau)",
    "tau if tau else tau",
    "tau == tau",
    "tau < 1",
    "tau and tau",
    "not tau",
    "(tau := 1)",
    "'tau'",
    '"tau"',
    "f'{tau}'",
    "b'1'",
    "1j",
    "2.0J",
    "True",
    "None",
    "...",
    "tau // 2",
    "tau % 2",
    "tau @ tau",
    "tau << 1",
    "tau | 1",
    "~tau",
    "*tau",
    "exp(*tau)",
    "exp(x=tau)",
    "exp(tau, x=1)",
    "exp()",
    "exp(1, 2)",
    "atan2(1)",
    "exp",
    "exp + 1",
    "(exp)(1)(1)",
    "pow(2, 3)",
    "eval(tau)",
    "open(tau)",
    "await tau",
    "yield",
    "import os",
    "tau; tau",
    "tau = 1",
    "tau\\",
    "tau # comment",
    "tau\x00",
    "",
    "   ",
    "1or 2",
    "1 2",
    "tau(1)",
    "+",
    "((1)",
    "1)",
    "\uff45xp(1)",
    "1,",
    "0x1g",
    "09",
    "9**9**9",
    "9.0**9**9**9",
    "exp(1000)",
    "1e999",
    "1" * 400,
    "1" * 5000,
    "1/0",
    "1/(2-2)",
    "0**-1",
    "log(0)",
    "log(-1)",
    "sqrt(-1)",
    "(-8)**(1/3)",
    "0*log(-1)",
    "1e200*1e200",
    "(" * 10_000 + "1" + ")" * 10_000,
    "(" * 150 + "1" + ")" * 150,
    "-" * 9_000 + "1",
    "1" + "+1" * 4_000,
    "1" + "**1" * 3_000,
    "exp(" * 150 + "1" + ")" * 150,
    "1" * 20_000,
]


@pytest.mark.parametrize("text", INJECTIONS, ids=lambda text: ascii(text[:20]))
def test_anything_else_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(SpecError) as caught:
        parse(text, place=Place("x.toml", "model.A[0][1]"), parameters=["tau"])
    error = caught.value
    assert error.key == "model.A[0][1]"
    assert error.file == "x.toml"
    assert len(error.given) <= 70
    assert error.__cause__ is None
    assert error.__suppress_context__ or error.__context__ is None
    message = str(error)
    assert len(message.splitlines()) == 1
    assert message.isprintable()
    assert repr(text)[:20] in message


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("taw", "parameters (tau), not the name 'taw'; did you mean 'tau'?"),
        ("sinn(1)", "not 'sinn'; did you mean 'sin'?"),
        ("exp(1, 2)", "1 argument of 'exp', not 2"),
        ("atan2(1)", "2 arguments of 'atan2', not 1"),
        ("exp", "arguments in parentheses after the function 'exp'"),
        ("1/0", "division by zero"),
        ("log(-1)", "log(-1.0) is not a real number"),
        ("exp(1000)", "exp(1000.0) is too large"),
        ("tau.x", "attribute access"),
        ("tau[0]", "without '['"),
        ("exp(x=tau)", "without '='"),
        ("tau // 2", "the operator //"),
        ("(" * 150, "100 levels"),
        ("1" * 20_000, "at most 10000 characters, not 20000"),
    ],
)
def test_the_message_says_what_is_wrong(text: str, expected: str) -> None:
    with pytest.raises(SpecError) as caught:
        parse(text, parameters={"tau": 1.0})
    assert expected in caught.value.expected


def test_a_spec_without_parameters_says_so() -> None:
    with pytest.raises(SpecError, match=r"no name 'tau': the spec has no \[parameters\]"):
        parse("tau", parameters={})


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("1/a", "division by zero in 1.0 / 0.0"),
        ("log(a)", "log"),
        ("sqrt(a - 1)", "not a real number"),
        ("exp(1e9 + a)", "too large"),
        ("a**-1", "not a real number"),
    ],
)
def test_undefined_values_raise(text: str, fault: str) -> None:
    with pytest.raises(ArithmeticError, match=fault):
        evaluate(parse(text), {"a": 0.0})


def test_names_are_the_parameters_used() -> None:
    assert names(parse("a*exp(b/tau) + a")) == {"a", "b", "tau"}
    assert names(parse("2*3")) == frozenset()


def test_sums_and_products_are_shallow() -> None:
    terms = [Name(f"x{index}") for index in range(1000)]
    assert depth(total(terms)) == 11
    assert depth(product(terms)) == 11
    assert size(total(terms)) == 1999
    assert total([]) == Number(0.0)
    assert product([]) == Number(1.0)


def test_the_deepest_tree_can_be_copied_and_pickled() -> None:
    tree = parse("a" + "+a" * (MAX_DEPTH - 1))
    assert depth(tree) == MAX_DEPTH
    assert pickle.loads(pickle.dumps(tree)) == tree  # noqa: S301 - our own bytes
    assert copy.deepcopy(tree) == tree
    assert hash(tree) == hash(parse(to_text(tree)))
