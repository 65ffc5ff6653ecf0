#include "aw_encoder_board.h"

#include <string.h>

#include "aw_bytes.h"

#define PROTOCOL 1u
#define POLL 0x01u
#define STREAM 0x02u
#define SET_ZERO 0x03u
#define ARM_INDEX 0x04u
#define IDENTIFY 0x05u
#define REPORT 0x81u
#define IDENTITY 0x82u
#define ACK 0x83u
#define INDEX 0x84u

#define DONE 0u
#define UNKNOWN_REQUEST 1u
#define BAD_ARGUMENT 2u
#define NOT_POSSIBLE_NOW 3u

#define DISARM 0u
#define ARM 1u
#define SEND_AGAIN 2u

#define HEAD 2u             /* type, sequence */
#define REPORT_SIZE 21u     /* with type and sequence, without CRC */
#define IDENTITY_SIZE 24u
#define ACK_SIZE 4u
#define INDEX_SIZE 11u
#define REPORT_BITS 250u    /* of a REPORT on the line */
#define LONGEST_PERIOD_US 1000000u
#define INPUT_FLAGS (AW_INDEX_LEVEL | AW_HOME | AW_SIGNAL_LOST)

/* Drops the oldest REPORT that waits; the newest frame where none does, which a host that waits for answers never sees. */
static void make_room(aw_encoder_board_t *board)
{
    uint8_t at = 0u;

    while ((at < (board->queued - 1u)) && !board->queue[at].is_report) {
        at++;
    }
    board->queued--;
    for (; at < board->queued; at++) {
        board->queue[at] = board->queue[at + 1u];
    }
}

/* Queues a frame; its sequence is counted even if it is dropped later, so that the host sees the gap. */
static void send(aw_encoder_board_t *board, uint8_t type, uint8_t *content, size_t size)
{
    aw_encoder_frame_t *frame;

    if (board->queued >= AW_ENCODER_QUEUE) {
        make_room(board);
    }
    frame = &board->queue[board->queued];
    board->queued++;
    content[0] = type;
    content[1] = board->sequence;
    board->sequence = (uint8_t)((board->sequence + 1u) & 0xFFu);
    frame->is_report = (type == REPORT);
    frame->size = (uint8_t)aw_frame_encode(content, size, frame->wire);
}

/* Two's complement of a count: from the channel's zero, sign-extended from the counter's width. */
static uint32_t count_of(const aw_encoder_board_t *board, uint8_t at, uint32_t counter)
{
    const uint8_t unused = (uint8_t)(32u - board->setup.encoder_bits);
    uint32_t count = counter + board->channel[at].zero;

    if (unused > 0u) {
        const uint32_t sign = 1uL << (board->setup.encoder_bits - 1u);
        count &= UINT32_MAX >> unused;
        count = (count ^ sign) - sign;
    }
    return count;
}

static void send_report(aw_encoder_board_t *board, uint32_t time_us, const aw_encoder_inputs_t *inputs)
{
    uint8_t content[REPORT_SIZE] = {0u};

    aw_put_u32(&content[HEAD], time_us);
    for (uint8_t at = 0u; at < board->setup.channels; at++) {
        content[HEAD + 4u + at] = (uint8_t)((inputs->flags[at] & INPUT_FLAGS) | board->channel[at].flags);
        aw_put_u32(&content[HEAD + 7u + (4u * at)], count_of(board, at, inputs->counter[at]));
    }
    send(board, REPORT, content, REPORT_SIZE);
}

static void send_identity(aw_encoder_board_t *board, uint8_t request_sequence)
{
    const aw_encoder_setup_t *setup = &board->setup;
    uint8_t content[IDENTITY_SIZE] = {0u};

    content[HEAD] = PROTOCOL;
    content[HEAD + 1u] = request_sequence;
    aw_put_u16(&content[HEAD + 2u], setup->firmware);
    aw_put_u32(&content[HEAD + 4u], setup->serial_number);
    content[HEAD + 8u] = setup->channels;
    for (uint8_t at = 0u; at < setup->channels; at++) {
        aw_put_u32(&content[HEAD + 9u + (4u * at)], setup->counts_per_turn[at]);
    }
    content[HEAD + 21u] = setup->encoder_bits;
    send(board, IDENTITY, content, IDENTITY_SIZE);
}

static void send_ack(aw_encoder_board_t *board, uint8_t request_sequence, uint8_t result)
{
    uint8_t content[ACK_SIZE] = {0u, 0u, request_sequence, result};

    send(board, ACK, content, ACK_SIZE);
}

static void send_latch(aw_encoder_board_t *board, uint8_t at)
{
    uint8_t content[INDEX_SIZE] = {0u, 0u, at};

    aw_put_u32(&content[HEAD + 1u], board->channel[at].latched_us);
    aw_put_u32(&content[HEAD + 5u], board->channel[at].latched_count);
    send(board, INDEX, content, INDEX_SIZE);
}

static uint8_t set_stream(aw_encoder_board_t *board, uint32_t period_us, uint32_t now_us)
{
    const uint32_t shortest_us = (((REPORT_BITS * 1000000u) - 1u) / board->setup.baud) + 1u;
    uint8_t result = BAD_ARGUMENT;

    if ((period_us == 0u) || ((period_us >= shortest_us) && (period_us <= LONGEST_PERIOD_US))) {
        board->period_us = period_us;
        board->due_us = now_us + period_us;
        result = DONE;
    }
    return result;
}

static uint8_t set_zero(aw_encoder_board_t *board, uint8_t at, uint32_t count, const aw_encoder_inputs_t *now)
{
    uint8_t result = DONE;

    if (at >= board->setup.channels) {
        result = BAD_ARGUMENT;
    } else if ((now->flags[at] & AW_SIGNAL_LOST) != 0u) {
        result = NOT_POSSIBLE_NOW;
    } else {
        aw_encoder_channel_t *channel = &board->channel[at];
        channel->zero = count - now->counter[at];
        channel->flags = AW_ZERO_SET;
        channel->is_armed = false;
    }
    return result;
}

static uint8_t arm_index(aw_encoder_board_t *board, uint8_t at, uint8_t action)
{
    uint8_t result = DONE;

    if ((at >= board->setup.channels) || (action > SEND_AGAIN)) {
        result = BAD_ARGUMENT;
    } else if (action == SEND_AGAIN) {
        result = ((board->channel[at].flags & AW_INDEX_LATCHED) != 0u) ? DONE : NOT_POSSIBLE_NOW;
    } else {
        board->channel[at].flags &= (uint8_t)~AW_INDEX_LATCHED;
        board->channel[at].is_armed = (action == ARM);
    }
    return result;
}

/* Whether a request is answered with an ACK, and has one of the protocol's types. */
static bool is_acknowledged(uint8_t type)
{
    return (type != POLL) && (type != IDENTIFY);
}

static size_t body_size(uint8_t type)
{
    static const uint8_t sizes[] = {0u, 0u, 4u, 5u, 2u, 0u}; /* by type; there is no type 0 */

    return sizes[type];
}

static bool is_known(uint8_t type)
{
    return (type >= POLL) && (type <= IDENTIFY);
}

/* Does a request that is answered with an ACK; returns its result. */
static uint8_t done(aw_encoder_board_t *board, const uint8_t *request, size_t size, const aw_encoder_inputs_t *now)
{
    const uint8_t *body = &request[HEAD];
    uint8_t result;

    if (!is_known(request[0])) {
        result = UNKNOWN_REQUEST;
    } else if ((size - HEAD) != body_size(request[0])) {
        result = BAD_ARGUMENT;
    } else if (request[0] == STREAM) {
        result = set_stream(board, aw_get_u32(body), now->time_us);
    } else if (request[0] == SET_ZERO) {
        result = set_zero(board, body[0], aw_get_u32(&body[1]), now);
    } else {
        result = arm_index(board, body[0], body[1]);
    }
    return result;
}

/* One whole, valid frame from the host. */
static void answer(aw_encoder_board_t *board, const uint8_t *request, size_t size, const aw_encoder_inputs_t *now)
{
    const bool is_repeated = (size == board->last_size) && (memcmp(request, board->last_request, size) == 0);
    const bool is_whole = is_known(request[0]) && ((size - HEAD) == body_size(request[0]));

    if (is_whole && !is_acknowledged(request[0])) {
        if (request[0] == POLL) {
            send_report(board, now->time_us, now);
        } else {
            send_identity(board, request[1]);
        }
    } else {
        if (!is_repeated) {
            board->last_result = done(board, request, size, now);
        }
        send_ack(board, request[1], board->last_result);
        if (is_whole && (request[0] == ARM_INDEX) && (request[HEAD + 1u] == SEND_AGAIN) && (board->last_result == DONE)) {
            send_latch(board, request[HEAD]);
        }
    }
    (void)memcpy(board->last_request, request, size);
    board->last_size = (uint8_t)size;
}

void aw_encoder_init(aw_encoder_board_t *board, const aw_encoder_setup_t *setup, const aw_encoder_inputs_t *now)
{
    (void)memset(board, 0, sizeof *board);
    board->setup = *setup;
    for (uint8_t at = 0u; at < setup->channels; at++) {
        board->channel[at].zero = 0u - now->counter[at];
    }
    send_identity(board, 0u);
    /* One 0x00 before the first frame ends whatever the line has picked up. */
    (void)memmove(&board->queue[0].wire[1], board->queue[0].wire, board->queue[0].size);
    board->queue[0].wire[0] = 0u;
    board->queue[0].size++;
}

void aw_encoder_receive(aw_encoder_board_t *board, const uint8_t *bytes, size_t size, const aw_encoder_inputs_t *now)
{
    uint8_t request[AW_CODED_MAX];

    for (size_t at = 0u; at < size; at++) {
        const size_t found = aw_receiver_put(&board->receiver, bytes[at], request);
        if (found > 0u) {
            answer(board, request, found, now);
        }
    }
}

uint8_t aw_encoder_armed(const aw_encoder_board_t *board)
{
    uint8_t armed = 0u;

    for (uint8_t at = 0u; at < board->setup.channels; at++) {
        if (board->channel[at].is_armed) {
            armed |= (uint8_t)(1u << at);
        }
    }
    return armed;
}

void aw_encoder_index(aw_encoder_board_t *board, uint8_t channel, uint32_t time_us, uint32_t counter)
{
    if ((channel < board->setup.channels) && board->channel[channel].is_armed) {
        aw_encoder_channel_t *at = &board->channel[channel];
        at->latched_us = time_us;
        at->latched_count = count_of(board, channel, counter);
        at->flags |= AW_INDEX_LATCHED;
        at->is_armed = false;
        send_latch(board, channel);
    }
}

int32_t aw_encoder_count(const aw_encoder_board_t *board, uint8_t channel, uint32_t counter)
{
    return (channel < board->setup.channels) ? aw_signed32(count_of(board, channel, counter)) : 0;
}

void aw_encoder_quadrature_error(aw_encoder_board_t *board, uint8_t channel)
{
    if (channel < board->setup.channels) {
        board->channel[channel].flags |= AW_QUADRATURE_ERROR;
    }
}

bool aw_encoder_next_report(const aw_encoder_board_t *board, uint32_t *due_us)
{
    *due_us = board->due_us;
    return board->period_us > 0u;
}

void aw_encoder_stream(aw_encoder_board_t *board, const aw_encoder_inputs_t *latched)
{
    if ((board->period_us > 0u) && (aw_signed32(latched->time_us - board->due_us) >= 0)) {
        send_report(board, board->due_us, latched); /* the grid's time: it has no drift */
        board->due_us += board->period_us;
    }
}

size_t aw_encoder_take(aw_encoder_board_t *board, uint8_t wire[AW_ENCODER_WIRE_MAX])
{
    size_t size = 0u;

    if (board->queued > 0u) {
        size = board->queue[0].size;
        (void)memcpy(wire, board->queue[0].wire, size);
        board->queued--;
        for (uint8_t at = 0u; at < board->queued; at++) {
            board->queue[at] = board->queue[at + 1u];
        }
    }
    return size;
}
