/* SPDX-License-Identifier: MIT-0 */
/* sensor_faults_1_selftest_main.c: exit status 0 if sensor_faults_1_selftest() passes on this
 * machine. */
#include "sensor_faults_1.h"

int main(void)
{
    return (sensor_faults_1_selftest() == SENSOR_FAULTS_1_OK) ? 0 : 1;
}
