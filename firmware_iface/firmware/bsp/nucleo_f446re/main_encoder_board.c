/* The encoder board on a Nucleo-F446RE. Wiring and what it lacks: docs/firmware.md. */
#include "aw_encoder_board.h"
#include "stm32f446.h"

#define COUNTS_PER_TURN 2048u /* of your encoders, after quadrature decoding */
#define BAUD 1000000u
#define FIRMWARE 0x0100u
#define APB2_HZ 84000000u

#define RECEIVED_SIZE 256u /* bytes from the host that wait; a power of two */
#define IS_RECEIVED (1uL << 5u)
#define IS_FREE (1uL << 7u)

/* What interrupts hand to the main loop. */
typedef struct {
    uint32_t time_us;
    uint32_t raw[AW_CHANNELS]; /* as in the timers: the main loop widens them */
    bool is_new;
} latched_t;

static volatile uint8_t received[RECEIVED_SIZE];
static volatile uint32_t received_end;
static volatile latched_t due;
static volatile latched_t edge[AW_CHANNELS];
static aw_encoder_board_t board;
static uint32_t counter[AW_CHANNELS]; /* widened to 32 bits */

static uint32_t raw_of(uint8_t channel)
{
    static tim_t *const timers[AW_CHANNELS] = {TIM2, TIM3, TIM4};

    return timers[channel]->cnt;
}

/* The 16-bit timers of channels 1 and 2 as 32-bit counters: the main loop looks far more often than they can wrap. */
static uint32_t widened(uint8_t channel, uint32_t raw)
{
    uint32_t step = raw - counter[channel];

    if (channel > 0u) {
        step &= 0xFFFFu;
        step = (step ^ 0x8000u) - 0x8000u;
    }
    return counter[channel] + step;
}

static void look(aw_encoder_inputs_t *inputs)
{
    static const uint8_t home_pins[AW_CHANNELS] = {6u, 7u, 8u};

    inputs->time_us = now_us();
    for (uint8_t at = 0u; at < AW_CHANNELS; at++) {
        counter[at] = widened(at, raw_of(at));
        inputs->counter[at] = counter[at];
        inputs->flags[at] = 0u;
        if ((GPIO_C->idr & (1uL << at)) != 0u) {
            inputs->flags[at] |= AW_INDEX_LEVEL;
        }
        if ((GPIO_C->idr & (1uL << home_pins[at])) == 0u) { /* a switch to ground */
            inputs->flags[at] |= AW_HOME;
        }
    }
}

static void latch(volatile latched_t *to)
{
    to->time_us = now_us();
    for (uint8_t at = 0u; at < AW_CHANNELS; at++) {
        to->raw[at] = raw_of(at);
    }
    to->is_new = true;
}

static void index_edge(uint8_t channel)
{
    EXTI->pr = 1uL << channel;
    if (!edge[channel].is_new) {
        latch(&edge[channel]);
    }
}

void exti0_handler(void);
void exti1_handler(void);
void exti2_handler(void);
void tim5_handler(void);
void usart1_handler(void);

void exti0_handler(void)
{
    index_edge(0u);
}

void exti1_handler(void)
{
    index_edge(1u);
}

void exti2_handler(void)
{
    index_edge(2u);
}

void tim5_handler(void)
{
    TIM5->sr = 0u;
    latch(&due);
}

void usart1_handler(void)
{
    const bool is_byte = (USART1->sr & IS_RECEIVED) != 0u;
    const uint8_t byte = (uint8_t)(USART1->dr & 0xFFu); /* reading it clears an overrun, too */

    if (is_byte) {
        received[received_end % RECEIVED_SIZE] = byte;
        received_end++;
    }
}

/* Index edges first: what happened first is told first. An edge of a channel that is not armed is forgotten. */
static void take_edges(void)
{
    for (uint8_t at = 0u; at < AW_CHANNELS; at++) {
        if (edge[at].is_new) {
            aw_encoder_index(&board, at, edge[at].time_us, widened(at, edge[at].raw[at]));
            edge[at].is_new = false;
        }
    }
}

/* The stream: the timer latches the counters when a REPORT is due, so the main loop may be late. */
static void take_due(aw_encoder_inputs_t *inputs)
{
    static uint32_t set_us;
    uint32_t due_us;
    const bool is_streaming = aw_encoder_next_report(&board, &due_us);

    if (is_streaming && due.is_new) {
        for (uint8_t at = 0u; at < AW_CHANNELS; at++) {
            inputs->counter[at] = widened(at, due.raw[at]);
        }
        inputs->time_us = due.time_us;
        due.is_new = false;
        aw_encoder_stream(&board, inputs);
        (void)aw_encoder_next_report(&board, &due_us);
    }
    if (is_streaming && (due_us != set_us)) {
        set_us = due_us;
        TIM5->ccr1 = due_us;
        TIM5->dier = 2u;
        if ((int32_t)(now_us() - due_us) >= 0) { /* it passed before the compare was set */
            TIM5->egr = 2u;
        }
    } else if (!is_streaming) {
        TIM5->dier = 0u;
        due.is_new = false;
    } else {
        /* the compare is set */
    }
}

static void take_bytes(const aw_encoder_inputs_t *inputs)
{
    static uint32_t taken;

    while (taken != received_end) {
        const uint8_t byte = received[taken % RECEIVED_SIZE];
        taken++;
        aw_encoder_receive(&board, &byte, 1u, inputs);
    }
}

static void send(void)
{
    static uint8_t wire[AW_ENCODER_WIRE_MAX];
    static size_t size;
    static size_t sent;

    if (sent == size) {
        size = aw_encoder_take(&board, wire);
        sent = 0u;
    }
    if ((sent < size) && ((USART1->sr & IS_FREE) != 0u)) {
        USART1->dr = wire[sent];
        sent++;
    }
}

static void set_up(void)
{
    chip_init();
    clock_on(&RCC->apb1enr, APB1_TIM2 | APB1_TIM3 | APB1_TIM4);
    clock_on(&RCC->apb2enr, APB2_USART1 | APB2_SYSCFG);
    pin_function(GPIO_A, 0u, 1u, PULL_UP);
    pin_function(GPIO_A, 1u, 1u, PULL_UP);
    pin_function(GPIO_A, 6u, 2u, PULL_UP);
    pin_function(GPIO_A, 7u, 2u, PULL_UP);
    pin_function(GPIO_B, 6u, 2u, PULL_UP);
    pin_function(GPIO_B, 7u, 2u, PULL_UP);
    timer_as_encoder(TIM2, false);
    timer_as_encoder(TIM3, false);
    timer_as_encoder(TIM4, false);
    for (uint8_t at = 0u; at < AW_CHANNELS; at++) {
        pin_set_up(GPIO_C, at, PIN_INPUT, PULL_DOWN);
        pin_set_up(GPIO_C, at + 6u, PIN_INPUT, PULL_UP);
        interrupt_enable(IRQ_EXTI0 + at, 0u);
    }
    SYSCFG_EXTICR[0] = 0x0222u; /* lines 0 to 2 are those of port C */
    EXTI->rtsr |= 7u;
    EXTI->imr |= 7u;
    pin_function(GPIO_A, 9u, 7u, PULL_NONE);
    pin_function(GPIO_A, 10u, 7u, PULL_UP);
    USART1->brr = (APB2_HZ + (BAUD / 2u)) / BAUD;
    USART1->cr1 = (1uL << 13u) | (1uL << 5u) | (1uL << 3u) | (1uL << 2u);
    interrupt_enable(IRQ_TIM5, 1u);
    interrupt_enable(IRQ_USART1, 2u);
}

int main(void)
{
    aw_encoder_setup_t setup = {0u, BAUD, {COUNTS_PER_TURN, COUNTS_PER_TURN, COUNTS_PER_TURN}, FIRMWARE, AW_CHANNELS, 32u};
    aw_encoder_inputs_t inputs;

    set_up();
    setup.serial_number = chip_serial_number();
    look(&inputs);
    aw_encoder_init(&board, &setup, &inputs);
    watchdog_start();
    for (;;) {
        look(&inputs);
        take_edges();
        take_bytes(&inputs);
        take_due(&inputs);
        send();
        watchdog_feed();
    }
}
