/* attitude_selftest_main.c: exit status 0 if attitude_selftest() passes on this machine. */
#include "attitude.h"

int main(void)
{
    return (attitude_selftest() == ATTITUDE_OK) ? 0 : 1;
}
