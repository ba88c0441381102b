/* What one core can do: flops of independent multiply-adds, and adds that wait for each other, one a cycle. */
#include <stdint.h>

typedef double vec __attribute__((vector_size(32)));

#define TEN(of) of(0) of(1) of(2) of(3) of(4) of(5) of(6) of(7) of(8) of(9)
#define FUSED(i) __asm__ volatile("vfmadd231pd %1, %1, %0" : "+x"(c##i) : "x"(a));
#define APART(i) __asm__ volatile("vmulpd %2, %2, %0\n\tvaddpd %0, %1, %1" : "=&x"(t), "+x"(c##i) : "x"(a));
#define DECLARE(i) vec c##i = { 1.0, 1.0, 1.0, 1.0 };

/* times * 80 flops */
__attribute__((visibility("default"))) double fused(int64_t times)
{
    vec a = { 1e-9, 1e-9, 1e-9, 1e-9 };
    TEN(DECLARE)
    while (times-- > 0) { TEN(FUSED) }
    return c0[0];
}

/* times * 80 flops */
__attribute__((visibility("default"))) double apart(int64_t times)
{
    vec a = { 1e-9, 1e-9, 1e-9, 1e-9 }, t;
    TEN(DECLARE)
    while (times-- > 0) { TEN(APART) }
    return c0[0];
}

/* times * 20 cycles */
#define WAIT(i) __asm__ volatile("add $1, %0\n\tadd $3, %0" : "+r"(n));
__attribute__((visibility("default"))) int64_t cycles(int64_t times)
{
    int64_t n = 0;
    while (times-- > 0) { TEN(WAIT) }
    return n;
}
