/* clock.h - instructions on QEMU: its SysTick runs at 25 MHz while an instruction takes 64 ns
 * (`-icount shift=6`). */
#include <stdint.h>

#define SYST_CSR (*(volatile uint32_t *)0xE000E010U)
#define SYST_RVR (*(volatile uint32_t *)0xE000E014U)
#define SYST_CVR (*(volatile uint32_t *)0xE000E018U)
#define NS_PER_TICK 40U
#define NS_PER_INSTRUCTION 64U

static unsigned long instructions(void)
{
    static uint32_t last;
    static uint64_t ticks;
    if ((SYST_CSR & 1U) == 0U) {
        SYST_RVR = 0xFFFFFFU;
        SYST_CVR = 0U;
        SYST_CSR = 5U; /* on, by the processor's clock */
        last = SYST_CVR;
    }
    const uint32_t now = SYST_CVR; /* counts down */
    ticks += (last - now) & 0xFFFFFFU;
    last = now;
    return (unsigned long)(ticks * NS_PER_TICK / NS_PER_INSTRUCTION);
}
