/* The motor board's own files for the Nucleo on this machine: registers are memory at their addresses, time is a register
 * that this file sets, and the fast loop's interrupt is a call. Says in one line each what the bridge does when parts fail. */
#define _GNU_SOURCE
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/time.h>
#include <sys/wait.h>
#include <ucontext.h>
#include <unistd.h>

#define main board_main
#define board_off bridge_off
#include "../bsp/nucleo_f446re/main_motor_board.c"
#undef board_off
#undef main
int board_main(void); /* as it is, with its endless loop: nobody calls it here */

extern void (*const vectors[])(void); /* startup.c has them in a union with the stack's address */
uint32_t stack_top, data_start, data_end, data_image, bss_start, bss_end; /* of the linker script */

#define HSE_AND_PLL_READY ((1uL << 17u) | (1uL << 25u))
#define CLOCK_IS_PLL (2uL << 2u)
#define CAN_IS_INITIALISING 1uL
#define FED 0xAAAAu
#define BROWN_OUT_OFF (3uL << 2u)
#define HARD_FAULT 3u
#define PAGE 0x1000u
#define APB1 0x40000000u
#define NODE 1u

static aw_motor_inputs_t inputs;

static void map(uintptr_t from, size_t size)
{
    if (mmap((void *)from, size, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS | MAP_FIXED, -1, 0) == MAP_FAILED) {
        perror("mmap");
        exit(2);
    }
}

/* The chip says that it runs from the PLL once it has been told to: what is set before that is overwritten. */
static void follow_clock(int number)
{
    (void)number;
    RCC->cfgr |= CLOCK_IS_PLL;
}

#if defined(__x86_64__)
/* What the chip does with writes to a timer of APB1: until its clock's register was read back, they are lost. Pages are open for
 * one instruction at a time. */
#define ONE_STEP 0x100
#define IS_WRITE 2

static uintptr_t opened;
static uint32_t clocked;
static unsigned lost;

static void touched(int number, siginfo_t *what, void *context)
{
    ucontext_t *const at = context;
    const uintptr_t address = (uintptr_t)what->si_addr;
    const bool is_write = (at->uc_mcontext.gregs[REG_ERR] & IS_WRITE) != 0;

    (void)number;
    opened = address & ~(uintptr_t)(PAGE - 1u);
    (void)mprotect((void *)opened, PAGE, PROT_READ | PROT_WRITE);
    if ((address == (uintptr_t)&RCC->apb1enr) && !is_write) {
        clocked = RCC->apb1enr;
    }
    if ((opened == APB1) && is_write && (((clocked >> ((address - APB1) / 0x400u)) & 1u) == 0u)) {
        lost++;
    }
    at->uc_mcontext.gregs[REG_EFL] |= ONE_STEP;
    (void)sigaddset(&at->uc_sigmask, SIGALRM);
}

static void stepped(int number, siginfo_t *what, void *context)
{
    ucontext_t *const at = context;

    (void)number;
    (void)what;
    (void)mprotect((void *)opened, PAGE, PROT_NONE);
    at->uc_mcontext.gregs[REG_EFL] &= ~(greg_t)ONE_STEP;
    (void)sigdelset(&at->uc_sigmask, SIGALRM);
}

static void start_clocks(void)
{
    struct sigaction act = {.sa_flags = SA_SIGINFO};

    (void)sigaddset(&act.sa_mask, SIGALRM);
    act.sa_sigaction = touched;
    (void)sigaction(SIGSEGV, &act, NULL);
    act.sa_sigaction = stepped;
    (void)sigaction(SIGTRAP, &act, NULL);
    (void)mprotect((void *)APB1, PAGE, PROT_NONE);
    (void)mprotect((void *)((uintptr_t)RCC & ~(uintptr_t)(PAGE - 1u)), PAGE, PROT_NONE);
    chip_init();
    printf("writes to a timer before its clock: %u\n", lost);
    _exit(0);
}
#else
static void start_clocks(void)
{
    printf("writes to a timer before its clock: 0\n"); /* looked at on x86 alone */
    _exit(0);
}
#endif

static void power_up(void)
{
    const struct itimerval often = {{0, 1000}, {0, 1000}};
    const struct itimerval never = {{0, 0}, {0, 0}};
    aw_motor_setup_t setup = {7u, COUNTS_PER_TURN, RATING_MA, LOWEST_SUPPLY_MV, HIGHEST_SUPPLY_MV, RATED_MDEGC, FIRMWARE,
                              PERIOD_US, NODE, PINS, 0u};

    map(0x40000000u, 0x80000u);
    map(0xE000E000u, 0x1000u);
    map(0x1FFF7000u, 0x1000u);
    RCC->cr = HSE_AND_PLL_READY;
    FLASH_OPTCR = BROWN_OUT_OFF;
    (void)signal(SIGALRM, follow_clock);
    if (fork() == 0) {
        (void)setitimer(ITIMER_REAL, &often, NULL);
        start_clocks();
    }
    (void)wait(NULL);
    (void)setitimer(ITIMER_REAL, &often, NULL);
    CAN1->msr = CAN_IS_INITIALISING;
    CAN1->tsr = CAN_EMPTY(0u);
    GPIO_B->idr = 1uL << BRIDGE_FAULT;
    ADC1->jdr[0] = CURRENT_ZERO;
    ADC1->jdr[1] = 24000000u / SUPPLY_UV_COUNT;
    ADC1->jdr[2] = 930u; /* 25 degC */
    set_up();
    (void)setitimer(ITIMER_REAL, &never, NULL);
    setup.reset_cause = reset_cause();
    look(&inputs);
    aw_motor_init(&board, &setup, &inputs);
    GPIO_B->odr = 1uL << BRIDGE_ENABLE;
}

/* As the chip does with what was written to BSRR. */
static void take_pins(void)
{
    GPIO_B->odr = (GPIO_B->odr | (GPIO_B->bsrr & 0xFFFFu)) & ~(GPIO_B->bsrr >> 16u);
    GPIO_B->bsrr = 0u;
}

static void run(uint32_t time_us, bool has_fast_loop)
{
    for (uint32_t at = 0u; at < time_us; at += PWM_US) {
        TIM5->cnt += PWM_US;
        if (has_fast_loop) {
            adc_handler();
        }
        turn(&inputs);
    }
}

static void hear(uint32_t id, uint32_t size, uint8_t first, uint8_t second, uint32_t value)
{
    CAN1->rx[0].ir = id << 21u;
    CAN1->rx[0].dtr = size;
    CAN1->rx[0].dlr = (uint32_t)first | ((uint32_t)second << 8u) | (value << 16u);
    CAN1->rx[0].dhr = value >> 16u;
    CAN1->rf0r = 1u;
    serve(&inputs); /* takes it, and writes RF0R to release the mailbox */
    CAN1->rf0r = 0u;
}

static void enable(void)
{
    static const uint8_t words[] = {0x06u, 0x07u, 0x0Fu, 0x0Fu};

    run(500000u, true);
    for (uint8_t at = 0u; at < sizeof words; at++) {
        hear(0x100u + NODE, 8u, words[at], (uint8_t)(1u | (at << 3u)), 6000u);
        run(1000u, true);
    }
}

static void print_bridge(const char *when)
{
    take_pins();
    printf("%s: state %02x, enable %u, MOE %u, duty %u %u\n", when, (unsigned)aw_motor_state(&board),
           (unsigned)((GPIO_B->odr >> BRIDGE_ENABLE) & 1u), (unsigned)((TIM1->bdtr >> 15u) & 1u), (unsigned)TIM1->ccr1,
           (unsigned)TIM1->ccr2);
}

static const char *ending;

static void stuck(int number)
{
    (void)number;
    print_bridge(ending);
    _exit((IWDG_KR == FED) ? 1 : 0);
}

/* `unexpected` begins so, and never returns: what it is like a little later is said by `stuck`. */
void board_off(void)
{
    const struct itimerval soon = {{0, 0}, {0, 5000}};

    bridge_off();
    (void)signal(SIGALRM, stuck);
    (void)setitimer(ITIMER_REAL, &soon, NULL);
}

/* Runs what ends in `unexpected` in a process of its own. */
static void until_stuck(const char *name, void (*what)(void))
{
    int status;

    if (fork() == 0) {
        ending = name;
        IWDG_KR = 0u;
        what();
        _exit(2);
    }
    (void)wait(&status);
    printf("%s\n", (status == 0) ? "stuck, and the watchdog unfed" : "it went on, or fed the watchdog");
}

/* The watchdog is fed until the fast loop is late, and not once more. */
static void stall(void)
{
    run(FAST_LOOP_LATE_US - PWM_US, false);
    IWDG_KR = 0u;
    run(10000u, false);
}

/* Through the vectors, as the processor goes: its own fault, and the comparator of the 3.3 V, which has to be let through. */
static void fail(void)
{
    vectors[HARD_FAULT]();
}

static void lose_supply(void)
{
    const uint32_t line = 1uL << 16u;

    if (((EXTI->imr & EXTI->rtsr & line) != 0u) && ((PWR_CR & (1uL << 4u)) != 0u)) {
        vectors[16u + IRQ_SUPPLY]();
    }
}

int main(void)
{
    /* RM0390, RCC_CSR: nothing; power, pin and brown-out; pin; watchdog and pin; brown-out and pin; software and pin */
    static const uint32_t flags[] = {0u, 7uL << 25u, 2uL << 25u, 18uL << 25u, 3uL << 25u, 10uL << 25u};

    (void)setvbuf(stdout, NULL, _IONBF, 0u); /* a child must not repeat what was said before it */
    power_up();
    for (uint8_t at = 0u; at < (sizeof flags / sizeof flags[0]); at++) {
        RCC->csr = flags[at];
        printf("reset flags %02x: cause %u\n", (unsigned)(flags[at] >> 25u), (unsigned)reset_cause());
    }
    printf("brown-out reset: level %u, written %u\n", (unsigned)(FLASH_OPTCR & BROWN_OUT_OFF) >> 2u,
           (unsigned)((FLASH_OPTCR >> 1u) & 1u));
    print_bridge("at power-up");
    enable();
    print_bridge("at 6 V");
    until_stuck("0.5 ms without the fast loop", stall);
    until_stuck("a fault of the processor", fail);
    until_stuck("3.3 V below 2.9 V", lose_supply);
    hear(0x000u, 1u, 0u, 0u, 0u);
    print_bridge("emergency stop, the fast loop stalled");
    return 0;
}
