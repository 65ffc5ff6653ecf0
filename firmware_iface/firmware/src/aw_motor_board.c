/* COMMANDs, faults, watchdog and outputs of the motor board (docs/motor_board.md). */
#include "aw_motor_board.h"

#include <string.h>

#include "aw_bytes.h"
#include "aw_motor_parts.h"

#define EMERGENCY_STOP_ID 0x000u
#define COMMAND_ID 0x100u
#define REPLY_ID 0x180u
#define REQUEST_ID 0x200u
#define ANSWER_ID 0x280u
#define DIGITAL_COMMAND_ID 0x300u
#define DIGITAL_REPLY_ID 0x380u

#define VOLTAGE_ENABLED 0x10u
#define WARNING 0x80u
#define MODE_MASK 0x07u
#define PROTOCOL 1u

#define TRIP_US 1000u          /* an over-current that lasts as long is a fault */
#define ACTION_OPEN 0
#define ACTION_HOLD 2
#define US_PER_MS 1000u

static const aw_output_t open_circuit = {AW_OUTPUT_OPEN, 0};
static const aw_output_t brake = {AW_OUTPUT_VOLTAGE, 0};

/* Outputs go to their safe levels at once on leaving OPERATION ENABLED. */
static void enter(aw_motor_board_t *board, aw_state_t state)
{
    if ((board->state == AW_ENABLED) && (state != AW_ENABLED)) {
        aw_pins_safe(board);
    }
    board->state = state;
}

static void put(aw_motor_board_t *board, aw_output_t output)
{
    aw_position_end_stop(board);
    board->output = output;
    board->is_cut = false;
}

static void fault(aw_motor_board_t *board, uint8_t bits)
{
    const bool is_first = (board->state != AW_FAULT) && (board->state != AW_FAULT_REACTION);
    const bool is_stop = (bits & AW_EMERGENCY_STOP) != 0u;

    board->faults |= bits;
    if (is_first || is_stop) {
        enter(board, AW_FAULT_REACTION);
    }
    if ((bits & AW_OVER_CURRENT) != 0u) {
        put(board, open_circuit);
    } else if (is_first || (is_stop && ((board->faults & AW_OVER_CURRENT) == 0u))) {
        put(board, brake);
    } else {
        /* the output is that of the first fault */
    }
}

/* Faults whose cause is there now. */
static uint8_t causes(const aw_motor_board_t *board, const aw_motor_inputs_t *now)
{
    uint8_t found = now->causes;

    if (board->is_over_current && ((now->time_us - board->over_current_us) >= TRIP_US)) {
        found |= AW_OVER_CURRENT;
    }
    if (now->temperature_mdegC > board->setup.rated_mdegC) {
        found |= AW_OVER_TEMPERATURE;
    }
    if ((now->supply_mV < board->setup.lowest_supply_mV) && (board->state == AW_ENABLED)) {
        found |= AW_UNDER_VOLTAGE;
    }
    if (now->supply_mV > board->setup.highest_supply_mV) {
        found |= AW_OVER_VOLTAGE;
    }
    return found;
}

/* Notes since when the current is beyond 1.5 times its limit. */
static void watch_current(aw_motor_board_t *board, const aw_motor_inputs_t *now)
{
    const int32_t trip_mA = board->values[CURRENT_LIMIT_MA] + (board->values[CURRENT_LIMIT_MA] / 2);
    const bool is_beyond = (now->current_mA > trip_mA) || (now->current_mA < -trip_mA);

    if (is_beyond && !board->is_over_current) {
        board->over_current_us = now->time_us;
    }
    board->is_over_current = is_beyond;
}

int32_t aw_motor_clamped_uV(aw_motor_board_t *board, int64_t wanted_uV, const aw_motor_inputs_t *now)
{
    int32_t limit_mV = board->values[VOLTAGE_LIMIT_MV];
    int64_t limit_uV;
    int64_t result = wanted_uV;

    if (limit_mV > now->supply_mV) {
        limit_mV = (now->supply_mV > 0) ? now->supply_mV : 0;
    }
    limit_uV = (int64_t)limit_mV * 1000;
    board->is_cut = (wanted_uV > limit_uV) || (wanted_uV < -limit_uV);
    if (board->is_cut) {
        result = (wanted_uV > 0) ? limit_uV : -limit_uV;
    }
    return (int32_t)result;
}

static void apply_current(aw_motor_board_t *board)
{
    const int32_t limit_mA = board->values[CURRENT_LIMIT_MA];
    const int32_t wanted_mA = aw_signed32(board->position.setpoint);
    int32_t result = wanted_mA;

    board->is_cut = (wanted_mA > limit_mA) || (wanted_mA < -limit_mA);
    if (board->is_cut) {
        result = (wanted_mA > 0) ? limit_mA : -limit_mA;
    }
    board->output = (aw_output_t){AW_OUTPUT_CURRENT, result};
}

static void apply_mode(aw_motor_board_t *board, const aw_motor_inputs_t *now)
{
    if (board->mode == MODE_OFF) {
        board->output = open_circuit;
    } else if (board->mode == MODE_VOLTAGE) {
        const int64_t wanted_uV = (int64_t)aw_signed32(board->position.setpoint) * 1000;
        board->output.value = aw_motor_clamped_uV(board, wanted_uV, now);
        board->output.kind = AW_OUTPUT_VOLTAGE;
    } else if (board->mode == MODE_CURRENT) {
        apply_current(board);
    } else {
        aw_position_control(board, now, 0u);
    }
}

void aw_motor_apply(aw_motor_board_t *board, const aw_motor_inputs_t *now)
{
    board->is_cut = false;
    if (board->state == AW_ENABLED) {
        apply_mode(board, now);
    } else if (board->state == AW_QUICK_STOP) {
        board->output = brake;
    } else if ((board->state != AW_FAULT) && (board->state != AW_FAULT_REACTION)) {
        board->output = (board->values[DISABLED_OUTPUT] != 0) ? brake : open_circuit;
    } else {
        /* a fault keeps its output */
    }
}

/* At most one transition. A fault whose cause lasts is not reset. */
static void transition(aw_motor_board_t *board, uint8_t controlword, const aw_motor_inputs_t *now)
{
    const aw_state_t next = aw_motor_next_state(board->state, controlword, board->controlword);
    bool may = (next != board->state);

    board->controlword = controlword;
    if (may && (board->state == AW_FAULT)) {
        board->faults = causes(board, now);
        may = (board->faults == 0u);
    }
    if (may) {
        aw_position_end_stop(board);
        board->position.integral_pV = 0;
        board->mode = MODE_OFF;
        enter(board, next);
        aw_motor_apply(board, now);
    }
}

/* Mode, set-point and feed-forward in OPERATION ENABLED. */
static void take_mode(aw_motor_board_t *board, uint8_t mode, const uint8_t *payload, const aw_motor_inputs_t *now)
{
    if (mode == MODE_HOLD) {
        if ((board->mode != MODE_HOLD) && !board->position.is_stopping) {
            aw_position_begin_stop(board, now);
        }
        board->mode = mode;
    } else {
        aw_position_end_stop(board);
        if (mode != board->mode) {
            board->position.integral_pV = 0;
        }
        board->mode = mode;
        board->position.setpoint = aw_get_u32(&payload[2]);
        board->position.feedforward_mV =
            (int32_t)aw_signed16((uint16_t)((uint32_t)payload[6] | ((uint32_t)payload[7] << 8u)));
        aw_motor_apply(board, now);
    }
}

static int32_t within(int32_t value, int32_t lowest, int32_t highest)
{
    int32_t result = (value < lowest) ? lowest : value;

    return (result > highest) ? highest : result;
}

static void reply(const aw_motor_board_t *board, uint8_t mode_and_sequence, const aw_motor_inputs_t *now, uint8_t *data)
{
    const bool is_in_range =
        (now->supply_mV >= board->setup.lowest_supply_mV) && (now->supply_mV <= board->setup.highest_supply_mV);
    const int32_t above_mdegC = within(now->temperature_mdegC, -128000, 127000) + 128500; /* rounded, never negative */
    uint8_t status = (uint8_t)board->state;

    status |= is_in_range ? VOLTAGE_ENABLED : 0u;
    status |= (now->is_limited || board->is_cut) ? WARNING : 0u;
    data[0] = status;
    data[1] = mode_and_sequence;
    aw_put_u16(&data[2], (uint16_t)((uint32_t)within(now->mean_mA, -32767, 32767) & 0xFFFFu));
    aw_put_u16(&data[4], (uint16_t)within(now->supply_mV, 0, 65535));
    data[6] = (uint8_t)((uint32_t)((above_mdegC / 1000) - 128) & 0xFFu);
    data[7] = board->faults;
}

static void command(aw_motor_board_t *board, const uint8_t *payload, const aw_motor_inputs_t *now, uint8_t *data)
{
    const uint8_t mode = (uint8_t)(payload[1] & MODE_MASK);

    board->commanded_us = now->time_us;
    if (mode > MODE_HOLD) {
        board->controlword = payload[0];
        if (board->state != AW_NOT_READY) {
            fault(board, AW_BAD_COMMAND);
        }
    } else {
        transition(board, payload[0], now);
        if (board->state == AW_ENABLED) {
            take_mode(board, mode, payload, now);
        }
    }
    reply(board, payload[1], now, data);
}

void aw_motor_init(aw_motor_board_t *board, const aw_motor_setup_t *setup, const aw_motor_inputs_t *now)
{
    (void)memset(board, 0, sizeof *board);
    board->setup = *setup;
    board->state = AW_NOT_READY;
    board->output = open_circuit;
    board->controlword = 0x80u; /* a host that holds fault reset acknowledges nothing */
    board->zero = 0u - now->counter;
    board->counter = now->counter;
    aw_motor_defaults(board);
}

bool aw_motor_receive(aw_motor_board_t *board, const aw_can_frame_t *frame, const aw_motor_inputs_t *now,
                      aw_can_frame_t *answer)
{
    const uint16_t node = board->setup.node;
    bool is_answered = false;

    (void)memset(answer, 0, sizeof *answer);
    answer->size = AW_CAN_BYTES;
    if (frame->id == EMERGENCY_STOP_ID) {
        fault(board, AW_EMERGENCY_STOP);
    } else if (frame->size != AW_CAN_BYTES) {
        /* not of this protocol */
    } else if (frame->id == (COMMAND_ID + node)) {
        answer->id = (uint16_t)(REPLY_ID + node);
        command(board, frame->data, now, answer->data);
        is_answered = true;
    } else if (frame->id == (REQUEST_ID + node)) {
        answer->id = (uint16_t)(ANSWER_ID + node);
        aw_motor_parameter(board, frame->data, now, answer->data);
        is_answered = true;
    } else if ((frame->id == (DIGITAL_COMMAND_ID + node)) && (board->setup.digital_pins > 0u)) {
        answer->id = (uint16_t)(DIGITAL_REPLY_ID + node);
        aw_pins_command(board, frame->data, now, answer->data);
        is_answered = true;
    } else {
        /* another board's */
    }
    return is_answered;
}

/* The watchdog expired: its action, then FAULT, which keeps that output. */
static void expire(aw_motor_board_t *board, const aw_motor_inputs_t *now)
{
    const int32_t action = board->values[WATCHDOG_ACTION];
    const bool was_stopping = board->position.is_stopping;
    const aw_position_t position = board->position;

    fault(board, AW_WATCHDOG);
    if (action == ACTION_OPEN) {
        board->output = open_circuit;
    } else if ((action == ACTION_HOLD) && (board->values[KP] > 0)) {
        board->holds = true;
        if (was_stopping) {
            board->position = position;
        } else {
            board->position.setpoint = aw_motor_count(board, now->counter);
            board->position.feedforward_mV = 0;
            board->position.integral_pV = 0;
        }
    } else {
        /* the brake, as for every fault */
    }
}

static void watch_host(aw_motor_board_t *board, const aw_motor_inputs_t *now)
{
    const uint32_t silent_us = now->time_us - board->commanded_us;
    const uint32_t watchdog_us = (uint32_t)board->values[WATCHDOG_MS] * US_PER_MS;
    const uint32_t stop_us = (uint32_t)board->values[STOP_AFTER_MS] * US_PER_MS;
    const bool is_driven = (board->mode == MODE_VOLTAGE) || (board->mode == MODE_CURRENT);

    if ((watchdog_us > 0u) && (silent_us >= watchdog_us)) {
        expire(board, now);
    } else if ((stop_us > 0u) && (silent_us >= stop_us) && is_driven && !board->position.is_stopping) {
        aw_position_begin_stop(board, now);
    } else {
        /* the host is there */
    }
}

static void announce(const aw_motor_board_t *board, aw_can_frame_t *announcement)
{
    (void)memset(announcement, 0, sizeof *announcement);
    announcement->id = (uint16_t)(ANSWER_ID + board->setup.node);
    announcement->size = AW_CAN_BYTES;
    announcement->data[4] = PROTOCOL;
}

bool aw_motor_tick(aw_motor_board_t *board, const aw_motor_inputs_t *now, aw_can_frame_t *announcement)
{
    const uint32_t step_us = board->has_ticked ? (now->time_us - board->ticked_us) : board->setup.period_us;
    const bool is_starting = (board->state == AW_NOT_READY);

    board->ticked_us = now->time_us;
    board->has_ticked = true;
    watch_current(board, now);
    aw_position_measure(board, now, step_us);
    if (is_starting) {
        enter(board, AW_SWITCH_ON_DISABLED);
        aw_motor_apply(board, now);
        announce(board, announcement);
    } else {
        uint8_t found;
        if (board->state == AW_FAULT_REACTION) {
            enter(board, AW_FAULT);
        } else if (board->state == AW_ENABLED) {
            watch_host(board, now);
        } else {
            /* nothing by itself */
        }
        found = (uint8_t)(causes(board, now) & (uint8_t)~board->faults);
        if (found != 0u) {
            fault(board, found);
        }
        if (board->holds || ((board->state == AW_ENABLED) && (board->mode == MODE_POSITION))) {
            aw_position_control(board, now, step_us);
        }
    }
    return is_starting;
}

aw_output_t aw_motor_output(const aw_motor_board_t *board)
{
    return board->output;
}

int32_t aw_motor_voltage_limit_mV(const aw_motor_board_t *board)
{
    return board->values[VOLTAGE_LIMIT_MV];
}

int32_t aw_motor_current_limit_mA(const aw_motor_board_t *board)
{
    return board->values[CURRENT_LIMIT_MA];
}

aw_state_t aw_motor_state(const aw_motor_board_t *board)
{
    return board->state;
}

uint8_t aw_motor_faults(const aw_motor_board_t *board)
{
    return board->faults;
}
