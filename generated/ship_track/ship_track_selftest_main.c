/* SPDX-License-Identifier: MIT-0 */
/* ship_track_selftest_main.c: exit status 0 if ship_track_selftest() passes on this machine. */
#include "ship_track.h"

int main(void)
{
    return (ship_track_selftest() == SHIP_TRACK_OK) ? 0 : 1;
}
