/* From reset to main() on a Cortex-M4F. */
#include "semihosting.h"

extern uint32_t image_data, begin_data, end_data, begin_bss, end_bss, stack_top;

int main(void);
void on_reset(void);
void on_fault(void);

__attribute__((section(".vectors"), used)) const uintptr_t vectors[16] = {
    (uintptr_t)&stack_top, (uintptr_t)on_reset, (uintptr_t)on_fault, (uintptr_t)on_fault,
    (uintptr_t)on_fault,   (uintptr_t)on_fault, (uintptr_t)on_fault,
};

void on_fault(void)
{
    host_print("fault\n");
    host_exit(99);
}

void on_reset(void)
{
    const uint32_t *from = &image_data;
    uint32_t *to;
    *(volatile uint32_t *)0xE000ED88u |= 0xFu << 20; /* CPACR: the floating-point unit on */
    __asm__ volatile("dsb\n\tisb");
    for (to = &begin_data; to < &end_data; ++to)
    {
        *to = *from++;
    }
    for (to = &begin_bss; to < &end_bss; ++to)
    {
        *to = 0u;
    }
    host_exit(main());
}
