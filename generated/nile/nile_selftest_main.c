/* SPDX-License-Identifier: MIT-0 */
/* nile_selftest_main.c: exit status 0 if nile_selftest() passes on this machine. */
#include "nile.h"

int main(void)
{
    return (nile_selftest() == NILE_OK) ? 0 : 1;
}
