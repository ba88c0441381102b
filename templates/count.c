/* Called by the emulator before every block of instructions: how many there are. */
#include <stdint.h>

typedef struct
{
    const uint8_t *image;
    uint64_t base;
    uint64_t size;
    uint64_t skipped_from; /* what is there is not counted */
    uint64_t skipped_to;
    uint64_t count;
    int32_t thumb; /* 32 bits where the first five are 0b11101 or more; of RISC-V, where the last two are 0b11 */
} watch_t;

__attribute__((visibility("default"))) void count(void *engine, uint64_t address, uint32_t size, watch_t *watch)
{
    const uint64_t begin = address - watch->base;
    uint64_t at = begin;
    (void)engine;
    if ((address < watch->base) || (begin + size > watch->size) || ((address >= watch->skipped_from) && (address < watch->skipped_to)))
    {
        return;
    }
    while (at < begin + size)
    {
        const unsigned half = watch->image[at] | ((unsigned)watch->image[at + 1] << 8);
        at += (watch->thumb ? (half >= 0xe800u) : ((half & 3u) == 3u)) ? 4u : 2u;
        ++watch->count;
    }
}
