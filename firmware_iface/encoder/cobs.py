"""Consistent Overhead Byte Stuffing (Cheshire and Baker, IEEE/ACM Trans. Networking 7(2), 1999).

A coded block holds no 0x00, so 0x00 can end it. Each run of up to 254 bytes without a zero is
written as its length + 1 and itself; a length below 255 implies the zero that followed.
"""

DELIMITER = b"\x00"
_LONGEST_CODE = 0xFF  # 254 bytes follow, and no zero is implied


def encode(raw: bytes) -> bytes:
    """Encode `raw`, without the delimiter; at most len(raw) // 254 + 1 bytes longer."""
    if len(raw) < _LONGEST_CODE - 1:
        runs = raw.split(DELIMITER)
        return b"".join([part for run in runs for part in (bytes((len(run) + 1,)), run)])
    return _encode_long(raw)


def decode(coded: bytes) -> bytearray | None:
    """Decode a block (without its delimiter); None if it is invalid."""
    size = len(coded)
    if size >= _LONGEST_CODE:
        return _decode_long(coded)
    # Below 255 bytes each code byte replaces a zero: restore the zeros and drop the first code.
    # The appended zero ends the loop where a valid block ends; a code that points past it raises IndexError.
    raw = bytearray(coded + DELIMITER)
    at = 0
    try:
        while code := raw[at]:
            raw[at] = 0
            at += code
    except IndexError:
        return None
    return raw[1:at] if at == size and size else None


def _encode_long(raw: bytes) -> bytes:
    coded = bytearray()
    runs = raw.split(DELIMITER)
    for number, run in enumerate(runs):
        while len(run) >= _LONGEST_CODE - 1:
            coded.append(_LONGEST_CODE)
            coded += run[: _LONGEST_CODE - 1]
            run = run[_LONGEST_CODE - 1 :]
            if not run and number == len(runs) - 1:
                return bytes(coded)  # the data ends with a full run: no zero follows
        coded.append(len(run) + 1)
        coded += run
    return bytes(coded)


def _decode_long(coded: bytes) -> bytearray | None:
    raw = bytearray()
    at = 0
    while at < len(coded):
        code = coded[at]
        run = coded[at + 1 : at + code]
        if code == 0 or DELIMITER in run or len(run) != code - 1:
            return None
        raw += run
        at += code
        if code != _LONGEST_CODE and at < len(coded):
            raw += DELIMITER
    return raw
