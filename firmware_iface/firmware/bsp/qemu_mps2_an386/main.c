/* The conversation of test/replay.c on QEMU's Cortex-M4, with the instructions that each call takes:
 *
 *     qemu-system-arm -M mps2-an386 -nographic -semihosting -icount shift=0 -kernel replay.elf
 *
 * With `-icount shift=0` an instruction takes a nanosecond; SysTick counts at the processor's 25 MHz, one tick of 40. */
#include <stdbool.h>
#include <stdint.h>

#include "replay.h"

#define SYSTICK_CTRL (*(volatile uint32_t *)0xE000E010u)
#define SYSTICK_LOAD (*(volatile uint32_t *)0xE000E014u)
#define SYSTICK_NOW (*(volatile uint32_t *)0xE000E018u)
#define NS_PER_TICK 40u
#define SYS_WRITE0 0x04u
#define SYS_EXIT 0x18u
#define EXITED 0x20026u

extern uint32_t stack_top;
int main(void);

typedef union {
    int (*handler)(void);
    const uint32_t *stack;
} vector_t;

const vector_t vectors[2] __attribute__((section(".vectors"), used)) = {{.stack = &stack_top}, {.handler = main}};

static void host(uint32_t operation, uint32_t argument)
{
    register uint32_t r0 __asm("r0") = operation;
    register uint32_t r1 __asm("r1") = argument;

    __asm volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
}

static void print(const char *text)
{
    host(SYS_WRITE0, (uint32_t)text);
}

static void print_number(uint32_t value, uint32_t base, uint8_t digits)
{
    char text[11] = {0};

    for (uint8_t at = digits; at > 0u; at--) {
        const uint32_t digit = value % base;
        text[at - 1u] = (char)((digit < 10u) ? ('0' + (int)digit) : (('a' - 10) + (int)digit));
        value /= base;
    }
    print(text);
}

static uint32_t spent[4];

static void timed(uint8_t which, void (*call)(void))
{
    const uint32_t begun = SYSTICK_NOW;

    call();
    spent[which] += (begun - SYSTICK_NOW) & 0xFFFFFFu;
}

int main(void)
{
    static const char *const names[4] = {"command ", "tick    ", "current ", "report  "};

    SYSTICK_LOAD = 0xFFFFFFu;
    SYSTICK_NOW = 0u;
    SYSTICK_CTRL = 5u;
    replay_begin();
    for (uint32_t round = 0u; round < REPLAY_ROUNDS; round++) {
        timed(0u, replay_command);
        timed(1u, replay_tick);
        timed(1u, replay_tick);
        timed(2u, replay_current);
        timed(3u, replay_report);
    }
    print("sum ");
    print_number(replay_sum(), 16u, 8u);
    print("\n");
    for (uint8_t at = 0u; at < 4u; at++) {
        print(names[at]);
        print_number((spent[at] * NS_PER_TICK) / (REPLAY_ROUNDS * ((at == 1u) ? 2u : 1u)), 10u, 6u);
        print(" instructions\n");
    }
    host(SYS_EXIT, EXITED);
    return 0;
}
