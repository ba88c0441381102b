/* A motor's estimator: reads samples as they come, filters them, hands the estimate on.
 *
 * On a board the timer of the control loop takes the place of host_read(), ADC and encoder that of the file.
 */
#include "motor.h"
#include "semihosting.h"

/* As it comes from the logger: the tachometer gives NaN where there is no pulse. */
typedef struct
{
    float voltage;
    float tacho;
} sample_t;

/* What the controller wants to know. */
typedef struct
{
    float current;
    float speed;
    float speed_variance;
    int32_t status;
} estimate_t;

static motor_t filter;

int main(void)
{
    static const char samples[] = "samples.bin", estimates[] = "estimates.bin";
    const int from = host_open(samples, sizeof(samples) - 1u, 1u);
    const int to = host_open(estimates, sizeof(estimates) - 1u, 5u);
    sample_t now;
    if ((from < 0) || (to < 0))
    {
        host_print("no files\n");
        return 1;
    }
    if (motor_selftest() != MOTOR_OK) /* with the flags of the product */
    {
        host_print("self-test failed\n");
        return 2;
    }
    if (motor_init(&filter) != MOTOR_OK)
    {
        return 3;
    }
    while (host_read(from, &now, sizeof(now)) == 0)
    {
        const float u[MOTOR_NU] = { now.voltage };
        const float y[MOTOR_NY] = { now.tacho };
        const motor_status_t status = motor_step(&filter, u, y, MOTOR_VALID_TACHO);
        estimate_t found;
        found.current = filter.filtered_state[MOTOR_STATE_CURRENT];
        found.speed = filter.filtered_state[MOTOR_STATE_SPEED];
        found.speed_variance = filter.filtered_covariance[MOTOR_P(MOTOR_STATE_SPEED, MOTOR_STATE_SPEED)];
        found.status = (int32_t)status;
        if (host_write(to, &found, sizeof(found)) != 0)
        {
            return 4;
        }
    }
    host_print("done\n");
    return 0;
}
