/* The motor board on a Nucleo-F446RE with a CAN transceiver and an H-bridge with two inputs. Wiring: docs/firmware.md. */
#include "aw_bytes.h"
#include "aw_current.h"
#include "aw_motor_board.h"
#include "stm32f446.h"

/* What is on your board. */
#define COUNTS_PER_TURN 2048
#define IS_ENCODER_INVERTED false /* a positive voltage must count up */
#define RATING_MA 8000
#define LOWEST_SUPPLY_MV 9000
#define HIGHEST_SUPPLY_MV 34000
#define RATED_MDEGC 90000
#define CURRENT_ZERO 2048 /* ADC counts at 0 A: an amplifier in the motor's line, centred on half of 3.3 V */
#define CURRENT_UA_COUNT 8057 /* 20 V/V at 5 mohm: 100 mV/A */
#define SUPPLY_UV_COUNT 8862  /* 100 kohm over 10 kohm */
#define SENSOR_UV_COUNT 806   /* TMP36: 10 mV/K, 500 mV at 0 degC */
#define WINDING_KP_UV_MA 6283 /* 1 mH, 1 kHz */
#define WINDING_KI_UV_MAS 6283185 /* 1 ohm, 1 kHz */

#define FIRMWARE 0x0100u
#define PERIOD_US 1000u
#define PWM_US 50u
#define PWM_TOP 4200u /* 168 MHz / 2 / 20 kHz, up and down */
#define MEAN_OF 20    /* PWM periods: one millisecond */
#define FAST_LOOP_LATE_US 500u /* ten periods; an answer over CAN holds the main loop up for less */
#define PINS 4u
#define FIRST_PIN 4u /* PC4, PC5, PC6, PC7 */

#define BRIDGE_ENABLE 5u /* PB5: high enables; a resistor to ground keeps it off without the processor */
#define BRIDGE_FAULT 4u  /* PB4: low is a fault */

#define CAN_BITS ((1uL << 24u) | (2uL << 20u) | (9uL << 16u) | 2uL) /* 42 MHz / 3 / 14 = 1 Mbit/s, sampled at 79 % */
#define CAN_MODE ((1uL << 6u) | (1uL << 2u)) /* leave bus-off by itself; send in the order of writing */
#define CAN_EXTENDED_OR_REMOTE 6uL
#define CAN_EMPTY(mailbox) (1uL << (26u + (mailbox)))
#define CAN_BUS_OFF (1uL << 2u)
#define CAN_ABORT ((1uL << 7u) | (1uL << 15u) | (1uL << 23u))

/* Without MOE both inputs of the bridge are at their idle level, high, whatever the fast loop does: the windings are shorted. */
#define PWM_BRAKED (1uL << 10u)
#define PWM_DRIVEN (PWM_BRAKED | (1uL << 15u))
#define PWM_IDLE_HIGH ((1uL << 8u) | (1uL << 10u))

/* What the main loop wants of the fast loop, and what this has measured. Written whole, with interrupts off or in them. */
static volatile struct {
    aw_output_kind_t kind;
    int32_t value;
    int32_t limit_mA;
    int32_t voltage_limit_mV;
    int32_t current_mA;
    int32_t mean_mA;
    int32_t supply_mV;
    int32_t temperature_mdegC;
    bool is_limited;
} shared;

static aw_motor_board_t board;
static aw_current_t loop;
static volatile uint32_t steps; /* of the fast loop */

static void drive(int32_t voltage_uV, int32_t supply_mV, bool is_open)
{
    const uint32_t all = PWM_TOP + 1u;
    const uint32_t wanted_mV = (uint32_t)((voltage_uV < 0) ? -voltage_uV : voltage_uV) / 1000u;
    uint32_t off;

    if (is_open) {
        TIM1->ccr1 = 0u;
        TIM1->ccr2 = 0u;
    } else {
        /* Both inputs high shorts the windings; the time in which one is low is the mean voltage. */
        off = (supply_mV > 0) ? ((wanted_mV * PWM_TOP) / (uint32_t)supply_mV) : 0u;
        off = (off > PWM_TOP) ? PWM_TOP : off;
        TIM1->ccr1 = (voltage_uV < 0) ? (all - off) : all;
        TIM1->ccr2 = (voltage_uV < 0) ? all : (all - off);
    }
}

void adc_handler(void);

/* 20 kHz, in the middle of a PWM phase: measure, hold the current, set the next duty. */
void adc_handler(void)
{
    static int32_t sum_mA;
    static int32_t count;
    const int32_t current_mA = (((int32_t)ADC1->jdr[0] - CURRENT_ZERO) * CURRENT_UA_COUNT) / 1000;
    const int32_t supply_mV = ((int32_t)ADC1->jdr[1] * SUPPLY_UV_COUNT) / 1000;
    const aw_output_t wanted = {shared.kind, shared.value};
    const int32_t most_uV = 1000 * ((supply_mV < shared.voltage_limit_mV) ? supply_mV : shared.voltage_limit_mV);

    ADC1->sr = 0u;
    steps++;
    drive(aw_current_step(&loop, wanted, shared.limit_mA, most_uV, current_mA), supply_mV, wanted.kind == AW_OUTPUT_OPEN);
    sum_mA += current_mA;
    count++;
    if (count == MEAN_OF) {
        shared.mean_mA = sum_mA / MEAN_OF;
        sum_mA = 0;
        count = 0;
    }
    shared.current_mA = current_mA;
    shared.supply_mV = supply_mV;
    shared.temperature_mdegC = (((int32_t)ADC1->jdr[2] * SENSOR_UV_COUNT) - 500000) / 10;
    shared.is_limited = loop.is_limited;
}

static void look(aw_motor_inputs_t *inputs)
{
    inputs->time_us = now_us();
    inputs->counter = TIM2->cnt;
    inputs->current_mA = shared.current_mA;
    inputs->mean_mA = shared.mean_mA;
    inputs->supply_mV = shared.supply_mV;
    inputs->temperature_mdegC = shared.temperature_mdegC;
    inputs->is_limited = shared.is_limited;
    inputs->causes = ((GPIO_B->idr & (1uL << BRIDGE_FAULT)) == 0u) ? AW_OVER_CURRENT : 0u;
    inputs->pin_levels = (uint8_t)((GPIO_C->idr >> FIRST_PIN) & ((1uL << PINS) - 1uL));
}

static void obey(void)
{
    const aw_output_t output = aw_motor_output(&board);
    const uint32_t outputs = aw_motor_pin_outputs(&board);
    const uint32_t levels = aw_motor_pin_levels(&board);

    interrupts_off();
    shared.kind = output.kind;
    shared.value = output.value;
    shared.limit_mA = aw_motor_current_limit_mA(&board);
    shared.voltage_limit_mV = aw_motor_voltage_limit_mV(&board);
    TIM1->bdtr = ((output.kind == AW_OUTPUT_VOLTAGE) && (output.value == 0)) ? PWM_BRAKED : PWM_DRIVEN;
    interrupts_on();
    for (uint32_t pin = 0u; pin < PINS; pin++) {
        const bool is_output = ((outputs >> pin) & 1u) != 0u;
        GPIO_C->bsrr = (((levels >> pin) & 1u) != 0u) ? (1uL << (FIRST_PIN + pin)) : (1uL << (FIRST_PIN + pin + 16u));
        pin_set_up(GPIO_C, FIRST_PIN + pin, is_output ? PIN_OUTPUT : PIN_INPUT, PULL_NONE);
    }
}

/* Takes a frame from the bus; false if there is none. What is no data frame with an 11-bit id gets size 0 and id 0x7FF. */
static bool can_take(aw_can_frame_t *frame)
{
    const bool is_there = (CAN1->rf0r & 3u) != 0u;

    if (is_there) {
        const can_mailbox_t *mailbox = &CAN1->rx[0];
        const bool is_foreign = (mailbox->ir & CAN_EXTENDED_OR_REMOTE) != 0u;
        const uint32_t size = mailbox->dtr & 0xFu;
        frame->id = (uint16_t)(is_foreign ? 0x7FFu : (mailbox->ir >> 21u));
        frame->size = (uint8_t)(is_foreign ? 0u : ((size < AW_CAN_BYTES) ? size : AW_CAN_BYTES));
        aw_put_u32(&frame->data[0], mailbox->dlr);
        aw_put_u32(&frame->data[4], mailbox->dhr);
        CAN1->rf0r = 1uL << 5u;
    }
    return is_there;
}

/* Sends a frame if a mailbox is free; one that waits when the bus goes off is not owed any more. */
static void can_send(const aw_can_frame_t *frame)
{
    bool is_sent = false;

    for (uint32_t at = 0u; (at < 3u) && !is_sent; at++) {
        if ((CAN1->tsr & CAN_EMPTY(at)) != 0u) {
            CAN1->tx[at].dtr = frame->size;
            CAN1->tx[at].dlr = aw_get_u32(&frame->data[0]);
            CAN1->tx[at].dhr = aw_get_u32(&frame->data[4]);
            CAN1->tx[at].ir = ((uint32_t)frame->id << 21u) | 1uL;
            is_sent = true;
        }
    }
}

static void can_set_up(void)
{
    pin_function(GPIO_B, 8u, 9u, PULL_UP);
    pin_function(GPIO_B, 9u, 9u, PULL_NONE);
    CAN1->mcr = CAN_MODE | 1uL; /* initialise */
    while ((CAN1->msr & 1u) == 0u) {
    }
    CAN1->btr = CAN_BITS;
    CAN1->fmr |= 1u; /* one filter, of 32 bits, which lets everything into FIFO 0 */
    CAN1->fs1r |= 1u;
    CAN1->filter[0][0] = 0u;
    CAN1->filter[0][1] = 0u;
    CAN1->fa1r |= 1u;
    CAN1->fmr &= ~1uL;
    CAN1->mcr = CAN_MODE;
}

static void adc_set_up(void)
{
    pin_set_up(GPIO_B, 0u, PIN_ANALOG, PULL_NONE); /* 8: current */
    pin_set_up(GPIO_B, 1u, PIN_ANALOG, PULL_NONE); /* 9: supply */
    pin_set_up(GPIO_C, 0u, PIN_ANALOG, PULL_NONE); /* 10: temperature */
    ADC_CCR = 1uL << 16u;                          /* 21 MHz */
    ADC1->smpr2 = (1uL << 24u) | (1uL << 27u);     /* 15 clocks */
    ADC1->smpr1 = 1uL;
    ADC1->jsqr = (2uL << 20u) | (10uL << 15u) | (9uL << 10u) | (8uL << 5u);
    ADC1->cr1 = (1uL << 8u) | (1uL << 7u);
    ADC1->cr2 = (1uL << 20u) | (1uL << 16u) | 1uL; /* at the update of TIM1 */
    interrupt_enable(IRQ_ADC, 0u);
}

static void pwm_set_up(void)
{
    pin_function(GPIO_A, 8u, 1u, PULL_DOWN);
    pin_function(GPIO_A, 9u, 1u, PULL_DOWN);
    TIM1->arr = PWM_TOP;
    TIM1->rcr = 1u; /* one update a period */
    TIM1->ccmr1 = 0x6868u;
    TIM1->ccer = 0x11u;
    TIM1->bdtr = PWM_DRIVEN; /* at a duty of 0: open, until the board's state says more */
    TIM1->cr2 = PWM_IDLE_HIGH | (2uL << 4u);
    TIM1->cr1 = (1uL << 7u) | (1uL << 5u) | 1uL; /* up and down */
}

/* Switches to ground at PC10, PC11, PC12 and PD2 are bits 0 to 3 of the node. */
static uint8_t node(void)
{
    uint32_t levels;

    for (uint32_t pin = 10u; pin <= 12u; pin++) {
        pin_set_up(GPIO_C, pin, PIN_INPUT, PULL_UP);
    }
    pin_set_up(GPIO_D, 2u, PIN_INPUT, PULL_UP);
    for (const uint32_t begun_us = now_us(); (now_us() - begun_us) < 100u;) {
    }
    levels = ((GPIO_C->idr >> 10u) & 7u) | (((GPIO_D->idr >> 2u) & 1u) << 3u);
    return (uint8_t)(~levels & 0xFu);
}

static void set_up(void)
{
    const aw_current_setup_t winding = {WINDING_KP_UV_MA, WINDING_KI_UV_MAS, PWM_US};

    chip_init();
    clock_on(&RCC->apb1enr, APB1_TIM2 | APB1_CAN1);
    clock_on(&RCC->apb2enr, APB2_TIM1 | APB2_ADC1);
    pin_set_up(GPIO_B, BRIDGE_FAULT, PIN_INPUT, PULL_UP);
    pin_function(GPIO_A, 0u, 1u, PULL_UP);
    pin_function(GPIO_A, 1u, 1u, PULL_UP);
    timer_as_encoder(TIM2, IS_ENCODER_INVERTED);
    aw_current_init(&loop, &winding);
    shared.kind = AW_OUTPUT_OPEN;
    pwm_set_up();
    adc_set_up();
    can_set_up();
}

static void serve(aw_motor_inputs_t *inputs)
{
    aw_can_frame_t frame;
    aw_can_frame_t answer;
    static uint32_t ticked_us;

    if ((CAN1->esr & CAN_BUS_OFF) != 0u) {
        CAN1->tsr = CAN_ABORT;
    }
    while (can_take(&frame)) {
        look(inputs);
        if (aw_motor_receive(&board, &frame, inputs, &answer)) {
            can_send(&answer);
        }
        obey();
    }
    if ((now_us() - ticked_us) >= PERIOD_US) {
        ticked_us += PERIOD_US;
        look(inputs);
        if (aw_motor_tick(&board, inputs, &answer)) {
            can_send(&answer);
        }
        obey();
    }
}

void board_off(void)
{
    GPIO_B->bsrr = 1uL << (BRIDGE_ENABLE + 16u);
    TIM1->bdtr = PWM_BRAKED;
}

/* Nothing but the fast loop holds the current and sets the duty: without it the board may not go on. */
static bool is_fast_loop_late(void)
{
    static uint32_t seen;
    static uint32_t seen_us;

    if ((steps != seen) || (seen_us == 0u)) {
        seen = steps;
        seen_us = now_us();
    }
    return (now_us() - seen_us) >= FAST_LOOP_LATE_US;
}

static void turn(aw_motor_inputs_t *inputs)
{
    serve(inputs);
    if (is_fast_loop_late()) {
        unexpected();
    }
    watchdog_feed();
}

int main(void)
{
    aw_motor_setup_t setup = {0u, COUNTS_PER_TURN, RATING_MA, LOWEST_SUPPLY_MV, HIGHEST_SUPPLY_MV, RATED_MDEGC, FIRMWARE,
                              PERIOD_US, 0u, PINS, 0u};
    aw_motor_inputs_t inputs;

    setup.reset_cause = reset_cause();
    set_up();
    setup.serial_number = chip_serial_number();
    setup.node = node();
    look(&inputs);
    aw_motor_init(&board, &setup, &inputs);
    pin_set_up(GPIO_B, BRIDGE_ENABLE, PIN_OUTPUT, PULL_NONE);
    GPIO_B->bsrr = 1uL << BRIDGE_ENABLE;
    watchdog_start();
    while (setup.node == 0u) { /* 1 ... 15: a board without a node says nothing and drives nothing */
        watchdog_feed();
    }
    for (;;) {
        turn(&inputs);
    }
}
