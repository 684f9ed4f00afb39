/* The start of a program on an emulated Cortex-M with semihosting: vectors, data, floating-point unit, main. */
#include <stdint.h>

extern uint32_t stack_top, data_at, data_begin, data_end, bss_begin, bss_end;
extern void initialise_monitor_handles(void);
extern void exit(int);
extern int main(void);

void _init(void) {}
void _fini(void) {}

void start(void) {
    uint32_t *from = &data_at;
    for (uint32_t *to = &data_begin; to < &data_end;) *to++ = *from++;
    for (uint32_t *to = &bss_begin; to < &bss_end;) *to++ = 0;
    *(volatile uint32_t *)0xE000ED88 |= 0xFu << 20; /* both coprocessors that are the floating-point unit */
    initialise_monitor_handles();
    exit(main());
}

static void halt(void) {
    for (;;) {}
}

typedef union {
    uint32_t *stack;
    void (*handler)(void);
} vector;

__attribute__((section(".vectors"), used)) static const vector vectors[16] = {
    {.stack = &stack_top}, {.handler = start}, {.handler = halt}, {.handler = halt},
    {.handler = halt}, {.handler = halt}, {.handler = halt}};
