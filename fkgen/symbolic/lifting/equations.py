"""f and h of a plant as CasADi expressions of the state, with their derivatives.

Errors of the state are vectors of ne numbers: differences, but for an attitude q the rotation
vector d of the true one, q * exp(d). A derivative is that of the error of a result by the error of
the state. The entries of a rotation matrix R(q) count as numbers of their own, since
R(q * exp(d)) = R(q) exp(d x): their derivatives are entries of R(q) again.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import casadi as ca

from fkgen.problem.equations import Equations, Increment, trees_of
from fkgen.problem.functions.affine import affine_parts
from fkgen.problem.signals import Signal
from fkgen.problem.text.expression import Expression, decisive
from fkgen.symbolic.lifting import rotations
from fkgen.symbolic.lifting.expressions import lift_expression
from fkgen.symbolic.linalg import column, reduced, sparse

_ROTATION = re.compile(r"(?P<q>.+)\.R:(?P<i>[0-2])(?P<j>[0-2])")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lifted:
    """x[k+1] = f(x, u, w) and y = h(x, u) over symbols, w = 0 wherever it is not named."""

    x: ca.SX  # x, u: (n, 1), (q, 1), symbols
    u: ca.SX
    w: ca.SX  # (r, 1), symbols of the noises that enter through f
    stirred: ca.SX  # (n, 1), f with these noises
    moved: ca.SX  # (n, 1), f
    seen: ca.SX  # (p, 1), h
    A: ca.SX  # A, B, G: (ne, ne), (ne, q), (ne, r), of f by x, u and w
    B: ca.SX
    G: ca.SX
    C: ca.SX  # C, D: (p, ne), (p, q), of h by x and u
    D: ca.SX
    variances: ca.SX  # (r, 1), of w
    #: What f and what h decides by, columns: a comparison with NaN would be false, and tell nobody
    moved_by: ca.SX
    seen_by: ca.SX
    attitudes: tuple[int, ...]  # where quaternions begin in x
    angles: tuple[int, ...]  # numbers of errors that are differences of angles
    wraps: tuple[int, ...]  # rows of y that are angles
    #: plain: of f and h, whether it is affine in states, inputs and noises, and nothing wraps
    plain: tuple[bool, bool]


def lift_equations(
    equations: Equations,
    parameters: Mapping[str, ca.SX],
    signals: tuple[Sequence[Signal], Sequence[Signal]],
    like: Lifted | None = None,
) -> Lifted:
    """The equations of a plant with these states and outputs; over the symbols of another one."""
    return _Lifting(equations, parameters, like).lifted(*signals)


def places(n: int, attitudes: Sequence[int]) -> list[tuple[int, int, bool]]:
    """Where each part of x begins in x and in errors, and whether it is an attitude."""
    found = []
    at = error = 0
    while at < n:
        turns = at in attitudes
        found.append((at, error, turns))
        at, error = (at + 4, error + 3) if turns else (at + 1, error + 1)
    return found


class _Lifting:
    """Builder of the expressions."""

    def __init__(
        self, equations: Equations, parameters: Mapping[str, ca.SX], like: Lifted | None
    ) -> None:
        self.equations = equations
        self.x = ca.SX.sym("x", len(equations.states)) if like is None else like.x
        self.u = ca.SX.sym("u", len(equations.inputs)) if like is None else like.u
        self.w = ca.SX.sym("w", len(equations.noises))
        self.values = dict(parameters)
        for symbols, own in (
            (self.x, equations.states),
            (self.u, equations.inputs),
            (self.w, [noise.name for noise in equations.noises]),
        ):
            self.values |= dict(zip(own, ca.vertsplit(symbols) if own else [], strict=True))
        self.tangent = tangent_of(self.x, equations.attitudes)
        #: Entries of rotation matrices: their symbols, values and derivatives by errors
        self.entries: list[tuple[ca.SX, ca.SX, ca.SX]] = []
        self._define()

    def _define(self) -> None:
        matrices: dict[str, ca.SX] = {}
        for name, tree in self.equations.let:
            value = lift_expression(tree, self.values)
            found = _ROTATION.fullmatch(name)
            if found is not None and f"{found['q']}[0]" in self.equations.states:
                matrices.setdefault(found["q"], ca.SX.sym(f"R_{found['q']}", 3, 3))
                symbol = matrices[found["q"]][int(found["i"]), int(found["j"])]
                at = self.equations.states.index(f"{found['q']}[0]")
                derivative = self._of_entry(matrices[found["q"]], at, found)
                self.entries.append((symbol, value, derivative))
                value = symbol
            self.values[name] = value

    def _of_entry(self, R: ca.SX, at: int, found: re.Match[str]) -> ca.SX:
        """The derivative of an entry of R by errors: R exp(d x) = R + R (d x) + ..."""
        i, j = int(found["i"]), int(found["j"])
        row = ca.SX(1, self.tangent.shape[1])
        error = next(e for a, e, _ in places(self.x.numel(), self.equations.attitudes) if a == at)
        after, before = (j + 1) % 3, (j + 2) % 3
        row[0, error + before] = R[i, after]
        row[0, error + after] = -R[i, before]
        return row

    def lifted(self, states: Sequence[Signal], outputs: Sequence[Signal]) -> Lifted:
        """Everything, at w = 0."""
        equations = self.equations
        seen = column([lift_expression(tree, self.values) for tree in equations.h])
        moved, A, B, G = self._motion()
        stirred = sparse(self._written_out(moved))
        found = [moved, seen, A, B, G, self._by_state(seen), ca.jacobian(seen, self.u)]
        found += [self._decisions(equations.for_f, trees_of(equations.f))]
        found += [self._decisions(equations.for_h, equations.h)]
        moved, seen, A, B, G, C, D, moved_by, seen_by = map(self._without_noise, found)
        parts = places(self.x.numel(), equations.attitudes)
        variances = [lift_expression(noise.variance, self.values) for noise in equations.noises]
        if equations.period is not None:  # noises are held over a sample, and stated as densities
            period = lift_expression(equations.period, self.values)
            variances = [each / period for each in variances]
        angles = tuple(e for (_, e, _), s in zip(parts, states, strict=True) if s.wrap)
        wraps = tuple(i for i, signal in enumerate(outputs) if signal.wrap)
        affine = affine_parts(equations)
        return Lifted(
            x=self.x,
            u=self.u,
            w=self.w,
            stirred=stirred,
            moved=moved,
            seen=seen,
            A=A,
            B=B,
            G=G,
            C=C,
            D=D,
            variances=column(variances),
            moved_by=moved_by,
            seen_by=seen_by,
            attitudes=equations.attitudes,
            angles=angles,
            wraps=wraps,
            plain=(affine[0] and not angles, affine[1] and not wraps),
        )

    def _decisions(
        self, let: Sequence[tuple[str, Expression]], trees: Sequence[Expression]
    ) -> ca.SX:
        """What trees decide by, but for what is a number of x, u or the parameters."""
        known = dict.fromkeys(e for tree in (*(t for _, t in let), *trees) for e in decisive(tree))
        values = [lift_expression(each, self.values) for each in known]
        return column([each for each in values if not (each.is_constant() or each.is_leaf())])

    def _without_noise(self, value: ca.SX) -> ca.SX:
        """A value at w = 0, its entries of R written out."""
        (value,) = ca.substitute([value], [self.w], [ca.SX.zeros(self.w.shape)])
        return sparse(self._written_out(value))

    def _written_out(self, value: ca.SX) -> ca.SX:
        if not self.entries:
            return value
        symbols, values, _ = zip(*self.entries, strict=True)
        (found,) = ca.substitute([value], [ca.vertcat(*symbols)], [ca.vertcat(*values)])
        return found

    def _by_state(self, value: ca.SX) -> ca.SX:
        """The derivative by errors of the state."""
        found = ca.jacobian(value, self.x) @ self.tangent
        for symbol, _, derivative in self.entries:
            found += ca.jacobian(value, symbol) @ derivative
        return sparse(found)

    def _motion(self) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        """F and its derivatives by x, u and w."""
        equations = self.equations
        stated = [
            column([lift_expression(part, self.values) for part in each.by])
            if isinstance(each, Increment)
            else lift_expression(each, self.values)
            for each in equations.f
        ]
        if equations.period is None:
            return self._jumped(stated)
        rates = self._written_out(ca.vertcat(*stated))
        moved = self._integrated(rates, lift_expression(equations.period, self.values))
        by = [ca.jacobian(moved, self.x) @ self.tangent]
        by += [ca.jacobian(moved, each) for each in (self.u, self.w)]
        pulled = cotangent_of(moved, equations.attitudes)
        A, B, G = (sparse(pulled @ each) for each in by)
        return normalised(moved, equations.attitudes), A, B, G

    def _jumped(self, stated: list[ca.SX]) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        """The same from sample to sample: an increment turns the errors by itself."""
        moved: list[ca.SX] = []
        rows: list[list[ca.SX]] = []
        values, turning = iter(stated), self.equations.turning
        for at, error, turns in places(self.x.numel(), self.equations.attitudes):
            if not turns:
                moved.append(next(values))
                rows.append(self._derivatives(moved[-1]))
            elif at in turning:
                by = next(values)
                turn = rotations.exponential(by)
                moved.append(rotations.renewed(rotations.product(self.x[at : at + 4], turn)))
                J = rotations.right_jacobian(by)
                own = [J @ each for each in self._derivatives(by)]
                own[0][:, error : error + 3] += rotations.matrix(turn).T
                rows.append(own)
            else:
                q = ca.vertcat(*(next(values) for _ in range(4)))
                length = ca.norm_2(q)
                pull = rotations.pulled(q / length) / length
                moved.append(rotations.normalised(q))
                rows.append([pull @ each for each in self._derivatives(q)])
        A, B, G = (ca.vertcat(*each) for each in zip(*rows, strict=True))
        return ca.vertcat(*moved), A, B, G

    def _derivatives(self, value: ca.SX) -> list[ca.SX]:
        return [self._by_state(value), *(ca.jacobian(value, each) for each in (self.u, self.w))]

    def _integrated(self, rates: ca.SX, period: ca.SX) -> ca.SX:
        """The state one sample later, quaternions not yet normalised."""
        equations, state = self.equations, self.x
        step = period / equations.substeps

        def at(x: ca.SX) -> ca.SX:
            return ca.substitute([rates], [self.x], [x])[0]

        for _ in range(equations.substeps):
            slope = at(state)
            if equations.integrator == "rk4":
                k1 = slope
                k2 = at(self._applied(state, k1, step / 2))
                k3 = at(self._applied(state, k2, step / 2))
                k4 = at(self._applied(state, k3, step))
                slope = (k1 + 2 * k2 + 2 * k3 + k4) / 6
            state = self._applied(state, slope, step)
        return state

    def _applied(self, x: ca.SX, rates: ca.SX, step: ca.SX) -> ca.SX:
        """The state that rates lead to."""
        exponential = rotations.smooth_exponential
        return box_plus(x, step * rates, self.equations.attitudes, exponential)


def box_plus(
    x: ca.SX,
    errors: ca.SX,
    attitudes: Sequence[int],
    exponential: Callable[[ca.SX], ca.SX] = rotations.exponential,
) -> ca.SX:
    """The state that lies off by errors, quaternions not normalised."""
    if not attitudes:
        return x + errors
    parts = []
    for at, error, turns in places(x.numel(), attitudes):
        if turns:
            turn = exponential(errors[error : error + 3])
            parts.append(rotations.product(x[at : at + 4], turn))
        else:
            parts.append(x[at] + errors[error])
    return ca.vertcat(*parts)


def shifted(x: ca.SX, errors: ca.SX, attitudes: Sequence[int]) -> ca.SX:
    """The same with unit quaternions whose w is not negative."""
    found = box_plus(x, errors, attitudes)
    for at in attitudes:
        found[at : at + 4] = rotations.renewed(found[at : at + 4])
    return found


def box_minus(x: ca.SX, origin: ca.SX, lifted: Lifted) -> ca.SX:
    """The errors by which one state lies off another, of angles the shortest."""
    parts = []
    for at, error, turns in places(x.numel(), lifted.attitudes):
        if turns:
            q, p = (each[at : at + 4] for each in (origin, x))
            parts.append(rotations.logarithm(rotations.product(rotations.conjugate(q), p)))
        else:
            apart = x[at] - origin[at]
            parts.append(reduced(apart) if error in lifted.angles else apart)
    return ca.vertcat(*parts)


def turned_by(attitudes: Sequence[int], errors: ca.SX, *, back: bool = False) -> ca.SX:
    """By what small errors turn when a state moves by errors that are not small, (ne, ne)."""
    ne = errors.numel()
    turn = ca.SX.eye(ne)
    jacobian = rotations.inverse_right_jacobian if back else rotations.right_jacobian
    for _, at, turns in places(ne + len(attitudes), attitudes):
        if turns:
            turn[at : at + 3, at : at + 3] = jacobian(errors[at : at + 3])
    return turn


def normalised(x: ca.SX, attitudes: Sequence[int]) -> ca.SX:
    """The same state with unit quaternions whose w is not negative."""
    found = ca.SX(x)
    for at in attitudes:
        found[at : at + 4] = rotations.normalised(x[at : at + 4])
    return found


def tangent_of(x: ca.SX, attitudes: Sequence[int]) -> ca.SX:
    """The derivative of box-plus by errors, (n, ne)."""
    n = x.numel()
    found = ca.SX(n, n - len(attitudes))
    for at, error, turns in places(n, attitudes):
        if turns:
            found[at : at + 4, error : error + 3] = rotations.pushed(x[at : at + 4])
        else:
            found[at, error] = 1
    return found


def cotangent_of(x: ca.SX, attitudes: Sequence[int]) -> ca.SX:
    """The derivative of errors by a state near x, (ne, n)."""
    n = x.numel()
    found = ca.SX(n - len(attitudes), n)
    for at, error, turns in places(n, attitudes):
        if turns:
            found[error : error + 3, at : at + 4] = rotations.pulled(x[at : at + 4])
        else:
            found[error, at] = 1
    return found
