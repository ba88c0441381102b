/* Instance of hand_imm.c: full matrices, nothing packed. */
#ifndef HAND_IMM_H
#define HAND_IMM_H

typedef struct
{
    double mode_x[NM][NX], mode_P[NM][NX][NX]; /* prediction under each mode, mixed */
    double predicted_probability[NM];          /* of the next mode */
    double x[NX], P[NX][NX];                   /* filtered */
    double probability[NM];                    /* of the mode, given y */
    double log_likelihood;
} hand_t;

void hand_init(hand_t *f);
int hand_step(hand_t *f, const double *y);

#endif
