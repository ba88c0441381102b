"""Which products are rounded together with the sum they go into.

One rule: a product that one sum or difference uses, and nothing else, becomes part of it. Where
both sides are such products the right one does, so that a sum of products in ascending order is a
chain that begins with a product: fma(c, d, a b). The rule looks at the whole filter, before ports
are left out: the bits of those that stay do not depend on it. Sums of products of matrices are such
chains already.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

from fkgen.backend import ir
from fkgen.backend.ir import Operate, Operator, Temp
from fkgen.backend.size.selection import chunks_of, with_chunks

#: What a sum or a difference becomes where the product is on its right, and on its left.
_WITH_PRODUCT = {
    Operator.ADD: (Operator.FMA, Operator.FMA),
    Operator.SUB: (Operator.FNMA, Operator.FMS),
}


def fused(phase: ir.Phase) -> ir.Phase:
    """The phase with fused multiply-adds in place of products and sums."""
    uses = Counter(ir.read(Temp, phase.body))
    chunks = [(section, _fused(body, uses)) for section, body in chunks_of(phase)]
    return with_chunks(phase, chunks)


def _fused(body: ir.Body, uses: Counter[Temp]) -> ir.Body:
    """Statements; a product moves on to its sum only where nothing is stored on the way."""
    nodes: list[ir.Statement] = []
    products: dict[ir.Operand, Operate] = {}
    taken: set[Temp] = set()
    for each in body:
        node = each
        if isinstance(node, ir.Nested):
            node = replace(node, body=_fused(node.body, uses))
        elif isinstance(node, ir.Product):
            node = replace(node, fused=True)
        if isinstance(node, ir.Nested | ir.OfMatrices | ir.Assign):
            products.clear()
        elif isinstance(node, Operate):
            if node.operator is Operator.MUL and uses[node.target] == 1:
                products[node.target] = node
            elif (product := _product(node, products)) is not None:
                node = _with(node, product)
                taken.add(product.target)
        nodes.append(node)
    return tuple(n for n in nodes if not (isinstance(n, Operate) and n.target in taken))


def _product(node: Operate, products: dict[ir.Operand, Operate]) -> Operate | None:
    """The product that a sum or a difference takes in, if there is one."""
    if node.operator not in _WITH_PRODUCT:
        return None
    return next((products[each] for each in reversed(node.arguments) if each in products), None)


def _with(node: Operate, product: Operate) -> Operate:
    """A sum or difference with one of its sides computed in it."""
    left, right = node.arguments
    on_right, on_left = _WITH_PRODUCT[node.operator]
    operator, other = (on_right, left) if right == product.target else (on_left, right)
    return Operate(node.target, operator, (*product.arguments, other))
