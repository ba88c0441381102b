/* Functions of a program on an emulated AVR, one after the other, by libsimavr. */
#include <simavr/sim_avr.h>
#include <stdint.h>
#include <string.h>

#define EXPORT __attribute__((visibility("default")))

/* Where data are in the addresses of the linker, and where functions return to, in bytes. */
#define DATA 0x800000u
#define RETURN 0x3fff0u

EXPORT void *avr_new(void)
{
    avr_t *avr = avr_make_mcu_by_name("atmega2560");
    if (avr != NULL)
    {
        (void)avr_init(avr);
        avr->log = LOG_NONE;
    }
    return avr;
}

/* Room for that many bytes at an address; 0 if there is none. */
static uint8_t *place(avr_t *avr, uint32_t address, uint32_t size)
{
    if (address >= DATA)
    {
        return ((address - DATA + size) <= (uint32_t)avr->ramend + 1u) ? &avr->data[address - DATA] : NULL;
    }
    return ((address + size) <= RETURN) ? &avr->flash[address] : NULL;
}

EXPORT int avr_put(avr_t *avr, uint32_t address, const uint8_t *bytes, uint32_t size)
{
    uint8_t *to = place(avr, address, size);
    if (to != NULL)
    {
        memcpy(to, bytes, size);
    }
    return to != NULL;
}

EXPORT int avr_get(avr_t *avr, uint32_t address, uint8_t *bytes, uint32_t size)
{
    const uint8_t *from = place(avr, address, size);
    if (from != NULL)
    {
        memcpy(bytes, from, size);
    }
    return from != NULL;
}

EXPORT uint32_t avr_top(const avr_t *avr)
{
    return DATA + avr->ramend;
}

/* Instructions that a function took, without those in a range; -1 if it took more than the most, -2 if the processor stopped. */
EXPORT int64_t avr_call(avr_t *avr, uint32_t address, const uint32_t skipped[2], int64_t most, int *result)
{
    int64_t count = 0;
    uint32_t back = RETURN / 2u, i, top = avr->ramend;
    for (i = 0u; i < avr->address_size; ++i)
    {
        avr->data[top] = (uint8_t)back;
        back >>= 8;
        --top;
    }
    avr->data[R_SPL] = (uint8_t)top;
    avr->data[R_SPH] = (uint8_t)(top >> 8);
    avr->data[1] = 0u;
    avr->pc = address;
    avr->state = cpu_Running;
    while (avr->pc != RETURN)
    {
        avr->run_cycle_limit = 1;
        avr->run_cycle_count = 1;
        if (avr_run(avr) != cpu_Running)
        {
            return -2;
        }
        count += ((avr->pc < skipped[0]) || (avr->pc >= skipped[1])) ? 1 : 0;
        if (count > most)
        {
            return -1;
        }
    }
    *result = (int16_t)(uint16_t)(avr->data[24] | (avr->data[25] << 8));
    return count;
}
