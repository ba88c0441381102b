/* SPDX-License-Identifier: MIT-0 */
/* battery_selftest_main.c: exit status 0 if battery_selftest() passes on this machine. */
#include "battery.h"

int main(void)
{
    return (battery_selftest() == BATTERY_OK) ? 0 : 1;
}
