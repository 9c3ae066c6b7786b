/* startup.c - vectors of a Cortex-M4F for the tests on QEMU; a target has its own. */
#include <stdint.h>

extern void _start(void);
extern uint32_t stack_top;

void reset(void);
void reset(void)
{
    *(volatile uint32_t *)0xE000ED88U |= 0xFU << 20; /* floating-point unit on */
    __asm volatile("dsb\n isb");
    _start(); /* of newlib, with semihosting */
}

static void fault(void)
{
    for (;;) {
        __asm volatile("bkpt 0");
    }
}

__attribute__((section(".vectors"), used)) static const void *const vectors[16] = {
    &stack_top, (void *)reset, (void *)fault, (void *)fault, (void *)fault, (void *)fault,
    (void *)fault,
};
