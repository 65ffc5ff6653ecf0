"""C3D files (www.c3d.org): the markers of the 3D section; Intel, DEC and SGI/MIPS processors, whole numbers or floats.

Blocks of 512 bytes. Byte 0 of the first: block of the parameters, byte 1: 0x50. Parameters: byte 3 of their block is the
processor (84 Intel, 85 DEC, 86 MIPS); then records: length of the name i8, group i8 (negative: a group), name, offset to the next
i16; of a parameter: type i8, dimensions u8 and their sizes u8, data. A point is x, y, z and a fourth word whose sign is negative
where it was not seen; POINT:SCALE is negative for floats.

Most values stand twice: in words of the header (from 1, 16 bits each: 2 points, 3 analog values a frame, 4 and 5 first and last
frame, 7-8 scale, 9 block of the data, 11-12 rate), which are too narrow for long recordings, and in parameters, which may be 0.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from struct import error, unpack_from

import numpy as np
import numpy.typing as npt

from calib.arrays import Array
from calib.capture.tracks import FRAMES_MOST, Capture, CaptureError
from control.files import read_bytes

BLOCK_bytes = 512
KEY = 0x50
INTEL, DEC, MIPS = 84, 85, 86
UNITS = {"mm": 1e-3, "m": 1.0, "cm": 1e-2}
FASTEST_Hz = 10_000.0
WORD, WORD_MOST = 65536, 65535
SPARE = 0.02  # of the frames: more room than that is no padding of the last block
Value = npt.NDArray[np.float64] | tuple[str, ...]


def read_c3d(path: Path) -> Capture:
    """The markers of a file. CaptureError if it is not whole or not C3D."""
    try:
        content = read_bytes(path)
    except OSError as problem:
        raise CaptureError(f"{path}: cannot be read: {problem.strerror}") from None
    try:
        return _read(path, content)
    except (error, IndexError, ValueError, OverflowError) as problem:
        raise CaptureError(f"{path}: not a whole C3D file ({problem})") from None


def _read(path: Path, content: bytes) -> Capture:
    if len(content) < 2 * BLOCK_bytes or content[1] != KEY:
        raise CaptureError(f"{path}: not a C3D file: its second byte is not 0x50")
    start = (content[0] - 1) * BLOCK_bytes
    kind = content[start + 3]
    if kind not in (INTEL, DEC, MIPS):
        raise CaptureError(f"{path}: processor type {kind}: expected 84 (Intel), 85 (DEC) or 86 (MIPS)")
    parameters = dict(_parameters(content, start, kind))
    order = ">" if kind == MIPS else "<"
    words = unpack_from(f"{order}10H", content, 0)
    scale = _one(path, parameters, "POINT:SCALE") or _real(content, 12, kind)
    rate_Hz = _one(path, parameters, "POINT:RATE") or _real(content, 20, kind)
    points = _one(path, parameters, "POINT:USED") or float(words[1])
    begin = (round(_one(path, parameters, "POINT:DATA_START") or words[8]) - 1) * BLOCK_bytes
    analog = words[2] or _analog(parameters, rate_Hz)
    if not 0.0 < rate_Hz <= FASTEST_Hz or not math.isfinite(scale) or scale == 0.0 or points < 1:
        raise CaptureError(
            f"{path}: rate {rate_Hz:g} Hz, scale {scale:g}, {points:g} points: expected a recording of markers"
        )
    held = max(0, len(content) - begin) // ((4 * round(points) + analog) * (2 if scale > 0.0 else 4))
    frames, notes = _frames(path, parameters, words[3:5], held)
    table = _values(content, begin, frames, round(points), analog, kind, scale)
    seen = (table[:, :, 3] >= 0.0) & np.isfinite(table[:, :, :3]).all(axis=2)
    unit = _unit(path, parameters)
    factor = unit * (scale if scale > 0.0 else 1.0)
    places = np.where(seen[:, :, None], factor * table[:, :, :3], np.nan)
    names = _names(parameters, round(points))
    tracks = {name: places[:, k] for k, name in enumerate(names)}
    return Capture(path, np.arange(frames) / rate_Hz, {}, tracks, notes)


def _frames(
    path: Path, parameters: dict[str, Value], header: tuple[int, ...], held: int
) -> tuple[int, tuple[str, ...]]:
    """The most that the file states and holds; a sentence if it states several counts, or holds more frames than it states.

    Long recordings state it in POINT:FRAMES or LONG_FRAMES, or in TRIAL:ACTUAL_START_FIELD and ACTUAL_END_FIELD, two words
    each, the lower first; 16 bits end at 65535.
    """
    start, end = (_long(parameters, f"TRIAL:ACTUAL_{which}_FIELD") for which in ("START", "END"))
    stated = {
        "the header": header[1] - header[0] + 1 if header[1] else 0,
        "POINT:FRAMES": _long(parameters, "POINT:FRAMES"),
        "POINT:LONG_FRAMES": _long(parameters, "POINT:LONG_FRAMES"),
        "TRIAL:ACTUAL_END_FIELD": end - max(start, 1) + 1 if end else 0,
    }
    counts = {name: count for name, count in stated.items() if count > 0}
    fitting = {name: count for name, count in counts.items() if count <= held}
    if not counts:
        raise CaptureError(f"{path}: 0 frames: expected 1 to {FRAMES_MOST}")
    frames = max((fitting or counts).values())
    if frames > FRAMES_MOST:
        raise CaptureError(f"{path}: {frames} frames: expected 1 to {FRAMES_MOST}")
    notes = []
    is_long = frames > WORD_MOST and frames == max(counts.values())  # which 16 bits do not hold
    if len(set(counts.values())) > 1 and not is_long:
        said = ", ".join(f"{name} {count}" for name, count in counts.items())
        notes.append(f"{path}: the numbers of frames differ ({said}); {frames} were read")
    if held > (1.0 + SPARE) * frames + 1.0:
        notes.append(
            f"{path}: {frames} frames are stated, and there is room for {held}: the rest was not read"
        )
    return frames, tuple(notes)


def _long(parameters: dict[str, Value], name: str) -> int:
    """A number of one 16-bit word or of two, the lower first; 0 where there is none."""
    value = parameters.get(name)
    if not isinstance(value, np.ndarray) or not value.size:
        return 0
    low, *high = (round(float(one)) for one in value.flat)
    low += WORD if low < 0 and low >= -WORD else 0
    return low + (WORD * (high[0] % WORD) if high else 0)


def _analog(parameters: dict[str, Value], rate_Hz: float) -> int:
    """Analog values a frame, by the parameters."""
    used, rate = (parameters.get(f"ANALOG:{name}") for name in ("USED", "RATE"))
    if not isinstance(used, np.ndarray) or not isinstance(rate, np.ndarray) or not used.size or not rate.size:
        return 0
    samples = round(float(rate.flat[0]) / rate_Hz) if rate_Hz > 0.0 else 0
    return max(0, round(float(used.flat[0]))) * max(1, samples)


def _real(content: bytes, at: int, kind: int) -> float:
    """A float of the header."""
    if kind != DEC:
        return float(unpack_from(">f" if kind == MIPS else "<f", content, at)[0])
    return float(_of_dec(np.frombuffer(content, "<u4", 1, at).astype(np.uint32))[0])


def _values(
    content: bytes, begin: int, frames: int, points: int, analog: int, kind: int, scale: float
) -> Array:
    """(frames, points, 4); what follows the points of a frame is analog."""
    order = ">" if kind == MIPS else "<"
    code = f"{order}i2" if scale > 0.0 else f"{order}u4" if kind == DEC else f"{order}f4"
    width = 4 * points + analog
    size = np.dtype(code).itemsize
    if begin < 0 or begin + frames * width * size > len(content):
        raise ValueError(f"{frames} frames of {points} points do not fit into it")
    raw = np.frombuffer(content, code, frames * width, begin).reshape(frames, width)[:, : 4 * points]
    values = _of_dec(raw.astype(np.uint32)) if code == "<u4" else raw.astype(np.float64)
    return values.reshape(frames, points, 4)


def _of_dec(words: npt.NDArray[np.uint32]) -> Array:
    """Floats of a VAX (F): the halves of each word are exchanged, and the exponent is two more than IEEE's."""
    swapped = ((words >> np.uint32(16)) | (words << np.uint32(16))).astype(np.uint32)
    return np.asarray(swapped.view(np.float32).astype(np.float64) / 4.0)


def _parameters(content: bytes, start: int, kind: int) -> Iterator[tuple[str, Value]]:
    """GROUP:NAME and value of each parameter; groups may come after their parameters."""
    groups, found = dict[int, str](), list[tuple[int, str, Value]]()
    at, order = start + 4, ">" if kind == MIPS else "<"
    end = min(len(content), start + max(1, content[start + 2]) * BLOCK_bytes)
    while at + 2 < end:
        length, group = unpack_from("bb", content, at)
        if not length or not group:
            break
        name_end = at + 2 + abs(length)
        name = content[at + 2 : name_end].decode("latin-1").strip().upper()
        (step,) = unpack_from(f"{order}h", content, name_end)
        if group < 0:
            groups[-group] = name
        else:
            found.append((group, name, _value(content, name_end + 2, kind)))
        if step <= 0:
            break
        at = name_end + step
    for group, name, value in found:
        yield f"{groups.get(group, '')}:{name}", value


def _value(content: bytes, at: int, kind: int) -> Value:
    """Text as a tuple, numbers as an array."""
    sort, dimensions = unpack_from("bB", content, at)
    sizes = tuple(content[at + 2 : at + 2 + dimensions])
    begin, count = at + 2 + dimensions, math.prod(sizes)
    if begin + count > len(content):
        raise ValueError(f"a parameter of {count} values")
    order = ">" if kind == MIPS else "<"
    if sort == -1:
        width = sizes[0] if sizes else 1
        text = content[begin : begin + count]
        return tuple(
            text[k : k + width].decode("latin-1").strip().strip("\0")
            for k in range(0, len(text), max(1, width))
        )
    code = {1: "u1", 2: f"{order}i2", 4: "<u4" if kind == DEC else f"{order}f4"}.get(sort)
    if code is None:
        raise ValueError(f"a parameter of type {sort}")
    raw = np.frombuffer(content, code, count, begin)
    return _of_dec(raw.astype(np.uint32)) if code == "<u4" else raw.astype(np.float64)


def _one(path: Path, parameters: dict[str, Value], name: str) -> float:
    value = parameters.get(name)
    if not isinstance(value, np.ndarray) or not value.size:
        raise CaptureError(f"{path}: the parameter {name} is missing")
    number = float(value.flat[0])
    return number + 65536.0 if number < 0.0 and name in ("POINT:USED", "POINT:DATA_START") else number


def _unit(path: Path, parameters: dict[str, Value]) -> float:
    value = parameters.get("POINT:UNITS", ("mm",))
    text = value[0].lower() if isinstance(value, tuple) and value else "mm"
    if text not in UNITS:
        raise CaptureError(f'{path}: lengths in "{text}", expected one of {", ".join(UNITS)}')
    return UNITS[text]


def _names(parameters: dict[str, Value], count: int) -> list[str]:
    """Labels, without the subject's name before a colon where that leaves them different; numbers for what has none."""
    labels, more = list[str](), 1
    while isinstance(stated := parameters.get(f"POINT:LABELS{more if more > 1 else ''}"), tuple):
        labels, more = [*labels, *stated], more + 1  # 255 at most in each
    labels = labels[:count]
    labels += [""] * (count - len(labels))
    full = [label or f"point{k + 1}" for k, label in enumerate(labels)]
    short = [name.rpartition(":")[2] for name in full]
    wanted = short if len(set(short)) == count else full
    return [name if wanted.index(name) == k else f"{name}_{k + 1}" for k, name in enumerate(wanted)]
