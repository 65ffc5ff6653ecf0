/* The fast loop: holds a current, or a voltage within a limit of the current. Called once a PWM period.
 *
 * A PI in its incremental form: the integral is the last output, so nothing winds up while a limit acts. With
 * kp = L w and ki = R w (the motor's inductance and resistance) the current follows as a first-order lag of bandwidth w;
 * w is at most a tenth of the PWM's angular frequency.
 */
#ifndef AW_CURRENT_H
#define AW_CURRENT_H

#include "aw_motor_board.h"

typedef struct {
    int32_t kp_uV_mA;  /* L w; 1 mH and 1 kHz: 6283 */
    int32_t ki_uV_mAs; /* R w; 1 ohm and 1 kHz: 6283185 */
    int32_t period_us; /* of the PWM, 20 ... 200 */
} aw_current_setup_t;

typedef struct {
    int64_t output_q8; /* uV * 256 */
    int64_t ki_q8;     /* uV / mA * 256 a period */
    int32_t kp_uV_mA;
    int32_t before_mA;
    int32_t target_mA; /* of the last period: what was measured, unless a current was wanted */
    bool is_limited; /* the last voltage was cut back to hold the current's limit */
} aw_current_t;

void aw_current_init(aw_current_t *loop, const aw_current_setup_t *setup);

/* The voltage of the next period in uV, within +-most_uV (voltage limit and supply); 0 for an open output, which the
 * bridge must open by itself. `measured_mA` is the current of the last period. */
int32_t aw_current_step(aw_current_t *loop, aw_output_t wanted, int32_t limit_mA, int32_t most_uV, int32_t measured_mA);

#endif
