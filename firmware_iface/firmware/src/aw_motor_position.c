/* The position PID on the board's own count, and the stop without the host (docs/motor_board.md, COMMAND and Faults).
 *
 * Ranges: gains below 2^31; count errors within 2^31; speeds are cut at 2^24 counts/s (the quadrature inputs of common
 * microcontrollers stay below); steps are cut at 10 ms. No product below can overflow 64 bits.
 */
#include "aw_bytes.h"
#include "aw_motor_parts.h"

#define SPEED_MOST ((int64_t)1 << 24u) /* counts/s */
#define Q4 ((int64_t)16)
#define Q8 ((int64_t)256)
#define Q8_TO_Q24 ((int64_t)65536)
#define Q24_TO_Q4 ((int64_t)1048576)
#define STEP_MOST_US 10000u
#define INTEGRAL_RATE_MOST ((int64_t)1 << 48u) /* uV/s; far beyond what a period of 20 us needs to reach 60 V */
#define PV_PER_UV ((int64_t)1000000)
#define PV_PER_MV ((int64_t)1000000000)
#define UV_PER_MV ((int64_t)1000)
#define US_PER_S ((int64_t)1000000)
#define US_PER_MS ((int64_t)1000)

typedef struct {
    uint32_t count;
    int64_t speed_q4; /* counts/s * 16 */
} set_t;

static int64_t limited(int64_t value, int64_t most)
{
    int64_t result = value;

    if (value > most) {
        result = most;
    } else if (value < -most) {
        result = -most;
    } else {
        /* within */
    }
    return result;
}

static int64_t rounded(int64_t value, int64_t divisor)
{
    return ((value >= 0) ? (value + (divisor / 2)) : (value - (divisor / 2))) / divisor;
}

void aw_position_measure(aw_motor_board_t *board, const aw_motor_inputs_t *now, uint32_t step_us)
{
    const int64_t edges = (int64_t)aw_signed32(now->counter - board->counter);
    const int64_t step = (int64_t)((step_us < STEP_MOST_US) ? step_us : STEP_MOST_US);

    if (step > 0) {
        const int64_t rate_q24 = limited((edges * US_PER_S * Q8) / (int64_t)step_us, SPEED_MOST * Q8) * Q8_TO_Q24;
        const int64_t filter = (int64_t)board->values[DERIVATIVE_FILTER_US];
        board->position.speed_q24 += ((rate_q24 - board->position.speed_q24) * step) / (step + filter);
    }
    board->counter = now->counter;
}

/* The set-point and its speed: the host's, or that of a stop, c + v (t - t^2/2T) and v (1 - t/T). */
static set_t set_of(aw_motor_board_t *board, uint32_t now_us)
{
    aw_position_t *position = &board->position;
    set_t set = {position->setpoint, 0};

    if (position->is_stopping) {
        const int64_t whole_us = (int64_t)board->values[STOP_TIME_MS] * US_PER_MS;
        const uint32_t since_us = now_us - position->stop_us;
        const int64_t t_us = ((int64_t)since_us < whole_us) ? (int64_t)since_us : whole_us;
        const int64_t way_ns = (t_us * ((2 * whole_us) - t_us) * 1000) / (2 * whole_us);
        const int64_t way = rounded(position->stop_speed_q4 * way_ns, Q4 * US_PER_S * 1000);
        set.count = position->stop_count + (uint32_t)way;
        set.speed_q4 = (position->stop_speed_q4 * (whole_us - t_us)) / whole_us;
        if (t_us == whole_us) { /* at rest for good: the clock wraps after 71 min, and the arm may be held for longer */
            position->stop_count = set.count;
            position->stop_speed_q4 = 0;
        }
    }
    return set;
}

void aw_position_control(aw_motor_board_t *board, const aw_motor_inputs_t *now, uint32_t step_us)
{
    aw_position_t *position = &board->position;
    const int32_t *values = board->values;
    const set_t set = set_of(board, board->ticked_us);
    const int64_t error = (int64_t)aw_signed32(set.count - aw_motor_count(board, now->counter));
    const int64_t speed_q4 = position->speed_q24 / Q24_TO_Q4;
    const int64_t damping_nV_q4 = (int64_t)values[KD] * (set.speed_q4 - speed_q4);
    const int64_t feed_nV_q4 = (int64_t)values[SPEED_FEEDFORWARD] * set.speed_q4;
    const int64_t wanted_uV = ((int64_t)values[KP] * error) + (position->integral_pV / PV_PER_UV)
        + ((damping_nV_q4 + feed_nV_q4) / (Q4 * 1000)) + ((int64_t)position->feedforward_mV * UV_PER_MV);
    const int64_t output_uV = (int64_t)aw_motor_clamped_uV(board, wanted_uV, now);
    const int64_t step = (int64_t)((step_us < STEP_MOST_US) ? step_us : STEP_MOST_US);
    const int64_t change_pV = limited((int64_t)values[KI] * error, INTEGRAL_RATE_MOST) * step;
    const bool is_pushing = ((wanted_uV > output_uV) && (change_pV > 0)) || ((wanted_uV < output_uV) && (change_pV < 0));

    if (!is_pushing) {
        position->integral_pV =
            limited(position->integral_pV + change_pV, (int64_t)values[INTEGRAL_LIMIT_MV] * PV_PER_MV);
    }
    board->output.kind = AW_OUTPUT_VOLTAGE;
    board->output.value = (int32_t)output_uV;
}

void aw_position_begin_stop(aw_motor_board_t *board, const aw_motor_inputs_t *now)
{
    aw_position_t *position = &board->position;

    if (board->values[KP] == 0) {
        board->output = (aw_output_t){AW_OUTPUT_VOLTAGE, 0};
        board->is_cut = false;
    } else {
        position->stop_us = now->time_us;
        position->stop_count = aw_motor_count(board, now->counter);
        position->stop_speed_q4 = position->speed_q24 / Q24_TO_Q4;
        position->integral_pV = 0;
        if (board->output.kind == AW_OUTPUT_VOLTAGE) { /* so that the output does not jump */
            const int64_t feed_uV = ((int64_t)board->values[SPEED_FEEDFORWARD] * position->stop_speed_q4) / (Q4 * 1000);
            position->integral_pV = limited((int64_t)board->output.value - feed_uV, (int64_t)1 << 40u) * PV_PER_UV;
        }
        position->feedforward_mV = 0;
        position->is_stopping = true;
        board->holds = true;
    }
}

void aw_position_end_stop(aw_motor_board_t *board)
{
    if (board->position.is_stopping) {
        board->position.is_stopping = false;
        board->position.integral_pV = 0;
    }
    board->holds = false;
}
