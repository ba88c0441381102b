/* SPDX-License-Identifier: MIT-0 */
/* dc_motor_known_selftest_main.c: exit status 0 if dc_motor_known_selftest() passes on this
 * machine. */
#include "dc_motor_known.h"

int main(void)
{
    return (dc_motor_known_selftest() == DC_MOTOR_KNOWN_OK) ? 0 : 1;
}
