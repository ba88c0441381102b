/* SPDX-License-Identifier: MIT-0 */
/* range_bearing_selftest_main.c: exit status 0 if range_bearing_selftest() passes on this
 * machine. */
#include "range_bearing.h"

int main(void)
{
    return (range_bearing_selftest() == RANGE_BEARING_OK) ? 0 : 1;
}
