/* Vector table and reset of an STM32F446. What nobody takes, faults of the processor too, is `unexpected`. */
#include <stdint.h>

#include "stm32f446.h"

#define VECTORS (16u + 97u)

extern uint32_t stack_top, data_start, data_end, data_image, bss_start, bss_end; /* of the linker script */

int main(void);
void reset_handler(void);
void exti0_handler(void) __attribute__((weak, alias("unexpected")));
void exti1_handler(void) __attribute__((weak, alias("unexpected")));
void exti2_handler(void) __attribute__((weak, alias("unexpected")));
void adc_handler(void) __attribute__((weak, alias("unexpected")));
void usart1_handler(void) __attribute__((weak, alias("unexpected")));
void tim5_handler(void) __attribute__((weak, alias("unexpected")));

typedef union {
    void (*handler)(void);
    const uint32_t *stack;
} vector_t;

const vector_t vectors[VECTORS] __attribute__((section(".vectors"), used)) = {
    [0] = {.stack = &stack_top},
    [1] = {.handler = reset_handler},
    [2] = {.handler = unexpected},
    [3] = {.handler = unexpected},
    [4] = {.handler = unexpected},
    [5] = {.handler = unexpected},
    [6] = {.handler = unexpected},
    [16 + IRQ_SUPPLY] = {.handler = unexpected},
    [16 + IRQ_EXTI0] = {.handler = exti0_handler},
    [16 + IRQ_EXTI0 + 1] = {.handler = exti1_handler},
    [16 + IRQ_EXTI0 + 2] = {.handler = exti2_handler},
    [16 + IRQ_ADC] = {.handler = adc_handler},
    [16 + IRQ_USART1] = {.handler = usart1_handler},
    [16 + IRQ_TIM5] = {.handler = tim5_handler},
};

void reset_handler(void)
{
    const uint32_t *from = &data_image;

    for (uint32_t *to = &data_start; to < &data_end; to++) {
        *to = *from;
        from++;
    }
    for (uint32_t *to = &bss_start; to < &bss_end; to++) {
        *to = 0u;
    }
    (void)main();
    unexpected();
}

void board_off(void) __attribute__((weak));

void board_off(void)
{
}

void unexpected(void)
{
    board_off();
    interrupts_off();
    for (;;) {
    }
}
