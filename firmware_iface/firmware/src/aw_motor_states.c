/* The states of CiA 402 and what a controlword does in them (docs/motor_board.md, States). */
#include "aw_motor_parts.h"

#define SWITCH_ON 0x01u
#define ENABLE_VOLTAGE 0x02u
#define QUICK_STOP 0x04u /* 0 stops */
#define ENABLE_OPERATION 0x08u
#define FAULT_RESET 0x80u

typedef enum {
    WORD_SHUTDOWN,
    WORD_SWITCH_ON,
    WORD_ENABLE,
    WORD_DISABLE_VOLTAGE,
    WORD_QUICK_STOP,
    WORD_FAULT_RESET,
    WORD_NOTHING
} word_t;

typedef struct {
    aw_state_t from;
    word_t word;
    aw_state_t to;
} transition_t;

static const transition_t transitions[] = {
    {AW_SWITCH_ON_DISABLED, WORD_SHUTDOWN, AW_READY},          /* 2 */
    {AW_READY, WORD_SWITCH_ON, AW_SWITCHED_ON},                /* 3 */
    {AW_READY, WORD_ENABLE, AW_SWITCHED_ON},                   /* 3 */
    {AW_SWITCHED_ON, WORD_ENABLE, AW_ENABLED},                 /* 4 */
    {AW_ENABLED, WORD_SWITCH_ON, AW_SWITCHED_ON},              /* 5 */
    {AW_SWITCHED_ON, WORD_SHUTDOWN, AW_READY},                 /* 6 */
    {AW_READY, WORD_DISABLE_VOLTAGE, AW_SWITCH_ON_DISABLED},   /* 7 */
    {AW_READY, WORD_QUICK_STOP, AW_SWITCH_ON_DISABLED},        /* 7 */
    {AW_ENABLED, WORD_SHUTDOWN, AW_READY},                     /* 8 */
    {AW_ENABLED, WORD_DISABLE_VOLTAGE, AW_SWITCH_ON_DISABLED}, /* 9 */
    {AW_SWITCHED_ON, WORD_DISABLE_VOLTAGE, AW_SWITCH_ON_DISABLED}, /* 10 */
    {AW_SWITCHED_ON, WORD_QUICK_STOP, AW_SWITCH_ON_DISABLED},  /* 10 */
    {AW_ENABLED, WORD_QUICK_STOP, AW_QUICK_STOP},              /* 11 */
    {AW_QUICK_STOP, WORD_DISABLE_VOLTAGE, AW_SWITCH_ON_DISABLED}, /* 12 */
    {AW_FAULT, WORD_FAULT_RESET, AW_SWITCH_ON_DISABLED},       /* 15 */
};

static word_t word_of(uint8_t controlword, uint8_t before)
{
    word_t word;

    if ((controlword & FAULT_RESET) != 0u) {
        word = ((before & FAULT_RESET) != 0u) ? WORD_NOTHING : WORD_FAULT_RESET;
    } else if ((controlword & ENABLE_VOLTAGE) == 0u) {
        word = WORD_DISABLE_VOLTAGE;
    } else if ((controlword & QUICK_STOP) == 0u) {
        word = WORD_QUICK_STOP;
    } else if ((controlword & SWITCH_ON) == 0u) {
        word = WORD_SHUTDOWN;
    } else {
        word = ((controlword & ENABLE_OPERATION) != 0u) ? WORD_ENABLE : WORD_SWITCH_ON;
    }
    return word;
}

aw_state_t aw_motor_next_state(aw_state_t state, uint8_t controlword, uint8_t before)
{
    const word_t word = word_of(controlword, before);
    aw_state_t next = state;

    for (uint8_t at = 0u; at < (sizeof transitions / sizeof transitions[0]); at++) {
        if ((transitions[at].from == state) && (transitions[at].word == word)) {
            next = transitions[at].to;
        }
    }
    return next;
}
