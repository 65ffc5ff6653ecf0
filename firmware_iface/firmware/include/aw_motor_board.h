/* The motor board of docs/motor_board.md: COMMANDs, states, watchdog, position PID, parameters, pins. No hardware in here.
 *
 * Integers only, so that every processor computes the same. All functions of one board are called from one context.
 * The fast loop that holds a current is aw_current.h; it obeys the board's output.
 */
#ifndef AW_MOTOR_BOARD_H
#define AW_MOTOR_BOARD_H

#include <stdbool.h>
#include <stdint.h>

#define AW_CAN_BYTES 8u
#define AW_PARAMETERS 16u /* writable ones; the count is kept apart */

/* Bits of faults. In the inputs: causes that the hardware finds. */
#define AW_OVER_CURRENT 0x01u
#define AW_OVER_TEMPERATURE 0x02u
#define AW_UNDER_VOLTAGE 0x04u
#define AW_OVER_VOLTAGE 0x08u
#define AW_WATCHDOG 0x10u
#define AW_ENCODER_FAULT 0x20u
#define AW_BAD_COMMAND 0x40u
#define AW_EMERGENCY_STOP 0x80u

typedef struct {
    uint16_t id; /* 11 bits; data frames only */
    uint8_t size;
    uint8_t data[AW_CAN_BYTES];
} aw_can_frame_t;

typedef struct {
    uint32_t serial_number; /* unique among motor boards */
    int32_t counts_per_turn;
    int32_t rating_mA;
    int32_t lowest_supply_mV; /* of the bridge */
    int32_t highest_supply_mV;
    int32_t rated_mdegC; /* of the power stage */
    uint16_t firmware;   /* major * 256 + minor */
    uint16_t period_us;  /* of aw_motor_tick, 20 ... 1000 */
    uint8_t node;        /* 1 ... 15 */
    uint8_t digital_pins; /* 0 ... 8 */
    uint8_t reset_cause;  /* parameter 6 */
} aw_motor_setup_t;

/* What the hardware has at one moment. Currents have the sign of the voltage that drives them. */
typedef struct {
    uint32_t time_us;    /* wraps */
    uint32_t counter;    /* edges of the encoder; wraps at 32 bits, counts up for a positive voltage */
    int32_t current_mA;  /* now */
    int32_t mean_mA;     /* of the last millisecond */
    int32_t supply_mV;
    int32_t temperature_mdegC; /* of the power stage */
    uint8_t causes;     /* faults that the hardware finds: the bridge's own protection, a broken wire */
    uint8_t pin_levels; /* of the digital pins */
    bool is_limited;    /* the fast loop cuts the voltage back to hold the current's limit */
} aw_motor_inputs_t;

typedef enum {
    AW_OUTPUT_OPEN,    /* the motor turns freely */
    AW_OUTPUT_VOLTAGE, /* mean terminal voltage in uV; 0 shorts the windings */
    AW_OUTPUT_CURRENT  /* mA */
} aw_output_kind_t;

typedef struct {
    aw_output_kind_t kind;
    int32_t value;
} aw_output_t;

typedef enum { /* CiA 402; the values are those of the statusword */
    AW_NOT_READY = 0x00,
    AW_SWITCH_ON_DISABLED = 0x40,
    AW_READY = 0x21,
    AW_SWITCHED_ON = 0x23,
    AW_ENABLED = 0x27,
    AW_QUICK_STOP = 0x07,
    AW_FAULT_REACTION = 0x0F,
    AW_FAULT = 0x08
} aw_state_t;

/* Position PID and the stop without the host. */
typedef struct {
    int64_t integral_pV;
    int64_t speed_q24; /* filtered, counts/s * 2^24 */
    int64_t stop_speed_q4;
    uint32_t stop_us; /* when a stop began */
    uint32_t stop_count;
    uint32_t setpoint; /* counts, modulo 2^32 */
    int32_t feedforward_mV;
    bool is_stopping; /* the set-point comes to rest by itself */
} aw_position_t;

typedef struct {
    aw_motor_setup_t setup;
    int32_t values[AW_PARAMETERS];
    aw_state_t state;
    aw_output_t output;
    aw_position_t position;
    uint32_t zero;       /* count - counter */
    uint32_t counter;    /* at the last tick */
    uint32_t ticked_us;
    uint32_t commanded_us;
    uint32_t over_current_us; /* since when the current is beyond its trip */
    uint8_t faults;
    uint8_t controlword; /* of the last COMMAND */
    uint8_t mode;
    uint8_t driven; /* levels of digital outputs */
    bool has_ticked;
    bool is_over_current;
    bool is_cut; /* a set-point is beyond a limit */
    bool holds;  /* the PID runs, whatever the mode is */
} aw_motor_board_t;

/* Power-up: output open, parameters at their defaults, count 0. */
void aw_motor_init(aw_motor_board_t *board, const aw_motor_setup_t *setup, const aw_motor_inputs_t *now);

/* A frame of the bus. Returns whether `answer` must be sent. */
bool aw_motor_receive(aw_motor_board_t *board, const aw_can_frame_t *frame, const aw_motor_inputs_t *now,
                      aw_can_frame_t *answer);

/* One control period. Returns whether `announcement` must be sent: once, when the self-test is done. */
bool aw_motor_tick(aw_motor_board_t *board, const aw_motor_inputs_t *now, aw_can_frame_t *announcement);

/* The board's count for an encoder's counter of this value: two's complement. */
uint32_t aw_motor_count(const aw_motor_board_t *board, uint32_t counter);

/* What the bridge must do, and within which current and voltage in every mode. */
aw_output_t aw_motor_output(const aw_motor_board_t *board);
int32_t aw_motor_voltage_limit_mV(const aw_motor_board_t *board);
int32_t aw_motor_current_limit_mA(const aw_motor_board_t *board);

/* For lamps and displays; the host reads them in REPLYs. */
aw_state_t aw_motor_state(const aw_motor_board_t *board);
uint8_t aw_motor_faults(const aw_motor_board_t *board);

/* Digital pins as bits: which are outputs, and their levels. */
uint8_t aw_motor_pin_outputs(const aw_motor_board_t *board);
uint8_t aw_motor_pin_levels(const aw_motor_board_t *board);

#endif
