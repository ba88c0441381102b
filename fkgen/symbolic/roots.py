"""Roots of covariances on CasADi matrices: what turns independent normal numbers into noise."""

from __future__ import annotations

import casadi as ca

from fkgen.symbolic.linalg import is_zero, sparse

#: A pivot below this share of its diagonal entry is the rounding of a zero.
NEGLIGIBLE = 1e-14
#: Keeps the quotient of two zeros at zero.
_TINY = 1e-300


def lower_root(covariance: ca.SX) -> ca.SX:
    """Lower triangular L with L L' = covariance, for semidefinite matrices too.

    The column of a pivot that is zero, or rounding beside its diagonal entry, is zero. Expressions
    need no branch for that.

    Parameters
    ----------
    covariance : (n, n) SX
        Symmetric positive semidefinite, of constants or expressions.

    Returns
    -------
    (n, n) SX
    """
    n = covariance.shape[0]
    left, root = ca.SX(covariance), ca.SX(n, n)
    for j in range(n):
        pivot = _pivot(left[j, j], covariance[j, j])
        if is_zero(pivot):
            continue
        root[j, j] = ca.sqrt(pivot)
        below = [i for i in range(j + 1, n) if not is_zero(left[i, j])]
        for i in below:
            root[i, j] = left[i, j] * root[j, j] / (pivot + _TINY)
        for i in below:
            for k in (k for k in below if k <= i):
                left[i, k] = left[i, k] - root[i, j] * root[k, j]
    return sparse(root)


def _pivot(left: ca.SX, whole: ca.SX) -> ca.SX:
    """What is left of a diagonal entry, or zero if that is rounding."""
    if left.is_constant() and whole.is_constant():
        return left if float(left) > NEGLIGIBLE * float(whole) else ca.SX(0)
    if ca.is_equal(left, whole):
        return left
    return ca.fmax(left - NEGLIGIBLE * whole, 0)
