/* Frames of the encoder board's serial line: COBS and CRC-16/CCITT-FALSE (docs/encoder_board.md). */
#ifndef AW_FRAME_H
#define AW_FRAME_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define AW_CONTENT_MAX 62u /* type, sequence and body: 64 decoded bytes less the CRC */
#define AW_CODED_MAX 66u   /* a receiver discards a longer block, up to its 0x00 */
#define AW_FRAME_OVERHEAD 4u /* CRC, one code byte, delimiter */

/* Gathers the bytes of one line into blocks. All zero is a fresh one. */
typedef struct {
    uint8_t block[AW_CODED_MAX];
    uint8_t size;
    bool is_skipping; /* the block is too long: everything up to the next 0x00 is dropped */
} aw_receiver_t;

uint16_t aw_crc16(const uint8_t *data, size_t size);

/* Writes the wire form of `content`, with its 0x00; `wire` has room for `size` + AW_FRAME_OVERHEAD bytes.
 * Returns the number of bytes; 0 if `size` is 0 or more than AW_CONTENT_MAX. */
size_t aw_frame_encode(const uint8_t *content, size_t size, uint8_t *wire);

/* Takes one byte from the line. Returns the size of the content that it completes (type, sequence, body), which is
 * at `content` (AW_CODED_MAX bytes of room); 0 while a frame is incomplete, and for a bad one. */
size_t aw_receiver_put(aw_receiver_t *receiver, uint8_t byte, uint8_t *content);

#endif
