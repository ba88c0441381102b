/* Run one filter over a record, a call per step, nothing stored: what an interrupt routine costs. INIT and STEP are
 * macros of the contender. With main: `loop N` runs N steps of a short record over and over, for callgrind. */
#include CONTENDER

#include <stdint.h>
#include <stdlib.h>

#define EXPORT __attribute__((visibility("default")))

EXPORT REAL run(int64_t samples, const REAL *y, const REAL *u)
{
    static TYPE f;
    int64_t k;
    (void)u;
    INIT(&f);
    for (k = 0; k < samples; ++k)
    {
        (void)STEP(&f, u + k * NU, y + k * NY);
    }
    return RESULT(&f);
}

#ifdef OUTPUTS
/* The same, and everything that contenders have in common is kept: WIDTH values per step. */
EXPORT void trace(int64_t samples, const REAL *y, const REAL *u, REAL *to)
{
    static TYPE f;
    int64_t k;
    (void)u;
    INIT(&f);
    for (k = 0; k < samples; ++k)
    {
        (void)STEP(&f, u + k * NU, y + k * NY);
        OUTPUTS(&f, to + k * WIDTH);
    }
}
#endif

#ifdef MAIN
#define RECORD 1000
int main(int argc, char **argv)
{
    static REAL y[RECORD * NY], u[RECORD * (NU + 1)];
    static TYPE f;
    uint32_t seed = 1u;
    int64_t k, steps = (argc > 1) ? strtoll(argv[1], NULL, 10) : 0;
    for (k = 0; k < RECORD * NY; ++k)
    {
        seed = seed * 1664525u + 1013904223u;
        y[k] = (REAL)(0.2 * ((double)seed / 4294967296.0 - 0.5));
    }
    INIT(&f);
    for (k = 0; k < steps; ++k)
    {
        (void)STEP(&f, u + (k % RECORD) * NU, y + (k % RECORD) * NY);
    }
    return RESULT(&f) > (REAL)1e30;
}
#endif
