"""Two states, one measurement: a step is one division long.

M = A P A' + Q, w = A P c and s = c' P c + r are sums over P with constants, found together; the
products of w come before the division, one multiply-add of each element after it.
"""

from __future__ import annotations

from typing import Any

from forms import text
from forms.text import Sizes

_FORM = """
static double P[8], nis;
#define expected() (&mean)
#define begin() \
    int there = 1; \
    double p00 = START[0], p10 = START[1], p11 = START[2], x0 = 0.0, x1 = 0.0, mean = 0.0, x[2]
#define again(present) there = (present)[0] != 0

INLINE double sum(const double *k, double a, double b, double c)
{
    return (k[0] * a + k[1] * b) + k[2] * c;
}
"""
_STEP = """
{
    const double s = sum(K, p00, p10, p11) + R;
    const double inverse = there ? 1.0 / s : 0.0;
    const double v0 = C[0] * p00 + C[1] * p10, v1 = C[0] * p10 + C[1] * p11;
    const double w0 = sum(K + 3, p00, p10, p11), w1 = sum(K + 6, p00, p10, p11);
    const double m00 = sum(K + 9, p00, p10, p11) + Q[0], m10 = sum(K + 12, p00, p10, p11) + Q[1];
    const double m11 = sum(K + 15, p00, p10, p11) + Q[2];
    const double z = e[0] * inverse;
    const double f0 = x0 + v0 * z, f1 = x1 + v1 * z;
    const double q00 = m00 - (w0 * w0) * inverse, q10 = m10 - (w0 * w1) * inverse;
    const double q11 = m11 - (w1 * w1) * inverse;
    const double g0 = (A[0] * x0 + A[1] * x1) + w0 * z, g1 = (A[2] * x0 + A[3] * x1) + w1 * z;
    const double all = (q00 + q11) + (g0 + g1) + (f0 + f1) + q10;
    if (there && !(s > 0.0)) { status[t] = -3; return t; }
    if (!(all - all == 0.0)) { status[t] = -5; return t; }
    if (t == samples - 1)
    {
        P[0] = p00 - (v0 * v0) * inverse;
        P[1] = P[4] = p10 - (v0 * v1) * inverse;
        P[5] = p11 - (v1 * v1) * inverse;
    }
    nis = e[0] * z; there = 1; x[0] = f0; x[1] = f1;
    p00 = q00; p10 = q10; p11 = q11; x0 = g0; x1 = g1;
    mean = C[0] * x0 + C[1] * x1;
}
"""


def scalar(model: dict[str, Any]) -> str:
    """C of the form for one model of two states."""
    A, C, Q, R, P0 = text.matrices(model)
    prior = A @ P0 @ A.T + Q
    c = C[0]
    products = [(c, c), (A[0], c), (A[1], c), (A[0], A[0]), (A[1], A[0]), (A[1], A[1])]
    folded = [[a[0] * b[0], a[0] * b[1] + a[1] * b[0], a[1] * b[1]] for a, b in products]
    tables = {"K": folded, "A": A, "C": C, "Q": [Q[0, 0], Q[1, 0], Q[1, 1]]}
    tables["START"] = [prior[0, 0], prior[1, 0], prior[1, 1]]
    declared = "".join(text.table(name, values) for name, values in tables.items())
    loop = text.record(Sizes(2, 1), _STEP)
    return f'#include "vectors.h"\n\n{declared}#define R {R[0, 0]!r}\n{_FORM}{loop}'.replace(
        "np.float64", ""
    )
