/* SPDX-License-Identifier: MIT-0 */
/* wheel_drift_selftest_main.c: exit status 0 if wheel_drift_selftest() passes on this machine. */
#include "wheel_drift.h"

int main(void)
{
    return (wheel_drift_selftest() == WHEEL_DRIFT_OK) ? 0 : 1;
}
