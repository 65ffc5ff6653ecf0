#include "aw_frame.h"

#define CRC_START 0xFFFFu
#define CRC_POLYNOMIAL 0x1021u
#define CRC_SIZE 2u
#define SMALLEST_DECODED 4u /* type, sequence, CRC */

/* One byte more. Eight shifts instead of a table: 512 bytes of flash are worth more than a microsecond a frame. */
static uint16_t crc16_add(uint16_t crc, uint8_t byte)
{
    uint32_t value = (uint32_t)crc ^ ((uint32_t)byte << 8u);

    for (uint8_t bit = 0u; bit < 8u; bit++) {
        const bool is_carried = (value & 0x8000u) != 0u;
        value = (value << 1u) & 0xFFFFu;
        if (is_carried) {
            value ^= CRC_POLYNOMIAL;
        }
    }
    return (uint16_t)value;
}

uint16_t aw_crc16(const uint8_t *data, size_t size)
{
    uint16_t crc = CRC_START;

    for (size_t at = 0u; at < size; at++) {
        crc = crc16_add(crc, data[at]);
    }
    return crc;
}

size_t aw_frame_encode(const uint8_t *content, size_t size, uint8_t *wire)
{
    size_t written = 0u;

    if ((size > 0u) && (size <= AW_CONTENT_MAX)) {
        const uint16_t crc = aw_crc16(content, size);
        size_t code_at = 0u; /* 64 bytes at most: no run reaches the 254 at which COBS splits it */

        written = 1u;
        for (size_t at = 0u; at < (size + CRC_SIZE); at++) {
            uint8_t byte;
            if (at < size) {
                byte = content[at];
            } else if (at == size) {
                byte = (uint8_t)(crc & 0xFFu);
            } else {
                byte = (uint8_t)(crc >> 8u);
            }
            if (byte == 0u) {
                wire[code_at] = (uint8_t)(written - code_at);
                code_at = written;
            } else {
                wire[written] = byte;
            }
            written++;
        }
        wire[code_at] = (uint8_t)(written - code_at);
        wire[written] = 0u;
        written++;
    }
    return written;
}

/* Decodes a block into `decoded`; returns its size, 0 if a code points past the end. A block holds no 0x00. */
static size_t cobs_decode(const uint8_t *block, size_t size, uint8_t *decoded)
{
    size_t written = 0u;
    size_t at = 0u;
    bool is_valid = true;

    while (is_valid && (at < size)) {
        const size_t end = at + block[at];
        if (end > size) {
            is_valid = false;
        } else {
            for (at++; at < end; at++) {
                decoded[written] = block[at];
                written++;
            }
            if (at < size) { /* the zero that a code stands for; the one behind the last is not part of the data */
                decoded[written] = 0u;
                written++;
            }
        }
    }
    return is_valid ? written : 0u;
}

static size_t content_of(const uint8_t *block, size_t size, uint8_t *content)
{
    size_t found = cobs_decode(block, size, content);

    if (found >= SMALLEST_DECODED) {
        const size_t checked = found - CRC_SIZE;
        const uint32_t sent = (uint32_t)content[checked] | ((uint32_t)content[checked + 1u] << 8u);
        found = (aw_crc16(content, checked) == sent) ? checked : 0u;
    } else {
        found = 0u;
    }
    return found;
}

size_t aw_receiver_put(aw_receiver_t *receiver, uint8_t byte, uint8_t *content)
{
    size_t found = 0u;

    if (byte == 0u) {
        if (!receiver->is_skipping) {
            found = content_of(receiver->block, receiver->size, content);
        }
        receiver->size = 0u;
        receiver->is_skipping = false;
    } else if (receiver->size < AW_CODED_MAX) {
        receiver->block[receiver->size] = byte;
        receiver->size++;
    } else {
        receiver->is_skipping = true;
    }
    return found;
}
