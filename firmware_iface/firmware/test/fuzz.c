/* Throws frames, mutated frames and noise at the boards: `fuzz SEED FRAMES`. For a build with sanitizers, which end it. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "aw_bytes.h"
#include "aw_encoder_board.h"
#include "aw_motor_board.h"

static uint32_t state = 1u;

/* xorshift32 (Marsaglia 2003) */
static uint32_t drawn(uint32_t below)
{
    state ^= state << 13u;
    state ^= state >> 17u;
    state ^= state << 5u;
    return state % below;
}

static void fill(uint8_t *bytes, size_t size)
{
    for (size_t at = 0u; at < size; at++) {
        bytes[at] = (drawn(4u) == 0u) ? 0u : (uint8_t)drawn(256u);
    }
}

static void require(bool is_so, const char *what)
{
    if (!is_so) {
        (void)fprintf(stderr, "fuzz: %s\n", what);
        abort();
    }
}

static void turn(aw_encoder_inputs_t *inputs)
{
    inputs->time_us += drawn(3000u);
    for (uint8_t at = 0u; at < AW_CHANNELS; at++) {
        inputs->counter[at] += (drawn(8u) == 0u) ? drawn(UINT32_MAX) : drawn(50u);
        inputs->flags[at] = (uint8_t)drawn(256u);
    }
}

/* A request, whole or mutated, or noise; returns its size on the wire. */
static size_t made(uint8_t *wire)
{
    static const uint8_t sizes[] = {2u, 2u, 6u, 7u, 4u, 2u, 3u, 9u}; /* by type */
    uint8_t content[AW_CONTENT_MAX];
    size_t size;

    fill(content, sizeof content);
    content[0] = (uint8_t)drawn(8u);
    content[2] = (uint8_t)drawn(4u);
    content[3] = (uint8_t)((content[0] == 0x04u) ? drawn(4u) : content[3]);
    size = sizes[content[0]];
    if (drawn(20u) == 0u) {
        size = 1u + drawn(AW_CONTENT_MAX);
    }
    size = aw_frame_encode(content, size, wire);
    if (drawn(3u) == 0u) {
        wire[drawn((uint32_t)size)] ^= (uint8_t)(1u << drawn(8u));
    }
    if (drawn(10u) == 0u) {
        size = drawn(AW_CONTENT_MAX + AW_FRAME_OVERHEAD);
        fill(wire, size);
    }
    return size;
}

static void fuzz_encoder(uint32_t frames)
{
    const uint8_t identify[] = {0x00u, 0x05u, 0x05u, 0x63u, 0x3Fu, 0xBEu, 0x00u};
    aw_encoder_setup_t setup = {1u, 1000000u, {2048u, 2048u, 2048u}, 0x0100u, 3u, 32u};
    aw_encoder_inputs_t inputs = {0u, {0u}, {0u}};
    aw_encoder_board_t board;
    uint8_t wire[AW_CONTENT_MAX + AW_FRAME_OVERHEAD];
    uint8_t sent[AW_ENCODER_WIRE_MAX];
    uint32_t due_us;

    setup.channels = (uint8_t)(1u + drawn(AW_CHANNELS));
    setup.encoder_bits = (uint8_t)(8u + drawn(25u));
    aw_encoder_init(&board, &setup, &inputs);
    for (uint32_t count = 0u; count < frames; count++) {
        turn(&inputs);
        aw_encoder_receive(&board, wire, made(wire), &inputs);
        aw_encoder_index(&board, (uint8_t)drawn(5u), inputs.time_us, inputs.counter[0]);
        aw_encoder_quadrature_error(&board, (uint8_t)drawn(5u));
        if (aw_encoder_next_report(&board, &due_us)) {
            aw_encoder_stream(&board, &inputs);
        }
        while ((drawn(4u) > 0u) && (aw_encoder_take(&board, sent) > 0u)) {
            require(aw_encoder_armed(&board) < 8u, "an armed channel that there is not");
        }
    }
    while (aw_encoder_take(&board, sent) > 0u) {
    }
    (void)memset(&board.receiver, 0, sizeof board.receiver);
    aw_encoder_receive(&board, identify, sizeof identify, &inputs);
    require((aw_encoder_take(&board, sent) > 0u) && (board.queued == 0u), "IDENTIFY is not answered once");
}

static void move(aw_motor_inputs_t *inputs)
{
    inputs->time_us += (drawn(50u) == 0u) ? drawn(UINT32_MAX) : drawn(2000u);
    inputs->counter += (drawn(8u) == 0u) ? drawn(UINT32_MAX) : drawn(100u);
    inputs->current_mA = aw_signed32(drawn(20000u)) - 10000;
    inputs->mean_mA = aw_signed32(drawn(100000u)) - 50000;
    inputs->supply_mV = (drawn(50u) == 0u) ? aw_signed32(drawn(UINT32_MAX)) : 24000;
    inputs->temperature_mdegC = aw_signed32(drawn(95000u));
    inputs->causes = (uint8_t)((drawn(100u) == 0u) ? drawn(256u) : 0u);
    inputs->pin_levels = (uint8_t)drawn(256u);
    inputs->is_limited = drawn(2u) == 0u;
}

/* Mostly COMMANDs that enable, and writes of parameters that there are: otherwise little of the board is reached. */
static void make_frame(aw_can_frame_t *frame, uint8_t node)
{
    static const uint8_t words[] = {0x06u, 0x07u, 0x0Fu, 0x0Fu, 0x0Fu, 0x00u, 0x80u, 0x02u};
    static const uint8_t indices[] = {4u, 16u, 17u, 18u, 19u, 20u, 21u, 22u, 23u, 32u, 33u, 34u, 35u, 36u, 49u, 50u, 51u};

    fill(frame->data, sizeof frame->data);
    frame->size = (uint8_t)((drawn(20u) == 0u) ? drawn(9u) : AW_CAN_BYTES);
    frame->id = (uint16_t)(((drawn(5u) + 2u) * 0x80u) + ((drawn(20u) == 0u) ? drawn(16u) : node));
    if (drawn(60u) == 0u) {
        frame->id = (uint16_t)((drawn(2u) == 0u) ? 0u : drawn(0x800u));
    }
    if ((frame->id & 0x780u) == 0x100u) {
        frame->data[0] = (drawn(4u) == 0u) ? frame->data[0] : words[drawn(sizeof words)];
        frame->data[1] = (uint8_t)(frame->data[1] & ((drawn(30u) == 0u) ? 0xFFu : 0xFBu));
    } else if ((frame->id & 0x780u) == 0x200u) {
        frame->data[0] = 1u;
        frame->data[1] = (drawn(8u) == 0u) ? frame->data[1] : indices[drawn(sizeof indices)];
        aw_put_u32(&frame->data[4], drawn(1uL << drawn(32u)));
    } else {
        /* any content */
    }
}

/* The way in from any state: reset, shutdown, switch on, enable operation, in some mode. */
static void enable(aw_motor_board_t *board, aw_motor_inputs_t *inputs)
{
    static const uint8_t words[] = {0x00u, 0x80u, 0x06u, 0x07u, 0x0Fu};
    aw_can_frame_t frame = {(uint16_t)(0x100u + board->setup.node), AW_CAN_BYTES, {0u}};
    aw_can_frame_t answer;

    inputs->causes = 0u;
    inputs->supply_mV = 24000;
    for (uint8_t at = 0u; at < sizeof words; at++) {
        fill(frame.data, sizeof frame.data);
        frame.data[0] = words[at];
        frame.data[1] = (uint8_t)drawn(5u);
        (void)aw_motor_receive(board, &frame, inputs, &answer);
    }
}

static void fuzz_motor(uint32_t frames)
{
    aw_motor_setup_t setup = {7u, 2048, 8000, 9000, 50000, 90000, 0x0100u, 1000u, 3u, 4u, 0u};
    aw_motor_inputs_t inputs = {0u, 0u, 0, 0, 24000, 25000, 0u, 0u, false};
    aw_motor_board_t board;
    aw_can_frame_t frame;
    aw_can_frame_t answer;

    setup.digital_pins = (uint8_t)drawn(9u);
    aw_motor_init(&board, &setup, &inputs);
    for (uint32_t count = 0u; count < frames; count++) {
        if (drawn(20u) == 0u) {
            enable(&board, &inputs);
        }
        make_frame(&frame, setup.node);
        if (aw_motor_receive(&board, &frame, &inputs, &answer)) {
            require(((answer.id & 0xFu) == setup.node) && (answer.size == AW_CAN_BYTES), "a wrong answer");
        }
        for (uint32_t ticks = drawn(8u); ticks > 0u; ticks--) {
            move(&inputs);
            (void)aw_motor_tick(&board, &inputs, &answer);
            const aw_output_t output = aw_motor_output(&board);
            if (output.kind == AW_OUTPUT_VOLTAGE) {
                require((output.value <= 60000000) && (output.value >= -60000000), "a voltage beyond every limit");
            }
            require((board.state == AW_ENABLED) || (board.faults != 0u) || (output.kind == AW_OUTPUT_OPEN)
                        || (output.value == 0), "a drive that is not enabled drives");
        }
    }
}

int main(int count, char **arguments)
{
    const uint32_t frames = (count > 2) ? (uint32_t)strtoul(arguments[2], NULL, 10) : 100000u;

    state = (count > 1) ? ((uint32_t)strtoul(arguments[1], NULL, 10) | 1u) : 1u;
    for (uint32_t done = 0u; done < frames; done += 1000u) {
        fuzz_encoder(1000u);
        fuzz_motor(1000u);
    }
    (void)printf("%lu frames\n", (unsigned long)frames);
    return 0;
}
