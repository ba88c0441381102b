/* SPDX-License-Identifier: MIT-0 */
/* dc_motor_unknown_selftest_main.c: exit status 0 if dc_motor_unknown_selftest() passes on this
 * machine. */
#include "dc_motor_unknown.h"

int main(void)
{
    return (dc_motor_unknown_selftest() == DC_MOTOR_UNKNOWN_OK) ? 0 : 1;
}
