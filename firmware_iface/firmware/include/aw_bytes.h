/* Little-endian numbers in byte arrays, whatever the processor's own order and alignment. */
#ifndef AW_BYTES_H
#define AW_BYTES_H

#include <stdint.h>

static inline void aw_put_u16(uint8_t *to, uint16_t value)
{
    to[0] = (uint8_t)(value & 0xFFu);
    to[1] = (uint8_t)(value >> 8u);
}

static inline void aw_put_u32(uint8_t *to, uint32_t value)
{
    aw_put_u16(to, (uint16_t)(value & 0xFFFFu));
    aw_put_u16(&to[2], (uint16_t)(value >> 16u));
}

static inline uint32_t aw_get_u32(const uint8_t *from)
{
    return (uint32_t)from[0] | ((uint32_t)from[1] << 8u) | ((uint32_t)from[2] << 16u) | ((uint32_t)from[3] << 24u);
}

/* The number whose two's complement is `bits`. A cast alone would be implementation-defined above INT32_MAX. */
static inline int32_t aw_signed32(uint32_t bits)
{
    return (bits <= (uint32_t)INT32_MAX) ? (int32_t)bits : (-(int32_t)(UINT32_MAX - bits) - 1);
}

static inline int16_t aw_signed16(uint16_t bits)
{
    return (bits <= 0x7FFFu) ? (int16_t)bits : (int16_t)((int32_t)bits - 0x10000);
}

#endif
