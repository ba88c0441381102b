"""Steps of extended filters as one arranges them by hand, shared terms computed once, and counted.

Rows of y one by one on packed covariances; what fkgen shows of a sample is computed here too:
innovation, its covariance, nis, log likelihood. Nothing is shared with fkgen.
"""

from __future__ import annotations

import math

import numpy as np

TURN = 2.0 * math.pi
LOG_TWO_PI = math.log(TURN)


class Counted:
    """A number whose operations are counted."""

    total = 0

    def __init__(self, value):
        self.value = float(value)

    def __repr__(self):
        return repr(self.value)


def counted(operation):
    """An operation that counts as one; a constant may be an argument."""

    def call(*arguments):
        Counted.total += 1
        return Counted(operation(*(a.value if isinstance(a, Counted) else a for a in arguments)))

    return call


for _name, _operation in {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "truediv": lambda a, b: a / b,
}.items():
    setattr(Counted, f"__{_name}__", counted(_operation))
    setattr(Counted, f"__r{_name}__", counted(lambda a, b, of=_operation: of(b, a)))

sqrt, sin, cos, log, exp = (
    counted(getattr(math, name)) for name in ("sqrt", "sin", "cos", "log", "exp")
)
atan2, hypot, floor = (counted(getattr(math, name)) for name in ("atan2", "hypot", "floor"))
negative = counted(lambda a: -a)
is_negative = counted(lambda a: 1.0 if a < 0.0 else 0.0)


def numbers(values):
    return [Counted(value) for value in np.ravel(values)]


def packed(P):
    """The lower triangle as counted numbers by (row, column), either way round."""
    found = {(i, j): Counted(P[i][j]) for i in range(len(P)) for j in range(i + 1)}
    return found | {(j, i): value for (i, j), value in found.items()}


def stored(P, i, j, value):
    P[i, j] = P[j, i] = value


def both(lower):
    """The same either way round."""
    return lower | {place[::-1]: value for place, value in lower.items()}


def full(P):
    n = 1 + max(i for i, _ in P)
    return np.array([[P[i, j].value for j in range(n)] for i in range(n)])


def dot(row, vector):
    """A row (a dict from place to number, 1 or -1) times a vector."""
    result = None
    for place, factor in row.items():
        value = vector[place]
        if factor in (1, -1):
            if result is None:
                result = value if factor == 1 else negative(value)
            else:
                result = result + value if factor == 1 else result - value
        else:
            term = factor * value
            result = term if result is None else result + term
    return result


def corrected(rows, innovation, R, P, n):
    """Rows with independent noises, one by one: the errors (from 0), P in place, and the rest."""
    mean, nis, S = None, None, {}
    seen = sorted({place for row in rows for place in row})
    for i, row in enumerate(rows):
        across = [dot(row, {j: P[j, k] for j in row}) for k in seen]
        by = dict(zip(seen, across, strict=True))
        for j in range(i + 1):
            S[i, j] = dot(rows[j], by)
        S[i, i] = S[i, i] + R[i]
    pivots = []
    for i, (row, r) in enumerate(zip(rows, R, strict=True)):
        cross = [dot(row, [P[j, k] for k in range(n)]) for j in range(n)]
        pivots.append(dot(row, cross) + r if i else S[0, 0])
        nu = innovation[i] if mean is None else innovation[i] - dot(row, mean)
        mean, share = added(P, mean, cross, nu, 1.0 / pivots[i])
        nis = share if nis is None else nis + share
    return mean, {"innovation": innovation, "S": S} | likelihood(nis, pivots)


def corrected_by_factors(rows, innovation, R, P, n):
    """The same for few rows: what couples them gives S."""
    mean, nis, S, pivots, couplings, weights, factors = None, None, {}, [], [], [], []
    for i, (row, r) in enumerate(zip(rows, R, strict=True)):
        cross = [dot(row, [P[j, k] for k in range(n)]) for j in range(n)]
        couplings.append({k: dot(rows[k], cross) for k in range(i + 1, len(rows))})
        pivots.append(dot(row, cross) + r)
        nu = innovation[i]
        for j in range(i):
            nu = nu - couplings[j][i] * weights[j]
        inverse = 1.0 / pivots[i]
        weights.append(nu * inverse)
        mean, share = added(P, mean, cross, nu, inverse)
        Counted.total -= 1  # the weight, which is there
        nis = share if nis is None else nis + share
        factors.append({at: c * inverse for at, c in couplings[i].items()})
        for j in range(i + 1):
            S[i, j] = pivots[i] if i == j else couplings[j][i]
            for m in range(j):
                S[i, j] = S[i, j] + couplings[m][i] * factors[m][j]
    return mean, {"innovation": innovation, "S": S} | likelihood(nis, pivots)


def added(P, mean, cross, nu, inverse):
    """The mean with one row more, P without what it tells, and the share of the nis."""
    weight = nu * inverse
    k = [c * inverse for c in cross]
    step = [c * weight for c in cross]
    for a in range(len(cross)):
        for b in range(a + 1):
            stored(P, a, b, P[a, b] - k[a] * cross[b])
    mean = step if mean is None else [m + s for m, s in zip(mean, step, strict=True)]
    return mean, nu * weight


def likelihood(nis, pivots):
    """Four pivots may be multiplied before a logarithm."""
    summed = nis + len(pivots) * LOG_TWO_PI
    for start in range(0, len(pivots), 4):
        product = pivots[start]
        for pivot in pivots[start + 1 : start + 4]:
            product = product * pivot
        summed = summed + log(product)
    return {"nis": nis, "log_likelihood": -0.5 * summed}


def robot(x, P, u, y, dt, W, R):
    """Unicycle with range and bearing of the origin; x = (x, y, heading), u = (speed, turn)."""
    x, u, y, P = numbers(x), numbers(u), numbers(y), packed(P)
    distance = hypot(x[0], x[1])
    inverse = 1.0 / distance
    a, b = x[0] * inverse, x[1] * inverse
    rows = [{0: a, 1: b}, {0: negative(b * inverse), 1: a * inverse, 2: -1}]
    apart = y[1] - (atan2(x[1], x[0]) - x[2])
    apart = apart + TURN * floor(0.5 - apart * (1.0 / TURN))
    mean, shown = corrected_by_factors(rows, [y[0] - distance, apart], R, P, 3)
    x = [a + b for a, b in zip(x, mean, strict=True)]
    shown |= {"filtered_state": list(x), "filtered_covariance": full(P)}
    way, turn = u[0] * dt, u[1] * dt
    east, north = way * cos(x[2]), way * sin(x[2])
    moved = [x[0] + east, x[1] + north, x[2] + turn]
    ahead, aside = P[0, 2] - north * P[2, 2], P[1, 2] + east * P[2, 2]
    p00 = P[0, 0] - north * (P[0, 2] + ahead)
    p11 = P[1, 1] + east * (P[1, 2] + aside)
    p01 = (P[0, 1] - north * P[1, 2]) + east * ahead
    p22 = P[2, 2] + (dt * dt) * W
    found = {(0, 0): p00, (1, 0): p01, (1, 1): p11, (2, 0): ahead, (2, 1): aside, (2, 2): p22}
    shown |= {
        "predicted_state": moved,
        "predicted_covariance": full(found | {k[::-1]: v for k, v in found.items()}),
    }
    return shown


def battery(x, P, u, y, p, Q, R):
    """State of charge, the voltage of an RC pair and a resistance, seen by the voltage."""
    x, (i,), (v,), P = numbers(x), numbers(u), numbers(y), packed(P)
    soc = x[0]
    slope = 1.2 + soc * (1.5 * soc - 1.4)
    seen = 3.0 + soc * (1.2 + soc * (0.5 * soc - 0.7)) - x[1] - x[2] * i
    rows = [{0: slope, 1: -1, 2: negative(i)}]
    mean, shown = corrected_by_factors(rows, [v - seen], [R], P, 3)
    x = [a + b for a, b in zip(x, mean, strict=True)]
    shown |= {"filtered_state": list(x), "filtered_covariance": full(P)}
    dt, capacity, tau, r1 = numbers([p[name] for name in ("dt", "capacity", "tau", "r1")])
    decay = exp(negative(dt / tau))
    moved = [x[0] - i * dt / capacity, decay * x[1] + r1 * (1.0 - decay) * i, x[2]]
    across = decay * P[1, 1]
    found = {
        (0, 0): P[0, 0] + Q[0], (1, 0): decay * P[1, 0], (1, 1): decay * across + Q[1],
        (2, 0): P[2, 0], (2, 1): decay * P[2, 1], (2, 2): P[2, 2] + Q[2],
    }  # fmt: skip
    shown |= {
        "predicted_state": moved,
        "predicted_covariance": full(found | {k[::-1]: v for k, v in found.items()}),
    }
    return shown


def half_angle(d):
    """Square of an angle, sine of half of it over it, cosine of half of it."""
    square = d[0] * d[0] + d[1] * d[1] + d[2] * d[2] + 1e-30
    angle = sqrt(square)
    half = 0.5 * angle
    return square, sin(half) / angle, cos(half)


def turned(q, d, halves):
    """q * exp(d), normalised to first order, w >= 0."""
    _, sine, w = halves
    x, y, z = (sine * each for each in d)
    found = [
        q[0] * w - q[1] * x - q[2] * y - q[3] * z,
        q[0] * x + q[1] * w + q[2] * z - q[3] * y,
        q[0] * y + q[2] * w + q[3] * x - q[1] * z,
        q[0] * z + q[3] * w + q[1] * y - q[2] * x,
    ]
    length = found[0] * found[0] + found[1] * found[1] + found[2] * found[2] + found[3] * found[3]
    scale = (1.5 - 0.5 * length) * (1.0 - 2.0 * is_negative(found[0]))
    return [scale * each for each in found], (w, x, y, z)


def right_jacobian(d, halves):
    """T of P -> T P T'."""
    square, sine, cosine = halves
    twice = sine + sine
    first, second = twice * sine, (1.0 - twice * cosine) / square
    s = [second * each for each in d]
    f = [first * each for each in d]
    o = [a * b for a, b in zip(s, d, strict=True)]
    xy, xz, yz = s[0] * d[1], s[0] * d[2], s[1] * d[2]
    return [
        [1.0 - (o[1] + o[2]), xy + f[2], xz - f[1]],
        [xy - f[2], 1.0 - (o[0] + o[2]), yz + f[0]],
        [xz + f[1], yz - f[0], 1.0 - (o[0] + o[1])],
    ]


def product(a, b):
    """Of lists of rows."""
    return [
        [sum_of(x * y for x, y in zip(row, col, strict=True)) for col in zip(*b, strict=True)]
        for row in a
    ]


def sum_of(values):
    result = None
    for value in values:
        result = value if result is None else result + value
    return result


def body_rows(w, x, y, z):
    """The first and the third row of R(q), body to world: what gravity and field need."""
    x2, y2, z2 = x + x, y + y, z + z
    yy, zz, xx = y * y2, z * z2, x * x2
    xy, xz, yz, wx, wy, wz = x * y2, x * z2, y * z2, w * x2, w * y2, w * z2
    return [1.0 - (yy + zz), xy - wz, xz + wy], [xz - wy, yz + wx, 1.0 - (xx + yy)]


def rotation(w, x, y, z):
    x2, y2, z2 = x + x, y + y, z + z
    yy, zz, xx = y * y2, z * z2, x * x2
    xy, xz, yz, wx, wy, wz = x * y2, x * z2, y * z2, w * x2, w * y2, w * z2
    return [
        [1.0 - (yy + zz), xy - wz, xz + wy],
        [xy + wz, 1.0 - (xx + zz), yz - wx],
        [xz - wy, yz + wx, 1.0 - (xx + yy)],
    ]


def attitude(x, P, u, y, dt, noise, R):
    """Attitude and gyro bias, gravity (0, 0, 9.81) and a field (0.4, 0, -0.9) seen in body axes."""
    x, u, y, P = numbers(x), numbers(u), numbers(y), packed(P)
    ahead, up = body_rows(*x[:4])
    gravity = [9.81 * each for each in up]
    field = [0.4 * a - 0.9 * b for a, b in zip(ahead, up, strict=True)]
    rows = []
    for v in (gravity, field):
        minus = [negative(each) for each in v]
        rows += [{1: minus[2], 2: v[1]}, {0: v[2], 2: minus[0]}, {0: minus[1], 1: v[0]}]
    innovation = [a - b for a, b in zip(y, gravity + field, strict=True)]
    mean, shown = corrected(rows, innovation, R, P, 6)
    halves = half_angle(mean[:3])
    q, _ = turned(x[:4], mean[:3], halves)
    T = right_jacobian(mean[:3], halves)
    b = [a + c for a, c in zip(x[4:], mean[3:], strict=True)]
    within = product(T, [[P[i, j] for j in range(3)] for i in range(3)])
    across = product(T, [[P[i, j] for j in (3, 4, 5)] for i in range(3)])
    for i in range(3):
        for j in range(3):
            stored(P, i, 3 + j, across[i][j])
            if j <= i:
                stored(P, i, j, sum_of(s * t for s, t in zip(within[i], T[j], strict=True)))
    shown |= {"filtered_state": q + b, "filtered_covariance": full(P)}
    d = [(g - c) * dt for g, c in zip(u, b, strict=True)]
    halves = half_angle(d)
    q, turn = turned(q, d, halves)
    E = [list(row) for row in zip(*rotation(*turn), strict=True)]
    J = [[each * dt for each in row] for row in right_jacobian(d, halves)]
    both = [[*e, *(j)] for e, j in zip(E, J, strict=True)]
    found = {
        (i, j): P[i, j] + noise[1] if i == j else P[i, j] for i in (3, 4, 5) for j in (3, 4, 5)
    }
    through = []
    for row in both:
        left = [sum_of(row[k] * P[k, j] for k in range(3)) for j in range(6)]
        through.append(
            [left[j] - sum_of(row[3 + k] * P[3 + k, j] for k in range(3)) for j in range(6)]
        )
    scaled = [[noise[0] * each for each in row] for row in J]
    for i in range(3):
        for j in range(3):
            found[i, 3 + j] = found[3 + j, i] = through[i][3 + j]
            if j > i:
                continue
            left = sum_of(through[i][k] * E[j][k] for k in range(3))
            left = left - sum_of(through[i][3 + k] * J[j][k] for k in range(3))
            left = left + sum_of(scaled[i][k] * J[j][k] for k in range(3))
            found[i, j] = found[j, i] = left
    shown |= {"predicted_state": q + b, "predicted_covariance": full(found)}
    return shown
