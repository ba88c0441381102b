/* SPDX-License-Identifier: MIT-0 */
/* soft_fault_dfcf_selftest_main.c: exit status 0 if soft_fault_dfcf_selftest() passes on this
 * machine. */
#include "soft_fault_dfcf.h"

int main(void)
{
    return (soft_fault_dfcf_selftest() == SOFT_FAULT_DFCF_OK) ? 0 : 1;
}
