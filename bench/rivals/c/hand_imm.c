/* Interacting multiple models for a sensor that loses its signal or gains noise, as an engineer writes them from a
 * textbook: full matrices, plain loops, the inverse of S in closed form (NY = 2), exp and log of libm. No checks, no
 * missing rows. A condition without signal corrects nothing, so nothing is computed for it but its density. Nothing
 * is shared with fkgen. */
#include "hand_imm.h"

#include <math.h>
#include <string.h>

/* A_, C_, Q_, R_, P0_, KERNEL_, INITIAL_; per condition: SIGNAL_, NOISE_, MODE_ it belongs to, SHARE_ of that mode. */
#include MODEL

#define CONDITIONS 4
#define TWO_PI 6.283185307179586

/* Density of N(0, S) at e; the inverse of S is left behind. */
static double density(const double e[NY], double S[NY][NY], double inverse[NY][NY])
{
    const double determinant = S[0][0] * S[1][1] - S[0][1] * S[1][0];
    double nis = 0.0;
    inverse[0][0] = S[1][1] / determinant;
    inverse[0][1] = -S[0][1] / determinant;
    inverse[1][0] = -S[1][0] / determinant;
    inverse[1][1] = S[0][0] / determinant;
    for (int i = 0; i < NY; ++i)
    {
        for (int j = 0; j < NY; ++j)
        {
            nis += e[i] * inverse[i][j] * e[j];
        }
    }
    return exp(-0.5 * nis) / (TWO_PI * sqrt(determinant));
}

/* Density of y without a signal: noise only. */
static double silence(const double *y, double noise)
{
    double S[NY][NY], inverse[NY][NY];
    for (int i = 0; i < NY; ++i)
    {
        for (int j = 0; j < NY; ++j)
        {
            S[i][j] = noise * R_[i][j];
        }
    }
    return density(y, S, inverse);
}

/* Kalman update of x and P; returns the density of y. P - K (C P), not P - K (P C')': that one lets what rounding leaves
 * of asymmetry grow without bound. */
static double correct(double x[NX], double P[NX][NX], const double *y, double noise)
{
    double e[NY], W[NX][NY], V[NY][NX], S[NY][NY], inverse[NY][NY], K[NX][NY];
    for (int r = 0; r < NY; ++r)
    {
        e[r] = y[r];
        for (int i = 0; i < NX; ++i)
        {
            e[r] -= C_[r][i] * x[i];
            W[i][r] = 0.0;
            V[r][i] = 0.0;
            for (int j = 0; j < NX; ++j)
            {
                W[i][r] += P[i][j] * C_[r][j];
                V[r][i] += C_[r][j] * P[j][i];
            }
        }
    }
    for (int r = 0; r < NY; ++r)
    {
        for (int s = 0; s < NY; ++s)
        {
            S[r][s] = noise * R_[r][s];
            for (int i = 0; i < NX; ++i)
            {
                S[r][s] += C_[r][i] * W[i][s];
            }
        }
    }
    const double likelihood = density(e, S, inverse);
    for (int i = 0; i < NX; ++i)
    {
        for (int r = 0; r < NY; ++r)
        {
            K[i][r] = W[i][0] * inverse[0][r] + W[i][1] * inverse[1][r];
            x[i] += K[i][r] * e[r];
        }
    }
    for (int i = 0; i < NX; ++i)
    {
        for (int j = 0; j < NX; ++j)
        {
            P[i][j] -= K[i][0] * V[0][j] + K[i][1] * V[1][j];
        }
    }
    return likelihood;
}

/* Mean and covariance of the mixture of all modes under some weights. */
static void mix(const double weight[NM], double xs[NM][NX], double Ps[NM][NX][NX], double x[NX], double P[NX][NX])
{
    for (int i = 0; i < NX; ++i)
    {
        x[i] = 0.0;
        for (int m = 0; m < NM; ++m)
        {
            x[i] += weight[m] * xs[m][i];
        }
    }
    for (int i = 0; i < NX; ++i)
    {
        for (int j = 0; j < NX; ++j)
        {
            P[i][j] = 0.0;
            for (int m = 0; m < NM; ++m)
            {
                P[i][j] += weight[m] * (Ps[m][i][j] + (xs[m][i] - x[i]) * (xs[m][j] - x[j]));
            }
        }
    }
}

/* x = A from_x, P = A from_P A' + Q. */
static void predict(double from_x[NX], double from_P[NX][NX], double x[NX], double P[NX][NX])
{
    double AP[NX][NX];
    for (int i = 0; i < NX; ++i)
    {
        x[i] = 0.0;
        for (int j = 0; j < NX; ++j)
        {
            x[i] += A_[i][j] * from_x[j];
            AP[i][j] = 0.0;
            for (int k = 0; k < NX; ++k)
            {
                AP[i][j] += A_[i][k] * from_P[k][j];
            }
        }
    }
    for (int i = 0; i < NX; ++i)
    {
        for (int j = 0; j < NX; ++j)
        {
            P[i][j] = Q_[i][j];
            for (int k = 0; k < NX; ++k)
            {
                P[i][j] += AP[i][k] * A_[j][k];
            }
        }
    }
}

void hand_init(hand_t *f)
{
    memset(f, 0, sizeof *f);
    for (int m = 0; m < NM; ++m)
    {
        memcpy(f->mode_P[m], P0_, sizeof P0_);
        f->predicted_probability[m] = INITIAL_[m];
    }
}

int hand_step(hand_t *f, const double *y)
{
    double likelihood[NM] = { 0.0 }, total = 0.0;
    double xs[NM][NX], Ps[NM][NX][NX];
    for (int c = 0; c < CONDITIONS; ++c)
    {
        const int m = MODE_[c];
        likelihood[m] += SHARE_[c] * (SIGNAL_[c] ? correct(f->mode_x[m], f->mode_P[m], y, NOISE_[c]) : silence(y, NOISE_[c]));
    }
    for (int m = 0; m < NM; ++m)
    {
        f->probability[m] = f->predicted_probability[m] * likelihood[m];
        total += f->probability[m];
    }
    for (int m = 0; m < NM; ++m)
    {
        f->probability[m] /= total;
    }
    f->log_likelihood = log(total);
    mix(f->probability, f->mode_x, f->mode_P, f->x, f->P);
    for (int m = 0; m < NM; ++m)
    {
        double weight[NM], x[NX], P[NX][NX], next = 0.0;
        for (int i = 0; i < NM; ++i)
        {
            weight[i] = KERNEL_[i][m] * f->probability[i];
            next += weight[i];
        }
        for (int i = 0; i < NM; ++i)
        {
            weight[i] /= next;
        }
        f->predicted_probability[m] = next;
        mix(weight, f->mode_x, f->mode_P, x, P);
        predict(x, P, xs[m], Ps[m]);
    }
    memcpy(f->mode_x, xs, sizeof xs);
    memcpy(f->mode_P, Ps, sizeof Ps);
    return 0;
}
