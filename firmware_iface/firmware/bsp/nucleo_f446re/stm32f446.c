#include "stm32f446.h"

#define HSE_ON (1uL << 16u)
#define HSE_READY (1uL << 17u)
#define HSE_BYPASS (1uL << 18u)
#define PLL_ON (1uL << 24u)
#define PLL_READY (1uL << 25u)
/* 8 MHz / 4 * 168 / 2; Q and R as at reset, unused */
#define PLL_168_MHZ ((2uL << 28u) | (7uL << 24u) | (1uL << 22u) | (168uL << 6u) | 4uL)
#define BUSES ((4uL << 13u) | (5uL << 10u)) /* APB2 / 2, APB1 / 4 */
#define FROM_PLL 2uL
#define FLASH_168_MHZ ((1uL << 10u) | (1uL << 9u) | (1uL << 8u) | 5uL) /* caches, prefetch, 5 wait states */

#define BROWN_OUT_MASK (3uL << 2u)
#define BROWN_OUT_2V7 0uL
#define OPTION_LOCK 1uL
#define OPTION_START 2uL
#define FLASH_BUSY (1uL << 16u)
#define SUPPLY_2V9 ((7uL << 5u) | (1uL << 4u))
#define SUPPLY_LINE (1uL << 16u) /* of EXTI */

#define RESET_SUPPLY (1uL << 25u)
#define RESET_PIN (1uL << 26u)
#define RESET_POWER (1uL << 27u)
#define RESET_SOFTWARE (1uL << 28u)
#define RESET_WATCHDOGS ((1uL << 29u) | (1uL << 30u))
#define RESET_FORGET (1uL << 24u)

/* The chip comes with its brown-out reset off: below its lowest supply it may then do anything with the bridge. The level is
 * an option byte, which stays; it is written once in the life of a chip. */
static void brown_out_set(void)
{
    if ((FLASH_OPTCR & BROWN_OUT_MASK) != BROWN_OUT_2V7) {
        FLASH_OPTKEYR = 0x08192A3Bu;
        FLASH_OPTKEYR = 0x4C5D6E7Fu;
        FLASH_OPTCR = (FLASH_OPTCR & ~(BROWN_OUT_MASK | OPTION_LOCK)) | BROWN_OUT_2V7;
        FLASH_OPTCR |= OPTION_START;
        while ((FLASH_SR & FLASH_BUSY) != 0u) {
        }
        FLASH_OPTCR |= OPTION_LOCK;
    }
}

/* The supply's comparator interrupts, and nobody takes that: `unexpected`. */
static void supply_watch(void)
{
    clock_on(&RCC->apb1enr, APB1_PWR);
    PWR_CR = SUPPLY_2V9;
    EXTI->rtsr |= SUPPLY_LINE; /* its output rises when the supply falls */
    EXTI->imr |= SUPPLY_LINE;
    interrupt_enable(IRQ_SUPPLY, 0u);
}

void clock_on(reg_t *enable, uint32_t bits)
{
    *enable |= bits;
    (void)*enable; /* a write in the two bus cycles after the clock came would be lost: RM0390, "Peripheral clock enable" */
}

uint8_t reset_cause(void)
{
    const uint32_t causes = RCC->csr;
    uint8_t cause = 0u;

    RCC->csr |= RESET_FORGET;
    /* A power-up sets the bits of brown-out and pin, too, and every reset pulls the pin. */
    if ((causes & RESET_WATCHDOGS) != 0u) {
        cause = 3u;
    } else if ((causes & RESET_POWER) != 0u) {
        cause = 1u;
    } else if ((causes & RESET_SUPPLY) != 0u) {
        cause = 4u;
    } else if ((causes & RESET_SOFTWARE) != 0u) {
        cause = 5u;
    } else if ((causes & RESET_PIN) != 0u) {
        cause = 2u;
    } else {
        /* 0: the chip does not say */
    }
    return cause;
}

void chip_init(void)
{
    brown_out_set();
    RCC->cr |= HSE_BYPASS; /* can be set only while the oscillator is off */
    RCC->cr |= HSE_ON;
    while ((RCC->cr & HSE_READY) == 0u) {
    }
    RCC->pllcfgr = PLL_168_MHZ;
    RCC->cr |= PLL_ON;
    while ((RCC->cr & PLL_READY) == 0u) {
    }
    FLASH_ACR = FLASH_168_MHZ;
    RCC->cfgr = BUSES;
    RCC->cfgr |= FROM_PLL;
    while (((RCC->cfgr >> 2u) & 3u) != FROM_PLL) {
    }
    clock_on(&RCC->ahb1enr, 0xFu);
    clock_on(&RCC->apb1enr, APB1_TIM5);
    TIM5->psc = 83u;
    TIM5->arr = UINT32_MAX;
    TIM5->egr = 1u;
    TIM5->sr = 0u;
    TIM5->cr1 = 1u;
    supply_watch();
}

void pin_set_up(gpio_t *port, uint32_t pin, pin_mode_t mode, pin_pull_t pull)
{
    port->pupdr = (port->pupdr & ~(3uL << (2u * pin))) | ((uint32_t)pull << (2u * pin));
    port->ospeedr |= 2uL << (2u * pin);
    port->moder = (port->moder & ~(3uL << (2u * pin))) | ((uint32_t)mode << (2u * pin));
}

void pin_function(gpio_t *port, uint32_t pin, uint32_t function, pin_pull_t pull)
{
    const uint32_t shift = 4u * (pin % 8u);

    port->afr[pin / 8u] = (port->afr[pin / 8u] & ~(0xFuL << shift)) | (function << shift);
    pin_set_up(port, pin, PIN_FUNCTION, pull);
}

void timer_as_encoder(tim_t *timer, bool is_inverted)
{
    timer->arr = UINT32_MAX; /* a 16-bit timer keeps 0xFFFF of it */
    timer->ccmr1 = 0x3131u;  /* both channels are inputs, filtered over 8 clocks */
    timer->ccer = is_inverted ? 2u : 0u;
    timer->smcr = 3u; /* count at every edge of both */
    timer->cr1 = 1u;
}

void interrupt_enable(uint32_t number, uint8_t priority)
{
    NVIC_IPR[number] = (uint8_t)(priority << 4u);
    NVIC_ISER[number / 32u] = 1uL << (number % 32u);
}

void watchdog_start(void)
{
    IWDG_KR = 0x5555u;
    IWDG_PR = 0u; /* 32 kHz / 4 */
    IWDG_RLR = 80u;
    IWDG_KR = 0xCCCCu;
}

void watchdog_feed(void)
{
    IWDG_KR = 0xAAAAu;
}

uint32_t chip_serial_number(void)
{
    /* The words hold coordinates on the wafer, a lot number and text: multiply so that they do not cancel out. */
    return ((UNIQUE_ID[0] * 2654435761u) ^ (UNIQUE_ID[1] * 2246822519u)) + UNIQUE_ID[2];
}
