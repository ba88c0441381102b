/* SPDX-License-Identifier: MIT-0 */
/* gps_glitch_selftest_main.c: exit status 0 if gps_glitch_selftest() passes on this machine. */
#include "gps_glitch.h"

int main(void)
{
    return (gps_glitch_selftest() == GPS_GLITCH_OK) ? 0 : 1;
}
