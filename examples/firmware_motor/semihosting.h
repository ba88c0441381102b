/* Files of the host, by the calls that debuggers and emulators of Arm cores answer. */
#ifndef SEMIHOSTING_H
#define SEMIHOSTING_H

#include <stdint.h>

enum
{
    HOST_OPEN = 0x01,
    HOST_PRINT = 0x04,
    HOST_WRITE = 0x05,
    HOST_READ = 0x06,
    HOST_EXIT = 0x20
};

static inline int host_call(uintptr_t operation, const void *argument)
{
    register uintptr_t r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = argument;
    __asm__ volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory", "cc");
    return (int)r0;
}

static inline void host_print(const char *text)
{
    (void)host_call(HOST_PRINT, text);
}

/* A file to read (mode 1) or to write (mode 5), both as bytes; -1 if there is none. */
static inline int host_open(const char *name, uintptr_t length, uintptr_t mode)
{
    const uintptr_t given[3] = { (uintptr_t)name, mode, length };
    return host_call(HOST_OPEN, given);
}

/* Bytes that were not read. */
static inline int host_read(int file, void *to, uintptr_t size)
{
    const uintptr_t given[3] = { (uintptr_t)file, (uintptr_t)to, size };
    return host_call(HOST_READ, given);
}

/* Bytes that were not written. */
static inline int host_write(int file, const void *from, uintptr_t size)
{
    const uintptr_t given[3] = { (uintptr_t)file, (uintptr_t)from, size };
    return host_call(HOST_WRITE, given);
}

static inline void host_exit(int code)
{
    const uintptr_t given[2] = { 0x20026u, (uintptr_t)code };
    for (;;)
    {
        (void)host_call(HOST_EXIT, given);
    }
}

#endif
