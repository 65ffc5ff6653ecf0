"""C3D files (www.c3d.org): the markers of the 3D section; Intel, DEC and SGI/MIPS processors, whole numbers or floats.

Blocks of 512 bytes. Byte 0 of the first: block of the parameters, byte 1: 0x50. Parameters: byte 3 of their block is the
processor (84 Intel, 85 DEC, 86 MIPS); then records: length of the name i8, group i8 (negative: a group), name, offset to the next
i16; of a parameter: type i8, dimensions u8 and their sizes u8, data. A point is x, y, z and a fourth word whose sign is negative
where it was not seen; POINT:SCALE is negative for floats.
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
    first, last = unpack_from(f"{order}HH", content, 6)
    analog = unpack_from(f"{order}H", content, 4)[0]
    points = _one(path, parameters, "POINT:USED")
    rate_Hz, scale = _one(path, parameters, "POINT:RATE"), _one(path, parameters, "POINT:SCALE")
    begin = (round(_one(path, parameters, "POINT:DATA_START")) - 1) * BLOCK_bytes
    if not 0.0 < rate_Hz <= FASTEST_Hz or not math.isfinite(scale) or scale == 0.0 or points < 1:
        raise CaptureError(
            f"{path}: rate {rate_Hz:g} Hz, scale {scale:g}, {points:g} points: expected a recording of markers"
        )
    frames = _frames(parameters, first, last)
    table = _values(content, begin, frames, round(points), analog, kind, scale)
    seen = (table[:, :, 3] >= 0.0) & np.isfinite(table[:, :, :3]).all(axis=2)
    unit = _unit(path, parameters)
    factor = unit * (scale if scale > 0.0 else 1.0)
    places = np.where(seen[:, :, None], factor * table[:, :, :3], np.nan)
    names = _names(parameters, round(points))
    return Capture(
        path, np.arange(frames) / rate_Hz, {}, {name: places[:, k] for k, name in enumerate(names)}
    )


def _frames(parameters: dict[str, Value], first: int, last: int) -> int:
    """By the header's 16-bit numbers; longer recordings say it in POINT:FRAMES."""
    counted = last - first + 1
    stated = parameters.get("POINT:FRAMES")
    if isinstance(stated, np.ndarray) and stated.size and last >= 65535:
        counted = max(counted, round(float(stated.flat[0])))
    if not 0 < counted <= FRAMES_MOST:
        raise CaptureError(f"{counted} frames: expected 1 to {FRAMES_MOST}")
    return counted


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
    stated = parameters.get("POINT:LABELS", ())
    labels = [*(stated if isinstance(stated, tuple) else ())][:count]
    labels += [""] * (count - len(labels))
    full = [label or f"point{k + 1}" for k, label in enumerate(labels)]
    short = [name.rpartition(":")[2] for name in full]
    wanted = short if len(set(short)) == count else full
    return [name if wanted.index(name) == k else f"{name}_{k + 1}" for k, name in enumerate(wanted)]
