/* SPDX-License-Identifier: MIT-0 */
/* late_gps_selftest_main.c: exit status 0 if late_gps_selftest() passes on this machine. */
#include "late_gps.h"

int main(void)
{
    return (late_gps_selftest() == LATE_GPS_OK) ? 0 : 1;
}
