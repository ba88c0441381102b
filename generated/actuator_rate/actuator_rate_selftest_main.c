/* SPDX-License-Identifier: MIT-0 */
/* actuator_rate_selftest_main.c: exit status 0 if actuator_rate_selftest() passes on this
 * machine. */
#include "actuator_rate.h"

int main(void)
{
    return (actuator_rate_selftest() == ACTUATOR_RATE_OK) ? 0 : 1;
}
