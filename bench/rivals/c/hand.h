/* What the reference filters share: an instance with the outputs that fkgen stores. Symmetric matrices: lower
 * triangle by rows. */
#ifndef HAND_H
#define HAND_H

#include <math.h>

#ifndef CHECKS
#define CHECKS 0
#endif

typedef struct
{
    double x[NX], P[(NX * (NX + 1)) / 2];   /* prediction */
    double xf[NX], Pf[(NX * (NX + 1)) / 2]; /* filtered */
    double innovation[NY], S[(NY * (NY + 1)) / 2];
    double nis, log_likelihood;
} hand_t;

void hand_init(hand_t *f);
int hand_step(hand_t *f, const double *y);

#endif
