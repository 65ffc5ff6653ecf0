#include "aw_current.h"

#define Q8 ((int64_t)256)
#define US_PER_S ((int64_t)1000000)

static int64_t clamped(int64_t value, int64_t lowest, int64_t highest)
{
    int64_t result = (value < lowest) ? lowest : value;

    return (result > highest) ? highest : result;
}

void aw_current_init(aw_current_t *loop, const aw_current_setup_t *setup)
{
    loop->output_q8 = 0;
    loop->ki_q8 = ((int64_t)setup->ki_uV_mAs * setup->period_us * Q8) / US_PER_S;
    loop->kp_uV_mA = setup->kp_uV_mA;
    loop->before_mA = 0;
    loop->target_mA = 0;
    loop->is_limited = false;
}

/* The next output of the PI for a current whose target was `before_mA`. */
static int64_t towards(const aw_current_t *loop, int32_t target_mA, int32_t before_mA, int32_t measured_mA)
{
    const int64_t error_mA = (int64_t)target_mA - measured_mA;
    const int64_t error_before_mA = (int64_t)before_mA - loop->before_mA;

    return loop->output_q8 + ((int64_t)loop->kp_uV_mA * (error_mA - error_before_mA) * Q8) + (loop->ki_q8 * error_mA);
}

int32_t aw_current_step(aw_current_t *loop, aw_output_t wanted, int32_t limit_mA, int32_t most_uV, int32_t measured_mA)
{
    const int64_t most_q8 = (int64_t)most_uV * Q8;
    int64_t next_q8 = 0;

    int32_t target_mA = measured_mA;

    loop->is_limited = false;
    if (wanted.kind == AW_OUTPUT_CURRENT) {
        target_mA = (int32_t)clamped(wanted.value, -(int64_t)limit_mA, limit_mA);
        next_q8 = towards(loop, target_mA, loop->target_mA, measured_mA);
    } else if (wanted.kind == AW_OUTPUT_VOLTAGE) {
        const int64_t wanted_q8 = (int64_t)wanted.value * Q8;
        next_q8 = clamped(wanted_q8, towards(loop, -limit_mA, -limit_mA, measured_mA),
                          towards(loop, limit_mA, limit_mA, measured_mA));
        loop->is_limited = (next_q8 != wanted_q8);
    } else {
        /* open: the next drive begins at 0 V */
    }
    loop->output_q8 = clamped(next_q8, -most_q8, most_q8);
    loop->before_mA = measured_mA;
    loop->target_mA = target_mA;
    return (int32_t)(loop->output_q8 / Q8);
}
