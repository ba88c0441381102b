/* Kalman filter of two states and one measurement without a zero, written by hand. Nothing is shared with fkgen.
 * CHECKS = 1: a missing (NaN) sample is skipped, an infinite one and results that are not finite are refused. */
#include "hand.h"

#define R 0.01
#define LOG_2PI 1.8378770664093453

static const double a00 = 0.9802, a01 = -0.0002, a10 = 0.0094, a11 = 0.9048;
static const double c0 = 0.3, c1 = 1.1;
static const double q00 = 2e-4, q10 = 1e-5, q11 = 3e-4;

void hand_init(hand_t *f)
{
    *f = (hand_t){ .P = { 1.0, 0.0, 1.0 } };
}

int hand_step(hand_t *f, const double *y)
{
    const double p00 = f->P[0], p10 = f->P[1], p11 = f->P[2];
    const double w0 = p00 * c0 + p10 * c1, w1 = p10 * c0 + p11 * c1;
    const double s = c0 * w0 + c1 * w1 + R;
    double x0 = f->x[0], x1 = f->x[1];
    double f00 = p00, f10 = p10, f11 = p11;
    double e = 0.0, nis = 0.0, ll = 0.0;
#if CHECKS
    if (isinf(y[0]) || !(p00 >= 0.0) || !(p11 >= 0.0) || !(s > 0.0))
    {
        return -1;
    }
    if (!isnan(y[0]))
#endif
    {
        const double inverse = 1.0 / s;
        const double k0 = w0 * inverse, k1 = w1 * inverse;
        e = y[0] - (c0 * x0 + c1 * x1);
        nis = e * e * inverse;
        ll = -0.5 * (nis + log(s) + LOG_2PI);
        x0 += k0 * e;
        x1 += k1 * e;
        f00 = p00 - k0 * w0;
        f10 = p10 - k1 * w0;
        f11 = p11 - k1 * w1;
    }
    const double b00 = a00 * f00 + a01 * f10, b01 = a00 * f10 + a01 * f11;
    const double b10 = a10 * f00 + a11 * f10, b11 = a10 * f10 + a11 * f11;
    const double m0 = a00 * x0 + a01 * x1, m1 = a10 * x0 + a11 * x1;
    const double n00 = b00 * a00 + b01 * a01 + q00;
    const double n10 = b10 * a00 + b11 * a01 + q10;
    const double n11 = b10 * a10 + b11 * a11 + q11;
#if CHECKS
    if (!(isfinite(m0) && isfinite(m1) && isfinite(n00) && isfinite(n11)))
    {
        return -1;
    }
#endif
    f->xf[0] = x0;
    f->xf[1] = x1;
    f->Pf[0] = f00;
    f->Pf[1] = f10;
    f->Pf[2] = f11;
    f->innovation[0] = e;
    f->S[0] = s;
    f->nis = nis;
    f->log_likelihood = ll;
    f->x[0] = m0;
    f->x[1] = m1;
    f->P[0] = n00;
    f->P[1] = n10;
    f->P[2] = n11;
    return 0;
}
