/* What the files of the motor board share with each other. */
#ifndef AW_MOTOR_PARTS_H
#define AW_MOTOR_PARTS_H

#include "aw_motor_board.h"

#define MODE_OFF 0u
#define MODE_VOLTAGE 1u
#define MODE_CURRENT 2u
#define MODE_POSITION 3u
#define MODE_HOLD 4u

#define NODE_MOST 15u

/* Writable parameters, by their place in aw_motor_board_t.values. The count is kept apart. */
enum {
    KP,
    KI,
    KD,
    DERIVATIVE_FILTER_US,
    CURRENT_LIMIT_MA,
    VOLTAGE_LIMIT_MV,
    INTEGRAL_LIMIT_MV,
    SPEED_FEEDFORWARD,
    WATCHDOG_MS,
    WATCHDOG_ACTION,
    DISABLED_OUTPUT,
    STOP_AFTER_MS,
    STOP_TIME_MS,
    DIGITAL_OUTPUTS,
    DIGITAL_SAFE_LEVELS,
    DIGITAL_SAFE_KEEP,
    WRITABLE
};

/* aw_motor_states.c: the state after a controlword; `before` is that of the last COMMAND. */
aw_state_t aw_motor_next_state(aw_state_t state, uint8_t controlword, uint8_t before);

/* aw_motor_parameters.c */
void aw_motor_defaults(aw_motor_board_t *board);
void aw_motor_parameter(aw_motor_board_t *board, const uint8_t *request, const aw_motor_inputs_t *now, uint8_t *answer);

/* aw_motor_position.c */
void aw_position_measure(aw_motor_board_t *board, const aw_motor_inputs_t *now, uint32_t step_us);
void aw_position_control(aw_motor_board_t *board, const aw_motor_inputs_t *now, uint32_t step_us);
void aw_position_begin_stop(aw_motor_board_t *board, const aw_motor_inputs_t *now);
void aw_position_end_stop(aw_motor_board_t *board);

/* aw_motor_pins.c */
void aw_pins_safe(aw_motor_board_t *board);
void aw_pins_command(aw_motor_board_t *board, const uint8_t *command, const aw_motor_inputs_t *now, uint8_t *reply);

/* aw_motor_board.c */
void aw_motor_apply(aw_motor_board_t *board, const aw_motor_inputs_t *now);
int32_t aw_motor_clamped_uV(aw_motor_board_t *board, int64_t wanted_uV, const aw_motor_inputs_t *now);

#endif
