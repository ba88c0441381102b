/* SPDX-License-Identifier: MIT-0 */
/* car_speed_selftest_main.c: exit status 0 if car_speed_selftest() passes on this machine. */
#include "car_speed.h"

int main(void)
{
    return (car_speed_selftest() == CAR_SPEED_OK) ? 0 : 1;
}
