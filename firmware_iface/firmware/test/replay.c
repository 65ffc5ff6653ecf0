/* One long, reproducible conversation with both boards, as a checksum of all that they said and put out.
 * A processor that computes the same prints the same. On QEMU: bsp/qemu_mps2_an386. */
#include "replay.h"

#include "aw_bytes.h"
#include "aw_current.h"
#include "aw_encoder_board.h"

#define CRC_PRIME 16777619u /* FNV-1a */

static uint32_t state = 2463534242u;
static uint32_t sum = 2166136261u;

static uint32_t drawn(uint32_t below)
{
    state ^= state << 13u;
    state ^= state >> 17u;
    state ^= state << 5u;
    return state % below;
}

static void add(const uint8_t *bytes, size_t size)
{
    for (size_t at = 0u; at < size; at++) {
        sum = (sum ^ bytes[at]) * CRC_PRIME;
    }
}

static void add_u32(uint32_t value)
{
    uint8_t bytes[4];

    aw_put_u32(bytes, value);
    add(bytes, sizeof bytes);
}

static aw_motor_board_t motor;
static aw_motor_inputs_t inputs = {0u, 0u, 0, 0, 24000, 30000, 0u, 0u, false};
static aw_encoder_board_t encoder;
static aw_encoder_inputs_t counters;
static aw_current_t loop;

static void say(uint16_t id, uint8_t first, uint8_t second, uint32_t value)
{
    aw_can_frame_t frame = {id, AW_CAN_BYTES, {0u}};
    aw_can_frame_t answer;

    frame.data[0] = first;
    frame.data[1] = second;
    aw_put_u32((id == 0x101u) ? &frame.data[2] : &frame.data[4], value);
    if (aw_motor_receive(&motor, &frame, &inputs, &answer)) {
        add(answer.data, AW_CAN_BYTES);
    }
}

void replay_begin(void)
{
    static const uint8_t indices[] = {16u, 17u, 18u, 22u, 23u, 35u};
    static const uint32_t values[] = {6135u, 50000u, 153400u, 9000u, 5000u, 24u};
    const aw_motor_setup_t board = {1u, 2048, 8000, 9000, 50000, 90000, 0x0100u, 1000u, 1u, 4u, 0u};
    const aw_encoder_setup_t reports = {1u, 1000000u, {2048u, 2048u, 2048u}, 0x0100u, 3u, 24u};
    const aw_current_setup_t winding = {6283, 6283185, 50};
    const uint8_t stream[] = {0x05u, 0x02u, 0x02u, 0xD0u, 0x07u, 0x01u, 0x03u, 0x40u, 0xECu, 0x00u};

    aw_motor_init(&motor, &board, &inputs);
    aw_current_init(&loop, &winding);
    aw_encoder_init(&encoder, &reports, &counters);
    aw_encoder_receive(&encoder, stream, sizeof stream, &counters);
    replay_tick();
    for (uint8_t at = 0u; at < sizeof indices; at++) {
        say(0x201u, 1u, indices[at], values[at]);
    }
}

void replay_tick(void)
{
    aw_can_frame_t answer;
    aw_output_t output;

    inputs.time_us += 1000u;
    inputs.counter += drawn(9u) - 3u;
    inputs.current_mA = aw_signed32(drawn(8000u)) - 4000;
    inputs.mean_mA = inputs.current_mA;
    if (aw_motor_tick(&motor, &inputs, &answer)) {
        add(answer.data, AW_CAN_BYTES);
    }
    output = aw_motor_output(&motor);
    add_u32((uint32_t)output.kind);
    add_u32((uint32_t)output.value);
}

void replay_current(void)
{
    const int32_t measured_mA = aw_signed32(drawn(8000u)) - 4000;

    add_u32((uint32_t)aw_current_step(&loop, aw_motor_output(&motor), 5000, 24000000, measured_mA));
}

void replay_command(void)
{
    static const uint8_t words[] = {0x80u, 0x06u, 0x07u, 0x0Fu, 0x0Fu, 0x0Fu, 0x0Fu, 0x0Fu};

    /* One draw a statement: the order in which arguments are evaluated is the compiler's. */
    const bool is_stop = drawn(200u) == 0u;
    const uint32_t word = (drawn(10u) == 0u) ? drawn(8u) : 3u;
    const uint32_t mode = drawn(5u);
    const uint32_t sequence = drawn(32u);
    const uint32_t setpoint = drawn(4000u);

    if (is_stop) {
        say(0u, 0u, 0u, 0u);
    }
    say(0x101u, words[word], (uint8_t)(mode | (sequence << 3u)), setpoint);
    if (motor.state != AW_ENABLED) {
        for (uint8_t at = 0u; at < 4u; at++) {
            say(0x101u, words[at], 0u, 0u);
        }
    }
}

void replay_report(void)
{
    uint8_t wire[AW_ENCODER_WIRE_MAX];
    size_t size;

    counters.time_us += 2000u;
    counters.counter[0] += drawn(100u);
    counters.counter[1] -= drawn(100u);
    aw_encoder_stream(&encoder, &counters);
    do {
        size = aw_encoder_take(&encoder, wire);
        add(wire, size);
    } while (size > 0u);
}

uint32_t replay_sum(void)
{
    return sum;
}
