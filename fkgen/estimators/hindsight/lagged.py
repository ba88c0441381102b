"""Fixed-lag smoothing: x(k-L | k) beside the estimate of x(k), in fixed memory.

For each of the last L samples the filter carries its mean, its covariance, and its covariance with
x(k). With the innovation nu = C e + v and S = Cov(nu), conditioning on y[k] moves the mean of
x(k-j) by Cov(x(k-j), x(k)) r, r = C' S^-1 nu, and all that is carried likewise; the prediction
moves covariances with x(k) as it moves x(k). Covariances of past samples with each other are not
needed (Anderson & Moore 1979, sec. 7.3). Before sample 0 every sample is sample 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from fkgen.estimators.gaussian.actuation import Actuation
from fkgen.estimators.gaussian.decorrelation import whiten
from fkgen.estimators.gaussian.estimate import Posterior, moved_by_noise
from fkgen.estimators.gaussian.gate import HALF
from fkgen.estimators.gaussian.sequential import RANK_TOLERANCE, Conditioned
from fkgen.problem import Spec
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.index import At, packed
from fkgen.symbolic.interface import Port, triangle
from fkgen.symbolic.linalg import column, unpack
from fkgen.symbolic.plant import Plant
from fkgen.symbolic.ports import carried, prior_symbols, shown
from fkgen.symbolic.recursion import Phase

#: Of the last samples, the latest first: means, covariances, and covariances with x(k).
STATE, COVARIANCE, CROSS = "past_state", "past_covariance", "past_cross"
#: Their covariances with what y tells of beside x, between an update and a prediction.
DEVIATION = "past_deviation"


@dataclass(frozen=True, slots=True)
class Lagged:
    """By how many samples the estimate lags, 0 without, and the sizes of x and of what else."""

    lag: int
    n: int
    r: int  # Numbers that y tells of beside x: random inputs, or noise of x

    @classmethod
    def of(cls, spec: Spec, r: int) -> Lagged:
        """What the spec asks for."""
        return cls(spec.filter.option("lag", None) or 0, spec.model.ne, r)

    @property
    def notes(self) -> tuple[str, ...]:
        """What the header says."""
        if not self.lag:
            return ()
        numbers = sum(port.size for port in self.ports())
        what = f"the last {self.lag} samples are estimated with the latest one"
        return (f"fixed lag: {what}, {numbers} numbers of the instance",)

    def ports(self) -> tuple[Port, ...]:
        """What is carried along before and after an update, and what is shown of it."""
        if not self.lag:
            return ()
        lag, n = self.lag, self.n
        later = f"x(k-{lag}|k), before there is one x(0|k)"
        found = [
            shown("lagged_state", (n,), f"{later}: with hindsight of {lag} samples", unit="x"),
            shown("lagged_covariance", (n, n), "its error covariance", unit="xx", symmetric=True),
        ]
        for of, twin, given in (("predicted_", True, "k-1"), ("", False, "k")):
            about = f"of the last {lag} samples given y[0..{given}], the latest first"
            means, covariances, cross = (f"{of}{name}" for name in (STATE, COVARIANCE, CROSS))
            square = (lag, n, n)
            found += [
                carried(
                    means,
                    (lag, n),
                    f"means {about}",
                    unit="x",
                    prior="x",
                    inner=True,
                    corrected=STATE if twin else "",
                ),
                carried(
                    covariances,
                    square,
                    f"covariances {about}",
                    unit="xx",
                    symmetric=True,
                    prior="P",
                    inner=True,
                    corrected=COVARIANCE if twin else "",
                ),
                carried(
                    cross,
                    square,
                    f"covariances with the state {about}",
                    unit="xx",
                    inner=True,
                    corrected=CROSS if twin else "",
                ),
            ]
        if self.r:
            beside = "covariances of the last samples with what y[k] tells of beside the state"
            found.append(carried(DEVIATION, (lag, n, self.r), beside, inner=True))
        return tuple(found)

    def start(self, spec: Spec, symbols: dict[str, ca.SX]) -> Phase | None:
        """Covariances with the state, which start as P0: every sample before is sample 0."""
        if not self.lag:
            return None
        prior = prior_symbols(spec.model)
        builder = PhaseBuilder({**symbols, **prior})
        P = ca.reshape(ca.densify(unpack(prior["P"], self.n)), -1, 1)  # symmetric
        builder.assign({of + CROSS: ca.repmat(P, self.lag) for of in ("", "predicted_")})
        return builder.phase()

    def corrected(
        self,
        builder: PhaseBuilder,
        measured: tuple[Plant, Actuation],
        found: Conditioned,
        prior: ca.SX,
    ) -> None:
        """Condition the last samples on y[k] as it conditioned x, whose packed covariance was P."""
        if not self.lag:
            return
        plant, actuation = measured
        beside = plant.D @ actuation.through @ actuation.covariance
        if plant.S.nnz():
            beside = plant.S[moved_by_noise(plant), :].T
        n, lag, entries = self.n, self.lag, len(triangle(self.n))
        r, M, T = self._informed(builder, plant, found, prior, beside)
        builder.local("weighted_past", lag * n * n)
        with builder.titled("the last samples"):
            with builder.loop("t", 0, lag * n) as t:
                row = column([builder.at(f"predicted_{CROSS}", n * t + i) for i in range(n)])
                mean = builder.at(f"predicted_{STATE}", t) + ca.dot(row, r)
                builder.assign({At(STATE, t): mean})
                moved, weighted = ca.mtimes(row.T, T), ca.mtimes(row.T, M)
                builder.assign({At(CROSS, n * t + i): row[i] - moved[i] for i in range(n)})
                builder.assign({At("weighted_past", n * t + i): weighted[i] for i in range(n)})
                for i in range(self.r):
                    builder.assign({At(DEVIATION, self.r * t + i): -moved[n + i]})
            with builder.loop("j", 0, lag) as j, builder.loop("a", 0, n) as a:
                own = [builder.at("weighted_past", n * n * j + n * a + i) for i in range(n)]
                with builder.loop("b", 0, a + 1) as b:
                    other = [
                        builder.at(f"predicted_{CROSS}", n * n * j + n * b + i) for i in range(n)
                    ]
                    place = entries * j + packed(a, b)
                    before = builder.at(f"predicted_{COVARIANCE}", place)
                    less = ca.dot(column(own), column(other))
                    builder.assign({At(COVARIANCE, place): before - less})
        last, P = (lag - 1) * n, (lag - 1) * entries
        builder.assign(
            {
                "lagged_state": builder.symbol(STATE)[last:],
                "lagged_covariance": builder.symbol(COVARIANCE)[P:],
            }
        )

    def _informed(
        self,
        builder: PhaseBuilder,
        plant: Plant,
        found: Conditioned,
        prior: ca.SX,
        beside: ca.SX,
    ) -> tuple[ca.SX, ca.SX, ca.SX]:
        """C' S^-1 nu, C' S^-1 C and C' S^-1 Cov(y, (x, what else)) over the rows used, named.

        ``beside`` (p, r) is the covariance of y[k] with what it tells of beside x.
        """
        n, C = self.n, plant.C
        crossed = builder.name_entries("seen_covariance", C @ unpack(prior, n))
        columns = ca.horzcat(found.innovation, C, crossed, beside)
        kept = [HALF - each for each in found.rejected]
        tolerance = RANK_TOLERANCE[plant.scalar] if plant.noise_free else None
        white = whiten(
            builder, found.innovation_covariance, columns, "_past", kept=kept, tolerance=tolerance
        )
        sensed = white.columns[:, 1 : n + 1]
        weighted = ca.diag(ca.vertcat(*white.inverse)) @ sensed
        r, M, T = (
            weighted.T @ white.columns[:, places]
            for places in (slice(0, 1), slice(1, n + 1), slice(n + 1, None))
        )
        found_all = builder.name_all("told_of_past", (r, M, T))
        return found_all[0], found_all[1], found_all[2]

    def moved(self, builder: PhaseBuilder, filtered: Posterior, through: ca.SX) -> None:
        """One sample more, of x and what else; the last one is forgotten."""
        if not self.lag:
            return
        n, r, lag, entries = self.n, self.r, self.lag, len(triangle(self.n))
        joint = unpack(filtered.covariance, n)
        if r:
            joint = ca.horzcat(joint, filtered.cross_covariance.T)
        latest = joint @ through.T
        with builder.titled("one sample more"):
            builder.assign({At(f"predicted_{STATE}", i): filtered.state[i] for i in range(n)})
            P = {At(f"predicted_{COVARIANCE}", i): filtered.covariance[i] for i in range(entries)}
            builder.assign(P)
            cross = f"predicted_{CROSS}"
            own = {At(cross, n * i + j): latest[i, j] for i in range(n) for j in range(n)}
            builder.assign(own)
            if lag == 1:
                return
            with builder.loop("t", 0, (lag - 1) * n) as t:
                builder.assign({At(f"predicted_{STATE}", t + n): builder.at(STATE, t)})
                row = [builder.at(CROSS, n * t + i) for i in range(n)]
                row += [builder.at(DEVIATION, r * t + i) for i in range(r)]
                moved = ca.mtimes(column(row).T, through.T)
                builder.assign({At(cross, n * t + n * n + i): moved[i] for i in range(n)})
            with builder.loop("t", 0, (lag - 1) * entries) as t:
                place = At(f"predicted_{COVARIANCE}", t + entries)
                builder.assign({place: builder.at(COVARIANCE, t)})
