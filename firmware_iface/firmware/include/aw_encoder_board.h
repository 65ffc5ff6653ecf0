/* The encoder board of docs/encoder_board.md: requests, reports, index latch. No hardware in here, no allocation.
 *
 * All functions of one board are called from one context (a main loop, or interrupts of one priority). What happens
 * first is told first: captures (aw_encoder_index) before the bytes that came after them (aw_encoder_receive).
 */
#ifndef AW_ENCODER_BOARD_H
#define AW_ENCODER_BOARD_H

#include "aw_frame.h"

#define AW_CHANNELS 3u
#define AW_ENCODER_WIRE_MAX 29u /* IDENTITY, the longest frame, behind a 0x00 */
#define AW_ENCODER_QUEUE 8u     /* frames that wait for the line */

/* Flags of a channel in a REPORT. Inputs have INDEX_LEVEL, HOME and SIGNAL_LOST; the board adds the others. */
#define AW_INDEX_LEVEL 0x01u
#define AW_INDEX_LATCHED 0x02u
#define AW_HOME 0x04u
#define AW_ZERO_SET 0x08u
#define AW_QUADRATURE_ERROR 0x10u
#define AW_SIGNAL_LOST 0x20u

typedef struct {
    uint32_t serial_number; /* unique among encoder boards */
    uint32_t baud;
    uint32_t counts_per_turn[AW_CHANNELS]; /* after quadrature decoding */
    uint16_t firmware;                     /* major * 256 + minor */
    uint8_t channels;                      /* 1 ... 3 */
    uint8_t encoder_bits;                  /* width of the counters, 8 ... 32 */
} aw_encoder_setup_t;

/* What the hardware has at one moment. Counters run freely and wrap at encoder_bits or more; unused ones are 0. */
typedef struct {
    uint32_t time_us; /* since power-up, wraps */
    uint32_t counter[AW_CHANNELS];
    uint8_t flags[AW_CHANNELS];
} aw_encoder_inputs_t;

typedef struct {
    uint32_t zero; /* count - counter, modulo 2^32 */
    uint32_t latched_us;
    uint32_t latched_count; /* as sent */
    uint8_t flags;          /* INDEX_LATCHED, ZERO_SET, QUADRATURE_ERROR */
    bool is_armed;
} aw_encoder_channel_t;

typedef struct {
    uint8_t wire[AW_ENCODER_WIRE_MAX];
    uint8_t size;
    bool is_report;
} aw_encoder_frame_t;

typedef struct {
    aw_encoder_setup_t setup;
    aw_encoder_channel_t channel[AW_CHANNELS];
    aw_receiver_t receiver;
    uint8_t last_request[AW_CODED_MAX]; /* the same bytes again get the same result and are not done again */
    uint8_t last_size;                  /* 0: none yet */
    uint8_t last_result;                /* of its ACK */
    uint8_t sequence;
    uint32_t period_us; /* of the stream; 0: none */
    uint32_t due_us;    /* of its next REPORT */
    aw_encoder_frame_t queue[AW_ENCODER_QUEUE];
    uint8_t queued;
} aw_encoder_board_t;

/* Power-up: counts 0, no stream; the IDENTITY is queued. `now` is the first look at the inputs, at time 0. */
void aw_encoder_init(aw_encoder_board_t *board, const aw_encoder_setup_t *setup, const aw_encoder_inputs_t *now);

/* Bytes from the host; answers are queued. */
void aw_encoder_receive(aw_encoder_board_t *board, const uint8_t *bytes, size_t size, const aw_encoder_inputs_t *now);

/* Channels whose index edges matter, as bits: the hardware need capture no others. */
uint8_t aw_encoder_armed(const aw_encoder_board_t *board);

/* A rising edge of an index line, with time and counter as captured by the hardware. */
void aw_encoder_index(aw_encoder_board_t *board, uint8_t channel, uint32_t time_us, uint32_t counter);

/* The count that a REPORT would have for a counter of this value. */
int32_t aw_encoder_count(const aw_encoder_board_t *board, uint8_t channel, uint32_t counter);

/* An illegal transition of a channel's lines. */
void aw_encoder_quadrature_error(aw_encoder_board_t *board, uint8_t channel);

/* Whether a stream runs; then `due_us` is when the inputs must be latched for its next REPORT. */
bool aw_encoder_next_report(const aw_encoder_board_t *board, uint32_t *due_us);

/* Queues one REPORT of the stream if it is due at latched->time_us. */
void aw_encoder_stream(aw_encoder_board_t *board, const aw_encoder_inputs_t *latched);

/* Takes the oldest frame that waits, for the line; returns its size, 0 if none waits. */
size_t aw_encoder_take(aw_encoder_board_t *board, uint8_t wire[AW_ENCODER_WIRE_MAX]);

#endif
