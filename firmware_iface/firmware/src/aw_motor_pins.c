/* Digital pins: levels while enabled, safe levels otherwise (docs/motor_board.md, Digital pins). */
#include "aw_motor_parts.h"

static uint8_t value_of(const aw_motor_board_t *board, uint8_t row)
{
    return (uint8_t)((uint32_t)board->values[row] & 0xFFu);
}

uint8_t aw_motor_pin_outputs(const aw_motor_board_t *board)
{
    return value_of(board, (uint8_t)DIGITAL_OUTPUTS);
}

uint8_t aw_motor_pin_levels(const aw_motor_board_t *board)
{
    return (uint8_t)(board->driven & aw_motor_pin_outputs(board));
}

void aw_pins_safe(aw_motor_board_t *board)
{
    const uint8_t keep = value_of(board, (uint8_t)DIGITAL_SAFE_KEEP);
    const uint8_t levels = value_of(board, (uint8_t)DIGITAL_SAFE_LEVELS);

    board->driven = (uint8_t)((board->driven & keep) | (levels & (uint8_t)~keep));
}

void aw_pins_command(aw_motor_board_t *board, const uint8_t *command, const aw_motor_inputs_t *now, uint8_t *reply)
{
    const uint8_t outputs = aw_motor_pin_outputs(board);
    const uint8_t pins = (uint8_t)((1uL << board->setup.digital_pins) - 1uL);
    const bool is_enabled = (board->state == AW_ENABLED);

    if (is_enabled) {
        const uint8_t mask = (uint8_t)(command[1] & outputs);
        board->driven = (uint8_t)((board->driven & (uint8_t)~mask) | (command[2] & mask));
    }
    reply[0] = command[0];
    reply[1] = (uint8_t)(aw_motor_pin_levels(board) | (now->pin_levels & (uint8_t)~outputs & pins));
    reply[2] = aw_motor_pin_levels(board);
    reply[3] = (uint8_t)(is_enabled ? 0u : 1u);
}
