"""Several Gaussians as one of the same mean and covariance, and their common innovation."""

from __future__ import annotations

import itertools

import casadi as ca

from fkgen.symbolic.conditioning import Conditioned
from fkgen.symbolic.elimination import whiten
from fkgen.symbolic.linalg import outer_lower, spread, weighted_sum
from fkgen.symbolic.script import Script

#: Up to so many means the sum over pairs has fewer operations.
FEW_MEANS = 3


def combined_innovation(
    script: Script, held: ca.SX, predicted: list[ca.SX], found: list[Conditioned]
) -> dict[str, ca.SX]:
    """Innovation of a mixture of predictions of y, its covariance, its NIS over the rows present.

    Parameters
    ----------
    script : Script
    held : (N,) SX
        Probabilities before y[k].
    predicted : list of (p,) SX
        Each mode's prediction of y[k].
    found : list of Conditioned
        What each mode made of y[k].
    """
    mean = weighted_sum(held, predicted)
    S = weighted_sum(held, [each.innovation_covariance for each in found])
    S = script.let("combined_variance", S + spread(held, predicted, mean))
    nu = script.let("combined_innovation", weighted_sum(held, [f.innovation for f in found]))
    results = {"innovation": nu, "innovation_covariance": S}
    if len(found) == 1:
        return {**results, "nis": found[0].nis}
    return {**results, "nis": whiten(script, S, nu, "_combined").quadratic(ca.SX(1))}


class Scatter:
    """Spread of the same means under several weights, positive semidefinite term by term.

    The sum over pairs w_a w_b (m_a - m_b)(m_a - m_b)' shares its products between all weights; the
    sum over deviations from the mean has fewer terms from four means on. Weights sum to one.
    """

    def __init__(self, script: Script, name: str, means: list[ca.SX]) -> None:
        self.means = means
        self.pairs: list[tuple[int, int, ca.SX]] = []
        if len(means) > FEW_MEANS:
            return
        for a, b in itertools.combinations(range(len(means)), 2):
            apart = script.let(f"{name}_apart_{a}_{b}", means[a] - means[b])
            product = script.let(f"{name}_scatter_{a}_{b}", outer_lower(apart, apart))
            self.pairs.append((a, b, product))

    def under(self, weights: ca.SX, mean: ca.SX) -> ca.SX:
        """Packed spread around ``mean``, the weighted sum of the means."""
        if len(self.means) > FEW_MEANS:
            return spread(weights, self.means, mean)
        total = ca.SX.zeros(mean.numel() * (mean.numel() + 1) // 2)
        for a, b, product in self.pairs:
            total += (weights[a] * weights[b]) * product
        return total
