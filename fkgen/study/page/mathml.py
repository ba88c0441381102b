"""Expressions and matrices as presentation MathML, in the words of the spec.

Printed from the syntax tree of what was written: SymPy would put terms into an order of its own.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Sequence
from html import escape
from unicodedata import lookup

from fkgen.problem.text.expression import ZERO, Expression, Unfit, syntax, to_text
from fkgen.problem.text.matrix import Matrix

#: Rows or columns of a matrix that is written out; of one that is a list of numbers, from and to.
LARGEST, SHORT, LONGEST = 12, 4, 24
_GREEK = (
    *("alpha", "beta", "gamma", "delta", "epsilon", "zeta", "eta", "theta", "iota", "kappa"),
    *("lambda", "mu", "nu", "xi", "pi", "rho", "sigma", "tau", "upsilon", "phi", "chi", "psi"),
    "omega",
)
_LETTERS = {
    name: lookup(f"GREEK SMALL LETTER {name.replace('lambda', 'lamda')}") for name in _GREEK
}
_MINUS, _TIMES, _DOT = "\N{MINUS SIGN}", "\N{MULTIPLICATION SIGN}", "\N{MIDDLE DOT}"
_APPLIED, _BLANK = "\N{FUNCTION APPLICATION}", "\N{NO-BREAK SPACE}"
_SIGNS = {ast.Lt: "&lt;", ast.Gt: "&gt;", ast.Eq: "=", ast.NotEq: "\N{NOT EQUAL TO}"}
_SIGNS |= {ast.LtE: "\N{LESS-THAN OR EQUAL TO}", ast.GtE: "\N{GREATER-THAN OR EQUAL TO}"}
#: What expressions and equations are written with.
_WRITTEN = re.compile(r"[A-Za-z0-9_.,+\-*/()<>=!\"'\[\] ]")
EQUALS, PLUS, COMMA = "<mo>=</mo>", "<mo>+</mo>", "<mo>,</mo>"
#: How strongly what stands between binds.
_SUM, _PRODUCT, _SIGN, _POWER, _ATOM = range(1, 6)


def display(*parts: str) -> str:
    """A formula on a line of its own."""
    return f'<math display="block"><mrow>{"".join(parts)}</mrow></math>'


def name(identifier: str) -> str:
    """A name; what follows the first underscore is an index."""
    base, _, index = identifier.partition("_")
    shown = [f"<mi>{_LETTERS.get(part, escape(part))}</mi>" for part in (base, index) if part]
    return f"<msub>{''.join(shown)}</msub>" if len(shown) == 2 else shown[0]


def number(value: float) -> str:
    """A number to twelve digits; a large or small one with a power of ten."""
    text = f"{value:.12g}"
    if text.startswith("-"):
        return f"<mrow><mo>{_MINUS}</mo>{number(-value)}</mrow>"
    digits, _, exponent = text.partition("e")
    if not exponent:
        return f"<mn>{text}</mn>"
    raised = f"<mn>{abs(int(exponent))}</mn>"
    raised = f"<mrow><mo>{_MINUS}</mo>{raised}</mrow>" if exponent.startswith("-") else raised
    power = f"<msup><mn>10</mn>{raised}</msup>"
    return power if digits == "1" else f"<mrow><mn>{digits}</mn><mo>{_DOT}</mo>{power}</mrow>"


def written(text: str) -> str:
    """An expression that was written; as plain text if it cannot be read."""
    try:
        return _printed(syntax(text, _WRITTEN), 0)
    except (Unfit, KeyError, RecursionError):
        return f"<mtext>{escape(text)}</mtext>"


def expression(tree: Expression) -> str:
    """An entry of a matrix."""
    return written(to_text(tree))


def matrix(letter: str, value: Matrix) -> str:
    """``letter = matrix``, or its size where it is large."""
    rows, columns = value.shape
    if value.is_zero and rows * columns > 1:
        shown = f"<msub><mn>0</mn>{_size(rows, columns)}</msub>"
    elif columns == 1 and SHORT < rows <= LONGEST:
        shown = f"<msup>{_listed(row[0] for row in value.rows)}<mi>T</mi></msup>"
    elif SHORT < rows <= LONGEST and _is_diagonal(value):
        shown = f"<mi>diag</mi>{_listed(row[i] for i, row in enumerate(value.rows))}"
    elif max(rows, columns) > LARGEST:
        shown = f"<mtext>a matrix of{_BLANK}</mtext>{_size(rows, columns)}"
    else:
        cells = ("".join(f"<mtd>{expression(each)}</mtd>" for each in row) for row in value.rows)
        shown = _bracketed("".join(f"<mtr>{row}</mtr>" for row in cells))
    return f"{indexed(letter)}<mo>=</mo>{shown}"


def _is_diagonal(value: Matrix) -> bool:
    above = (each for i, row in enumerate(value.rows) for j, each in enumerate(row) if i != j)
    return value.shape[0] == value.shape[1] and all(each == ZERO for each in above)


def _listed(entries: Iterable[Expression]) -> str:
    return _round(COMMA.join(map(expression, entries)))


def indexed(letter: str) -> str:
    """A letter of a matrix with its number, such as P0."""
    return (
        f"<msub><mi>{letter[0]}</mi><mn>{letter[1:]}</mn></msub>"
        if letter[1:]
        else (f"<mi>{letter}</mi>")
    )


def at(letter: str, index: str) -> str:
    """A letter at a sample, such as x at k+1; without an index the letter."""
    parts = [
        f"<mi>{each}</mi>" if each.isalpha() else f"<mn>{each}</mn>"
        for each in re.findall("[a-z]|[0-9]", index)
    ]
    if not parts:
        return f"<mi>{letter}</mi>"
    return f"<msub><mi>{letter}</mi><mrow>{'<mo>+</mo>'.join(parts)}</mrow></msub>"


def start(letter: str) -> str:
    """A letter at sample 0, before anything is measured."""
    return f"<mrow><mi>{letter}</mi>{_round('<mn>0</mn>')}</mrow>"


def rate(letter: str) -> str:
    """The derivative of a letter by time."""
    return later(f"<mi>{letter}</mi>", continuous=True)


def later(of: str, continuous: bool) -> str:  # noqa: FBT001 - one of two
    """What is stated of a state: its derivative, or its value at the next sample."""
    if continuous:
        return f"<mfrac><mrow><mi>d</mi>{of}</mrow><mrow><mi>d</mi><mi>t</mi></mrow></mfrac>"
    return f"<msup>{of}<mo>+</mo></msup>"


def sum_of(terms: Sequence[tuple[str, str, str]]) -> str:
    """Products of a matrix and a letter at a sample, added up."""
    shown = (
        f"{f'<mi>{matrix}</mi>' if matrix else ''}{at(letter, k)}" for matrix, letter, k in terms
    )
    return PLUS.join(shown)


def normal(of: str, covariance: str, mean: str = "") -> tuple[str, ...]:
    """The mean and the covariance, letters or MathML, of what is random."""
    centre, spread = (
        each if each.startswith("<") else indexed(each)
        for each in (mean or "<mn>0</mn>", covariance)
    )
    return of, "<mo>~</mo>", _round(f"{centre}{COMMA}{spread}")


def _size(rows: int, columns: int) -> str:
    return f"<mrow><mn>{rows}</mn><mo>{_TIMES}</mo><mn>{columns}</mn></mrow>"


def _bracketed(rows: str) -> str:
    return f'<mtable class="matrix" displaystyle="true">{rows}</mtable>'


def _round(inner: str) -> str:
    return f"<mrow><mo>(</mo>{inner}<mo>)</mo></mrow>"


def _printed(node: ast.expr, within: int) -> str:
    """A tree, in parentheses where it binds less strongly than what it stands in."""
    text, strength = _formula(node)
    return text if strength >= within else _round(text)


def _formula(node: ast.expr) -> tuple[str, int]:  # noqa: PLR0911 - one per node
    """MathML of a tree and how strongly it binds."""
    match node:
        case ast.Constant(int() | float() as value):
            return number(float(value)), _ATOM
        case ast.Name(identifier):
            return name(identifier), _ATOM
        case ast.UnaryOp(ast.USub(), operand):
            return f"<mrow><mo>{_MINUS}</mo>{_printed(operand, _PRODUCT)}</mrow>", _SUM
        case ast.UnaryOp(_, operand):
            return _formula(operand)
        case ast.BinOp(left, operator, right):
            return _binary(left, operator, right)
        case ast.Compare(left, [sign], [right]):
            both = _printed(left, _SUM), _printed(right, _SUM)
            return f"<mrow>{both[0]}<mo>{_SIGNS[type(sign)]}</mo>{both[1]}</mrow>", 0
        case ast.Call(ast.Name(function), arguments):
            return _called(function, arguments), _ATOM
        case ast.List(entries):
            inner = "".join(f"<mtr><mtd>{_printed(each, 0)}</mtd></mtr>" for each in entries)
            return _bracketed(inner), _ATOM
        case ast.Subscript(value, at):
            return f"<msub>{_printed(value, _ATOM)}{_printed(at, 0)}</msub>", _ATOM
    raise KeyError(type(node).__name__)


def _binary(left: ast.expr, operator: ast.operator, right: ast.expr) -> tuple[str, int]:
    match operator:
        case ast.Add() | ast.Sub():
            sign = "+" if isinstance(operator, ast.Add) else _MINUS
            after = _printed(right, _SUM + (sign != "+"))
            after = _round(after) if isinstance(right, ast.UnaryOp) else after
            return f"<mrow>{_printed(left, _SUM)}<mo>{sign}</mo>{after}</mrow>", _SUM
        case ast.Mult():
            both = _printed(left, _PRODUCT), _printed(right, _PRODUCT)
            dot = (
                f"<mo>{_DOT}</mo>"
                if both[1].startswith("<mn>")
                else '<mspace width="0.17em"></mspace>'
            )
            return f"<mrow>{dot.join(both)}</mrow>", _PRODUCT
        case ast.Div():
            return f"<mfrac>{_printed(left, 0)}{_printed(right, 0)}</mfrac>", _PRODUCT
        case ast.Pow():
            return f"<msup>{_printed(left, _ATOM)}{_printed(right, 0)}</msup>", _POWER
    raise KeyError(type(operator).__name__)


def _called(function: str, arguments: list[ast.expr]) -> str:
    shown = [_printed(each, 0) for each in arguments]
    if function == "sqrt":
        return f"<msqrt>{shown[0]}</msqrt>"
    if function == "abs":
        return f"<mrow><mo>|</mo>{shown[0]}<mo>|</mo></mrow>"
    head = f"<mi>{escape(function.rstrip(_DOT))}</mi><mo>{_APPLIED}</mo>"
    return f"<mrow>{head}{_round('<mo>,</mo>'.join(shown))}</mrow>"
