/* SPDX-License-Identifier: MIT-0 */
/* soft_fault_cpcf_selftest_main.c: exit status 0 if soft_fault_cpcf_selftest() passes on this
 * machine. */
#include "soft_fault_cpcf.h"

int main(void)
{
    return (soft_fault_cpcf_selftest() == SOFT_FAULT_CPCF_OK) ? 0 : 1;
}
