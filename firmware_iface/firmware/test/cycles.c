/* What a call costs on this machine: `cycles`. Nanoseconds of processor time, best of ten runs. */
#include <stdio.h>
#include <time.h>

#include "aw_bytes.h"
#include "aw_current.h"
#include "aw_encoder_board.h"

#define CALLS 200000u
#define RUNS 10u

static aw_motor_board_t motor;
static aw_motor_inputs_t inputs = {0u, 0u, 500, 500, 24000, 30000, 0u, 0u, false};
static aw_encoder_board_t encoder;
static aw_encoder_inputs_t counters;
static aw_current_t loop;
static volatile int32_t kept;

static void command(uint8_t word, uint8_t mode, uint32_t setpoint)
{
    aw_can_frame_t frame = {0x101u, AW_CAN_BYTES, {0u}};
    aw_can_frame_t answer;

    frame.data[0] = word;
    frame.data[1] = mode;
    aw_put_u32(&frame.data[2], setpoint);
    (void)aw_motor_receive(&motor, &frame, &inputs, &answer);
}

static void write(uint8_t index, uint32_t value)
{
    aw_can_frame_t frame = {0x201u, AW_CAN_BYTES, {1u, 0u, 1u, 0u}};
    aw_can_frame_t answer;

    frame.data[1] = index;
    aw_put_u32(&frame.data[4], value);
    (void)aw_motor_receive(&motor, &frame, &inputs, &answer);
}

static void tick(void)
{
    aw_can_frame_t answer;

    inputs.time_us += 1000u;
    inputs.counter += 3u;
    (void)aw_motor_tick(&motor, &inputs, &answer);
}

static void position(void)
{
    command(0x0Fu, 3u, 5000u);
}

static void current(void)
{
    const aw_output_t wanted = {AW_OUTPUT_CURRENT, 1500};

    kept = aw_current_step(&loop, wanted, 5000, 24000000, 1490);
}

static void report(void)
{
    uint8_t wire[AW_ENCODER_WIRE_MAX];

    counters.time_us += 2000u;
    counters.counter[0] += 7u;
    aw_encoder_stream(&encoder, &counters);
    kept = (int32_t)aw_encoder_take(&encoder, wire);
}

static void measure(const char *name, void (*call)(void))
{
    double best_s = 1e9;

    for (uint8_t run = 0u; run < RUNS; run++) {
        const clock_t begun = clock();
        for (uint32_t done = 0u; done < CALLS; done++) {
            call();
        }
        const double taken_s = (double)(clock() - begun) / (double)CLOCKS_PER_SEC;
        best_s = (taken_s < best_s) ? taken_s : best_s;
    }
    (void)printf("%-36s %6.0f ns\n", name, (best_s * 1e9) / (double)CALLS);
}

int main(void)
{
    const aw_motor_setup_t board = {1u, 2048, 8000, 9000, 50000, 90000, 0x0100u, 1000u, 1u, 4u, 0u};
    const aw_encoder_setup_t reports = {1u, 1000000u, {2048u, 2048u, 2048u}, 0x0100u, 3u, 32u};
    const aw_current_setup_t winding = {6283, 6283185, 50};
    const uint8_t stream[] = {0x05u, 0x02u, 0x02u, 0xD0u, 0x07u, 0x01u, 0x03u, 0x40u, 0xECu, 0x00u};

    aw_motor_init(&motor, &board, &inputs);
    aw_current_init(&loop, &winding);
    aw_encoder_init(&encoder, &reports, &counters);
    aw_encoder_receive(&encoder, stream, sizeof stream, &counters);
    tick();
    write(16u, 6135u);
    write(17u, 50000u);
    write(18u, 153400u);
    write(22u, 9000u);
    write(32u, 0u);
    command(0x06u, 0u, 0u);
    command(0x07u, 0u, 0u);
    position();
    measure("motor board: control period (PID)", tick);
    measure("motor board: COMMAND and REPLY", position);
    measure("motor board: current loop", current);
    measure("encoder board: REPORT, to its bytes", report);
    return 0;
}
