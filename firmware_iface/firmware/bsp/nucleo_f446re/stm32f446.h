/* The registers of an STM32F446 that the two boards use (reference manual RM0390), and what both need of the chip. */
#ifndef STM32F446_H
#define STM32F446_H

#include <stdbool.h>
#include <stdint.h>

typedef volatile uint32_t reg_t;

typedef struct {
    reg_t moder, otyper, ospeedr, pupdr, idr, odr, bsrr, lckr, afr[2];
} gpio_t;

typedef struct {
    reg_t cr1, cr2, smcr, dier, sr, egr, ccmr1, ccmr2, ccer, cnt, psc, arr, rcr, ccr1, ccr2, ccr3, ccr4, bdtr;
} tim_t;

typedef struct {
    reg_t sr, dr, brr, cr1, cr2, cr3;
} usart_t;

typedef struct {
    reg_t sr, cr1, cr2, smpr1, smpr2, jofr[4], htr, ltr, sqr[3], jsqr, jdr[4], dr;
} adc_t;

typedef struct {
    reg_t ir, dtr, dlr, dhr;
} can_mailbox_t;

typedef struct {
    reg_t mcr, msr, tsr, rf0r, rf1r, ier, esr, btr, reserved0[88];
    can_mailbox_t tx[3];
    can_mailbox_t rx[2];
    reg_t reserved1[12], fmr, fm1r, reserved2, fs1r, reserved3, ffa1r, reserved4, fa1r, reserved5[8], filter[28][2];
} can_t;

typedef struct {
    reg_t cr, pllcfgr, cfgr, cir, reserved0[8], ahb1enr, reserved1[3], apb1enr, apb2enr, reserved2[11], csr;
} rcc_t;

typedef struct {
    reg_t imr, emr, rtsr, ftsr, swier, pr;
} exti_t;

#define GPIO_A ((gpio_t *)0x40020000u)
#define GPIO_B ((gpio_t *)0x40020400u)
#define GPIO_C ((gpio_t *)0x40020800u)
#define GPIO_D ((gpio_t *)0x40020C00u)
#define RCC ((rcc_t *)0x40023800u)
#define FLASH_ACR (*(reg_t *)0x40023C00u)
#define FLASH_OPTKEYR (*(reg_t *)0x40023C08u)
#define FLASH_SR (*(reg_t *)0x40023C0Cu)
#define FLASH_OPTCR (*(reg_t *)0x40023C14u)
#define PWR_CR (*(reg_t *)0x40007000u)
#define TIM1 ((tim_t *)0x40010000u)
#define TIM2 ((tim_t *)0x40000000u) /* 32 bits */
#define TIM3 ((tim_t *)0x40000400u)
#define TIM4 ((tim_t *)0x40000800u)
#define TIM5 ((tim_t *)0x40000C00u) /* 32 bits: the microseconds */
#define USART1 ((usart_t *)0x40011000u)
#define ADC1 ((adc_t *)0x40012000u)
#define ADC_CCR (*(reg_t *)0x40012304u)
#define CAN1 ((can_t *)0x40006400u)
#define EXTI ((exti_t *)0x40013C00u)
#define SYSCFG_EXTICR ((reg_t *)0x40013808u)
#define IWDG_KR (*(reg_t *)0x40003000u)
#define IWDG_PR (*(reg_t *)0x40003004u)
#define IWDG_RLR (*(reg_t *)0x40003008u)
#define NVIC_ISER ((reg_t *)0xE000E100u)
#define NVIC_IPR ((volatile uint8_t *)0xE000E400u)
#define UNIQUE_ID ((const reg_t *)0x1FFF7A10u)

#define APB1_TIM2 (1uL << 0u)
#define APB1_TIM3 (1uL << 1u)
#define APB1_TIM4 (1uL << 2u)
#define APB1_TIM5 (1uL << 3u)
#define APB1_CAN1 (1uL << 25u)
#define APB1_PWR (1uL << 28u)
#define APB2_TIM1 (1uL << 0u)
#define APB2_USART1 (1uL << 4u)
#define APB2_ADC1 (1uL << 8u)
#define APB2_SYSCFG (1uL << 14u)

#define IRQ_SUPPLY 1u
#define IRQ_EXTI0 6u
#define IRQ_ADC 18u
#define IRQ_USART1 37u
#define IRQ_TIM5 50u

typedef enum { PIN_INPUT = 0, PIN_OUTPUT = 1, PIN_FUNCTION = 2, PIN_ANALOG = 3 } pin_mode_t;
typedef enum { PULL_NONE = 0, PULL_UP = 1, PULL_DOWN = 2 } pin_pull_t;

/* 168 MHz from the 8 MHz of the ST-LINK: APB1 42 MHz (its timers 84), APB2 84 MHz (its timers 168). Ports A to D and the
 * microseconds run afterwards. A 3.3 V supply below 2.9 V is `unexpected`, below 2.7 V it holds the chip in reset. */
void chip_init(void);

/* Gives peripherals their clock: bits of RCC->ahb1enr, apb1enr or apb2enr. They may be written to afterwards. */
void clock_on(reg_t *enable, uint32_t bits);

/* Why the chip last started, as docs/motor_board.md numbers it (reset_cause). To be asked once. */
uint8_t reset_cause(void);

/* Where whatever must not happen ends: board_off first, then nothing, until the watchdog resets the board. */
void unexpected(void);

/* What a board switches off by writing registers alone. Weak: nothing. */
void board_off(void);

void pin_set_up(gpio_t *port, uint32_t pin, pin_mode_t mode, pin_pull_t pull);
void pin_function(gpio_t *port, uint32_t pin, uint32_t function, pin_pull_t pull);

/* A timer counts the edges of an encoder at its channels 1 and 2. */
void timer_as_encoder(tim_t *timer, bool is_inverted);

/* Priority 0 is the first. */
void interrupt_enable(uint32_t number, uint8_t priority);

/* The independent watchdog resets a board whose main loop hangs for 10 ms. */
void watchdog_start(void);
void watchdog_feed(void);

/* A serial number of the chip's 96-bit identity. */
uint32_t chip_serial_number(void);

static inline uint32_t now_us(void)
{
    return TIM5->cnt;
}

#ifdef __arm__
static inline void interrupts_off(void)
{
    __asm volatile("cpsid i" ::: "memory");
}

static inline void interrupts_on(void)
{
    __asm volatile("cpsie i" ::: "memory");
}
#else /* test/nucleo.c: the registers are memory, and nothing interrupts */
static inline void interrupts_off(void)
{
}

static inline void interrupts_on(void)
{
}
#endif

#endif
