/* Parameters: ranges, access, defaults (docs/motor_board.md, Parameters). */
#include "aw_bytes.h"
#include "aw_motor_parts.h"

#define PROTOCOL 1
#define READ 0u
#define WRITE 1u

#define DONE 0u
#define UNKNOWN_INDEX 1u
#define READ_ONLY 2u
#define OUT_OF_RANGE 3u
#define NOT_IN_THIS_STATE 4u

#define PROTOCOL_VERSION 0u
#define SERIAL_NUMBER 1u
#define FIRMWARE_VERSION 2u
#define COUNTS_PER_TURN 3u
#define POSITION_COUNT 4u
#define CONTROL_PERIOD_US 5u
#define RESET_CAUSE 6u
#define DIGITAL_PINS 48u

#define SHORTEST_WAIT_MS 5 /* of watchdog and stop, which are off at 0 */
#define RATING_MOST_MA 21000

typedef struct {
    uint8_t index;
    int32_t lowest;
    int32_t highest;
    int32_t at_power_up;
} row_t;

static const row_t rows[WRITABLE] = {
    [KP] = {16u, 0, INT32_MAX, 0},
    [KI] = {17u, 0, INT32_MAX, 0},
    [KD] = {18u, 0, INT32_MAX, 0},
    [DERIVATIVE_FILTER_US] = {19u, 0, 1000000, 1000},
    [CURRENT_LIMIT_MA] = {20u, 1, RATING_MOST_MA, RATING_MOST_MA}, /* and the board's rating */
    [VOLTAGE_LIMIT_MV] = {21u, 0, 60000, 24000},
    [INTEGRAL_LIMIT_MV] = {22u, 0, 60000, 0},
    [SPEED_FEEDFORWARD] = {23u, 0, INT32_MAX, 0},
    [WATCHDOG_MS] = {32u, 0, 10000, 200},
    [WATCHDOG_ACTION] = {33u, 0, 2, 1},
    [DISABLED_OUTPUT] = {34u, 0, 1, 1},
    [STOP_AFTER_MS] = {35u, 0, 10000, 0},
    [STOP_TIME_MS] = {36u, 1, 10000, 100},
    [DIGITAL_OUTPUTS] = {49u, 0, 255, 0}, /* and what pins there are */
    [DIGITAL_SAFE_LEVELS] = {50u, 0, 255, 0},
    [DIGITAL_SAFE_KEEP] = {51u, 0, 255, 0},
};

static int32_t highest(const aw_motor_board_t *board, uint8_t row)
{
    int32_t most = rows[row].highest;

    if (row >= (uint8_t)DIGITAL_OUTPUTS) {
        most = (int32_t)((1uL << board->setup.digital_pins) - 1uL);
    } else if ((row == (uint8_t)CURRENT_LIMIT_MA) && (board->setup.rating_mA < most)) {
        most = board->setup.rating_mA;
    }
    return most;
}

/* The row of a writable parameter that this board has; WRITABLE if there is none. */
static uint8_t row_of(const aw_motor_board_t *board, uint8_t index)
{
    const uint8_t last = (uint8_t)((board->setup.digital_pins > 0u) ? WRITABLE : DIGITAL_OUTPUTS);
    uint8_t found = (uint8_t)WRITABLE;

    for (uint8_t row = 0u; row < last; row++) {
        if (rows[row].index == index) {
            found = row;
        }
    }
    return found;
}

/* The value of a parameter; false if the board does not know the index. */
static bool read_value(const aw_motor_board_t *board, uint8_t index, uint32_t counter, int32_t *value)
{
    const uint8_t row = row_of(board, index);
    bool is_known = true;

    *value = 0;
    if (row < (uint8_t)WRITABLE) {
        *value = board->values[row];
    } else if (index == PROTOCOL_VERSION) {
        *value = PROTOCOL;
    } else if (index == SERIAL_NUMBER) {
        *value = aw_signed32(board->setup.serial_number);
    } else if (index == FIRMWARE_VERSION) {
        *value = (int32_t)board->setup.firmware;
    } else if (index == COUNTS_PER_TURN) {
        *value = board->setup.counts_per_turn;
    } else if (index == POSITION_COUNT) {
        *value = aw_signed32(aw_motor_count(board, counter));
    } else if (index == CONTROL_PERIOD_US) {
        *value = (int32_t)board->setup.period_us;
    } else if (index == RESET_CAUSE) {
        *value = (int32_t)board->setup.reset_cause;
    } else if ((index == DIGITAL_PINS) && (board->setup.digital_pins > 0u)) {
        *value = (int32_t)board->setup.digital_pins;
    } else {
        is_known = false;
    }
    return is_known;
}

static bool is_in_range(const aw_motor_board_t *board, uint8_t row, int32_t value)
{
    const bool is_wait = (row == (uint8_t)WATCHDOG_MS) || (row == (uint8_t)STOP_AFTER_MS);
    bool is_so = (value >= rows[row].lowest) && (value <= highest(board, row));

    if (is_wait && (value > 0) && (value < SHORTEST_WAIT_MS)) {
        is_so = false;
    }
    return is_so;
}

static bool may_write(aw_state_t state)
{
    return (state == AW_SWITCH_ON_DISABLED) || (state == AW_READY) || (state == AW_SWITCHED_ON);
}

/* Writes a parameter that the board knows; returns the result. */
static uint8_t write_value(aw_motor_board_t *board, uint8_t index, int32_t value, const aw_motor_inputs_t *now)
{
    const uint8_t row = row_of(board, index);
    const bool is_off = (row == (uint8_t)WATCHDOG_MS) && (value == 0);
    uint8_t result = DONE;

    if ((row == (uint8_t)WRITABLE) && (index != POSITION_COUNT)) {
        result = READ_ONLY;
    } else if ((row < (uint8_t)WRITABLE) && !is_in_range(board, row, value)) {
        result = OUT_OF_RANGE;
    } else if (!may_write(board->state) || (is_off && (board->state != AW_SWITCH_ON_DISABLED))) {
        result = NOT_IN_THIS_STATE;
    } else if (index == POSITION_COUNT) {
        board->zero = (uint32_t)value - now->counter;
    } else {
        board->values[row] = value;
        if (row >= (uint8_t)DIGITAL_OUTPUTS) {
            aw_pins_safe(board);
        }
        aw_motor_apply(board, now);
    }
    return result;
}

uint32_t aw_motor_count(const aw_motor_board_t *board, uint32_t counter)
{
    return counter + board->zero;
}

void aw_motor_defaults(aw_motor_board_t *board)
{
    for (uint8_t row = 0u; row < (uint8_t)WRITABLE; row++) {
        board->values[row] = rows[row].at_power_up;
    }
    board->values[CURRENT_LIMIT_MA] = highest(board, (uint8_t)CURRENT_LIMIT_MA);
}

void aw_motor_parameter(aw_motor_board_t *board, const uint8_t *request, const aw_motor_inputs_t *now, uint8_t *answer)
{
    const uint8_t operation = request[0];
    const uint8_t index = request[1];
    int32_t value;
    uint8_t result = DONE;

    if (!read_value(board, index, now->counter, &value)) {
        result = UNKNOWN_INDEX;
    } else if (operation == WRITE) {
        result = write_value(board, index, aw_signed32(aw_get_u32(&request[4])), now);
        (void)read_value(board, index, now->counter, &value);
    } else if (operation != READ) {
        result = OUT_OF_RANGE;
    } else {
        /* a plain read */
    }
    answer[0] = result;
    answer[1] = index;
    answer[2] = request[2];
    answer[3] = 0u;
    aw_put_u32(&answer[4], (uint32_t)value);
}
