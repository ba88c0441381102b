/* Vectors of four doubles in GCC's spelling, for the hand-written forms: gcc and clang alike. */
#ifndef VECTORS_H
#define VECTORS_H

#include <float.h>
#include <math.h>
#include <stdint.h>
#include <string.h>

typedef double vec __attribute__((vector_size(32), aligned(32), may_alias));
typedef int64_t mask __attribute__((vector_size(32)));

#define LOAD(from) (*(const vec *)(from))
#define STORE(to, value) (*(vec *)(to) = (value))
#define ALL(a) ((vec){ (a), (a), (a), (a) })
#define MAGNITUDE(v) ((vec)((mask)(v) & INT64_MAX))
#define SELECT(where, a, b) ((vec)(((where) & (mask)(a)) | (~(where) & (mask)(b))))
#define TOTAL(v) (((v)[0] + (v)[1]) + ((v)[2] + (v)[3]))

/* The value stays in its register: else gcc loads it again for every row that it is multiplied with. */
#define HOLD(v) __asm__("" : "+x"(v))

#ifdef __clang__
#define PICK(a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#define ROLLED _Pragma("clang loop unroll(disable)")
#define TWICE _Pragma("clang loop unroll_count(2)")
#else
#define PICK(a, b, ...) __builtin_shuffle(a, b, (mask){ __VA_ARGS__ })
#define ROLLED _Pragma("GCC unroll 1")
#define TWICE _Pragma("GCC unroll 2")
#endif

#define INLINE static inline __attribute__((always_inline))
#define ALIGNED __attribute__((aligned(64)))

INLINE void transpose(vec a, vec b, vec c, vec d, vec out[4])
{
    const vec ab = PICK(a, b, 0, 4, 2, 6), AB = PICK(a, b, 1, 5, 3, 7);
    const vec cd = PICK(c, d, 0, 4, 2, 6), CD = PICK(c, d, 1, 5, 3, 7);
    out[0] = PICK(ab, cd, 0, 1, 4, 5);
    out[1] = PICK(AB, CD, 0, 1, 4, 5);
    out[2] = PICK(ab, cd, 2, 3, 6, 7);
    out[3] = PICK(AB, CD, 2, 3, 6, 7);
}

/* Row r of a block on the diagonal: itself up to the diagonal, its mirror image beyond. */
#define LOWER_0(row, mirror) PICK(row, mirror, 0, 5, 6, 7)
#define LOWER_1(row, mirror) PICK(row, mirror, 0, 1, 6, 7)
#define LOWER_2(row, mirror) PICK(row, mirror, 0, 1, 2, 7)
#define LOWER_3(row, mirror) (row)

/* What a sample is: 0 used, 1 no row present, -2 an infinite row (then it counts as missing). */
static __attribute__((noinline)) int some_rows(const double *y, double *e, int *present, int rows)
{
    int i, any = 0, infinite = 0;
    for (i = 0; i < rows; ++i)
    {
        present[i] = (y[i] - y[i]) == 0.0;
        infinite |= !present[i] && (y[i] == y[i]);
        any |= present[i];
    }
    for (i = 0; i < rows; ++i)
    {
        present[i] &= !infinite;
        e[i] = present[i] ? e[i] : 0.0;
    }
    return infinite ? -2 : (any ? 0 : 1);
}

#endif
