"""The expression language: the same numbers as Python, and nothing but numbers."""

from __future__ import annotations

import copy
import math
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import PchipInterpolator

from fkgen.errors import SpecError
from fkgen.problem.table.place import Place
from fkgen.problem.text.expression import (
    MAX_DEPTH,
    Name,
    Number,
    Operation,
    Scope,
    decisive,
    depth,
    evaluate,
    names,
    parse,
    product,
    size,
    to_text,
    total,
)
from fkgen.problem.text.lookup import Table

VALUES = {"a": 0.7, "b": -1.3, "tau": 2.5}


def atan2(y: float, x: float) -> float:
    """Refuse zeros: the sign of a zero, which folding does not keep, would change the angle."""
    if y == 0.0 or x == 0.0:
        raise ArithmeticError
    return math.atan2(y, x)


OF_ONE = ("exp", "log", "sqrt", "sin", "cos", "tan", "asin", "acos", "sinh", "cosh", "tanh")


def sign(x: float) -> float:
    return float(bool(x)) if x >= 0.0 else -1.0


def python_value(text: str) -> float | None:
    """Return what Python itself makes of the text, None where it is not finite and real."""
    functions = {key: getattr(math, key) for key in (*OF_ONE, "hypot", "pi")}
    own = {"abs": abs, "min": min, "max": max, "atan2": atan2, "sign": sign}
    scope = {"__builtins__": {}, **own, **functions, **VALUES}
    try:
        value = eval(text, scope)  # noqa: S307 - text drawn by the strategy below
    except (ArithmeticError, ValueError):
        return None
    value = float(value) if isinstance(value, int) else value
    return value if isinstance(value, float) and math.isfinite(value) else None


FORMS = [
    *(f"({{0}} {operator} {{1}})" for operator in "+-*/"),
    *(f"{name}({{0}})" for name in (*OF_ONE, "abs", "sign", "-", "+")),
    *(f"{name}({{0}}, {{1}})" for name in ("min", "max", "hypot")),
    *(f"({{0}} {relation} {{1}})" for relation in ("<", "<=", ">", ">=", "==", "!=")),
    "(pi * {0})",
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
        ("2*pi", Number(2.0 * math.pi)),
        ("if(1 < 2, tau, 1/0)", Name("tau")),
        ("if(2 < 1, 1/0, tau)", Name("tau")),
        ("if (0, 1/0, tau)", Name("tau")),
        ("(1 < 2) + (2 < 1)", Number(1.0)),
        ("a >= b", Operation(">=", (Name("a"), Name("b")))),
        ("0 < a < b", product([parse("0 < a"), parse("a < b")])),
        ("if(a, b, tau)", Operation("if", (Name("a"), Name("b"), Name("tau")))),
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
    "tau in tau",
    "tau is tau",
    "tau < 1 is 1",
    "if(tau, tau)",
    "if + 1",
    "if(1 < 2, taw, 1)",
    "if(1 < 2, 1, taw)",
    "if(tau, 1/0, 1)",
    "asin(2)",
    "min(1, 2, 3)",
    "interp(tau)",
    "interp(tau, tau)",
    "interp(tau, 'drag')",
    "pi(1)",
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
        ("exp(x=tau)", "without a keyword argument"),
        ("min(tau)", "2 arguments of 'min', not 1"),
        ("tau and 1", "a product of comparisons"),
        ("1 if tau else 2", "if(condition, a, b) is ours"),
        ("asin(2)", "asin(2.0) is not a real number"),
        ("if(tau, log(-1), 2)", "log(-1.0) is not a real number"),
        ("if(1 < 2, 1, taw)", "not the name 'taw'"),
        ("interp(tau, 'drag')", "of which the spec has none"),
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


LINE = Table("line", (0.0, 1.0, 3.0), (1.0, 2.0, -2.0))
CURVE = Table("curve", (0.0, 1.0, 3.0, 4.0), (1.0, 2.0, 2.5, 0.0), "pchip")
TABLES = Scope(VALUES, (LINE, CURVE))


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("if(a > 0, 1/a, log(a))", 1.0 / 0.7),
        ("if(b > 0, log(b), -b)", 1.3),
        ("if(a - a, 1, 2)", 2.0),
        ("if(a == 0.7, if(b != 0, 3, 4), 5)", 3.0),
        ("interp(a, 'line')", 1.7),
        ('interp(tau, "line")', -1.0),
        ("interp(b, 'line')", 1.0),
        ("interp(tau + 1, 'line') + interp(4, 'curve')", -2.0),
        ("interp(1, 'line') + interp(3, 'curve')", 4.5),
    ],
)
def test_only_the_branch_that_is_taken_needs_a_value(text: str, value: float) -> None:
    tree = parse(text, parameters=TABLES)
    assert evaluate(tree, VALUES) == pytest.approx(value, rel=1e-15)
    assert parse(to_text(tree), parameters=TABLES) == tree


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("interp(a, 'lime')", "('line', 'curve') as second argument of 'interp', not 'lime'; did"),
        ("interp(a, line)", "write it as 'line', in quotes"),
        ("interp(a, 3)", "in quotes"),
        ("interp(a)", "2 arguments of 'interp', not 1"),
    ],
)
def test_a_table_is_named_in_quotes(text: str, expected: str) -> None:
    with pytest.raises(SpecError) as caught:
        parse(text, parameters=TABLES)
    assert expected in caught.value.expected


def test_tables_go_through_their_points_as_those_of_numpy_and_scipy() -> None:
    rng = np.random.default_rng(8)
    for _ in range(40):
        x = np.cumsum(rng.uniform(0.1, 3.0, rng.integers(2, 9)))
        y = np.round(rng.normal(size=x.size), 1)  # flat pieces and turns among them
        at = np.concatenate([x, rng.uniform(x[0] - 1.0, x[-1] + 1.0, 50)])
        curve = PchipInterpolator(x, y)(np.clip(at, x[0], x[-1]))
        for kind, expected in (("linear", np.interp(at, x, y)), ("pchip", curve)):
            table = Table("t", tuple(x.tolist()), tuple(y.tolist()), kind)
            found = [table.value(float(each)) for each in at]
            # y is of order 3, and a few roundings of what it is made of
            np.testing.assert_allclose(found, expected, atol=1e-13, rtol=0.0)


def test_what_an_expression_decides_by_is_nothing_where_it_is_not_reached() -> None:
    tree = parse("if(a > 0, min(log(a), 2), interp(b, 'line'))", parameters=TABLES)
    reached = "if(a > 0.0, log(a), 0.0)", "if(a > 0.0, 0.0, b)"
    assert [to_text(each) for each in decisive(tree)] == ["a", *reached]
    assert not list(decisive(parse("exp(a) / b + hypot(a, b)")))


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
