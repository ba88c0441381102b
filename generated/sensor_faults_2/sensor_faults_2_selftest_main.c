/* SPDX-License-Identifier: MIT-0 */
/* sensor_faults_2_selftest_main.c: exit status 0 if sensor_faults_2_selftest() passes on this
 * machine. */
#include "sensor_faults_2.h"

int main(void)
{
    return (sensor_faults_2_selftest() == SENSOR_FAULTS_2_OK) ? 0 : 1;
}
