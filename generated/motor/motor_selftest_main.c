/* SPDX-License-Identifier: MIT-0 */
/* motor_selftest_main.c: exit status 0 if motor_selftest() passes on this machine. */
#include "motor.h"

int main(void)
{
    return (motor_selftest() == MOTOR_OK) ? 0 : 1;
}
