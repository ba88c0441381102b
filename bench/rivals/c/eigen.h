/* C interface of eigen.cpp: full matrices by rows, the same outputs as the others. */
#ifndef EIGEN_H
#define EIGEN_H

typedef struct
{
    double x[NX], P[NX * NX];   /* prediction */
    double xf[NX], Pf[NX * NX]; /* filtered */
    double innovation[NY], S[NY * NY];
    double nis, log_likelihood;
} hand_t;

#ifdef __cplusplus
extern "C" {
#endif
void hand_init(hand_t *f);
int hand_step(hand_t *f, const double *y);
#ifdef __cplusplus
}
#endif

#endif
