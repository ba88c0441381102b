/* SPDX-License-Identifier: MIT-0 */
/* fault_effect_a_selftest_main.c: exit status 0 if fault_effect_a_selftest() passes on this
 * machine. */
#include "fault_effect_a.h"

int main(void)
{
    return (fault_effect_a_selftest() == FAULT_EFFECT_A_OK) ? 0 : 1;
}
