"""What a motion capture system recorded: bodies over time, from a .csv that Vicon exported or from a .c3d.

In: a file. Out: `Capture`, tracks of bodies or markers in one frame [m, s]; CaptureError names file and place.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from struct import error, unpack_from

import numpy as np
import numpy.typing as npt

from calib.arm_problem.observations import mean_rotation
from calib.arrays import Array
from calib.errors import CalibrationError
from control.files import read_bytes
from control.kinematics.rotation import exponentials, matrices
from control.model.end_effector import CameraStream
from control.tables import SAMPLES_MOST, opened_rows

Mask = npt.NDArray[np.bool_]
IN_LINE = 0.1  # sine of the angle between two edges
FRAMES_MOST = 2_000_000  # 2.7 hours at 200 Hz


class CaptureError(CalibrationError):
    """A recording is not of its format, or cannot be brought to the arm's time; the message says what to do."""


@dataclass(frozen=True, slots=True)
class BodyTrack:
    """Position (m, 3) [m] and rotation (m, 3, 3) of a body in the system's frame, NaN where it was not seen.

    rotation None: a single marker, which has none.
    """

    position_m: Array
    rotation: Array | None = None

    @property
    def is_seen(self) -> Mask:
        """(m,), whether it was seen."""
        return np.asarray(np.isfinite(self.position_m).all(axis=1))


@dataclass(frozen=True, slots=True)
class Capture:
    """A recording of frames at t_s (m,), of the system's own clock from its first frame; `notes`: what was odd about the file."""

    path: Path
    t_s: Array
    bodies: Mapping[str, BodyTrack]
    markers: Mapping[str, Array]
    notes: tuple[str, ...] = ()

    def body(self, name: str) -> BodyTrack:
        """A body by its name, or one of markers: `A` alone, or `A+B+C` of three or more. CaptureError lists the names."""
        if name in self.bodies:
            return self.bodies[name]
        parts = [part.strip() for part in name.split("+")]
        if all(part in self.markers for part in parts) and len(parts) != 2:
            places = np.stack([self.markers[part] for part in parts])
            return BodyTrack(places[0]) if len(parts) == 1 else fitted_body(name, places)
        there = ", ".join([*self.bodies, *self.markers]) or "none"
        raise CaptureError(f'{self.path}: no body "{name}": expected one of {there}, or three or more markers joined by "+"')


def fitted_body(name: str, places_m: Array) -> BodyTrack:
    """The body of markers (k, m, 3), the same in every recording: origin at their centre, x from the first towards the second
    marker, z normal to the first three.

    Its shape is the mean of all frames that show every marker; a frame with fewer than three of them does not show it.
    CaptureError if the first three are in line, or all are never seen together.
    """
    seen = np.asarray(np.isfinite(places_m).all(axis=2))
    whole = np.flatnonzero(seen.all(axis=0))
    if not len(whole):
        raise CaptureError(f'body "{name}": no frame shows all of its markers')
    shape = _shape(name, places_m[:, whole])
    position = np.full((places_m.shape[1], 3), np.nan)
    rotation = np.full((places_m.shape[1], 3, 3), np.nan)
    for count in range(3, len(shape) + 1):
        for mask in {tuple(row) for row in seen[:, seen.sum(axis=0) == count].T.tolist()}:
            rows = np.flatnonzero((seen == np.array(mask)[:, None]).all(axis=0))
            here = np.flatnonzero(mask)
            rotation[rows], position[rows] = _motions(shape[here], places_m[np.ix_(here, rows)])
    return BodyTrack(position, rotation)


def _shape(name: str, places_m: Array) -> Array:
    """Markers (k, 3) in the body's frame, from frames (k, m, 3) that show all."""
    first = places_m[:, 0] - places_m[:, 0].mean(axis=0)
    turns, origins = _motions(first, places_m)
    mean = np.einsum("rji,krj->kri", turns, places_m - origins).mean(axis=1)
    mean -= mean.mean(axis=0)
    x, across = mean[1] - mean[0], mean[2] - mean[0]
    z = np.cross(x, across)
    if np.linalg.norm(z) < IN_LINE * np.linalg.norm(x) * np.linalg.norm(across):
        raise CaptureError(f'body "{name}": its first three markers lie on one line: no orientation follows from them')
    x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
    return np.asarray(mean @ np.column_stack((x, np.cross(z, x), z)))


def _motions(shape: Array, places: Array) -> tuple[Array, Array]:
    """Rotations (r, 3, 3) and origins (r, 3) that take a shape (k, 3) to places (k, r, 3): Kabsch."""
    middle, centre = shape.mean(axis=0), places.mean(axis=0)
    covariance = np.einsum("ki,krj->rij", shape - middle, places - centre)
    u, _, vt = np.linalg.svd(covariance)
    sign = np.linalg.det(u @ vt)
    vt[:, 2] *= sign[:, None]
    rotation = np.swapaxes(u @ vt, 1, 2)
    return rotation, centre - rotation @ middle


def placed_m(stream: CameraStream, seen_m: Array) -> Array:
    """Places (..., 3) in the frame of a stream that a calibration has placed, in the arm's base frame."""
    if stream.origin_m is None:
        raise CaptureError("[camera.stream] has no origin_m: calibrate first")
    (turn,) = matrices(np.array([stream.orientation]))
    return np.asarray(seen_m @ turn.T + np.array(stream.origin_m))


def relative(body: BodyTrack, base: BodyTrack) -> BodyTrack:
    """The body in the frame of another one: both seen; the base's pose is that of all frames, since it stands still."""
    if base.rotation is None:
        raise CaptureError("a base body needs an orientation: three or more markers")
    rows = base.is_seen & np.asarray(np.isfinite(base.rotation).all(axis=(1, 2)))
    if not rows.any():
        raise CaptureError("the base body is in no frame")
    origin = np.median(base.position_m[rows], axis=0)
    far = np.linalg.norm(base.position_m[rows] - origin, axis=1)
    if float(np.quantile(far, 0.95)) > 5e-3:
        raise CaptureError(
            f"the base body moves by {1e3 * float(np.quantile(far, 0.95)):.0f} mm: expected one that stands with the arm"
        )
    turn = mean_rotation(base.rotation[rows])
    origin = base.position_m[rows].mean(axis=0)
    return BodyTrack((body.position_m - origin) @ turn, None if body.rotation is None else turn.T @ body.rotation)


# Vicon's CSV export (Tracker, Nexus): sections of a title, the rate, names, columns, units, and frames.
#
#     Objects | Segments      Frame, Sub Frame, then for each RX RY RZ [RW] TX TY TZ
#     Trajectories            Frame, Sub Frame, then for each X Y Z
#
# RX RY RZ is a rotation vector in deg or rad, or with RW a quaternion; lengths in mm or m: the units' line says so.
# Names stand over the first column of each. Empty, or all zero: not seen.


OF_BODIES, OF_MARKERS = ("Objects", "Segments"), ("Trajectories",)
LAYOUTS = {("RX", "RY", "RZ", "TX", "TY", "TZ"): 3, ("RX", "RY", "RZ", "RW", "TX", "TY", "TZ"): 4, ("X", "Y", "Z"): 0}
CSV_UNITS = {"mm": 1e-3, "m": 1.0, "deg": math.pi / 180.0, "rad": 1.0, "": 1.0}
FASTEST_Hz = 10_000.0
Line = tuple[int, list[str]]


def read_vicon_csv(path: Path) -> Capture:
    """The bodies and markers of a file. CaptureError names file and line."""
    bodies: dict[str, BodyTrack] = {}
    markers: dict[str, Array] = {}
    clock: list[tuple[float, Array]] = []
    with opened_rows(path, CaptureError, SAMPLES_MOST) as rows:
        lines = ((number, [cell.strip() for cell in row]) for number, row in enumerate(rows, 1))
        for number, row in lines:
            title = row[0] if row else ""
            if title in (*OF_BODIES, *OF_MARKERS):
                rate_Hz, frames, tracks = _section(path, number, lines)
                clock.append((rate_Hz, frames))
                (bodies if title in OF_BODIES else markers).update(tracks)  # type: ignore[arg-type]
    if not clock:
        raise CaptureError(f"{path}: no section Objects, Segments or Trajectories: expected a CSV as Tracker or Nexus exports it")
    rate_Hz, frames = clock[0]
    if any(rate != rate_Hz or not np.array_equal(other, frames) for rate, other in clock[1:]):
        raise CaptureError(f"{path}: its sections have other rates or frames: export them together")
    return Capture(path, (frames - frames[0]) / rate_Hz, bodies, markers)


def _section(path: Path, number: int, lines: Iterator[Line]) -> tuple[float, Array, dict[str, BodyTrack | Array]]:
    """Rate, frame numbers, and what is in a section; `number` is the line of its title."""
    head = [next(lines, (number + k, list[str]())) for k in range(1, 5)]
    rate_Hz = _number(path, head[0][0], head[0][1][0] if head[0][1] else "")
    if not 0.0 < rate_Hz <= FASTEST_Hz:
        raise CaptureError(f"{path}, line {head[0][0]}: got a rate of {rate_Hz:g} Hz, expected up to {FASTEST_Hz:g}")
    (_, names), (at, columns), (_, units) = head[1:]
    if [column.lower() for column in columns[:2]] != ["frame", "sub frame"]:
        raise CaptureError(f"{path}, line {at}: expected the columns Frame, Sub Frame, ..., got {', '.join(columns[:3])}")
    groups = _groups(path, at, names, columns)
    rows, last = list[list[float]](), -math.inf
    for line, row in lines:
        if not any(row):
            break
        values = [_number(path, line, text) for text in row[: len(columns)]]
        values += [math.nan] * (len(columns) - len(values))
        if not values[0] > last:
            raise CaptureError(f"{path}, line {line}: got frame {row[0]}, expected one after {last:g}")
        last = values[0]
        rows.append(values)
        if len(rows) > FRAMES_MOST:
            raise CaptureError(f"{path}: more than {FRAMES_MOST} frames: cut the recording")
    if not rows:
        raise CaptureError(f"{path}, line {at}: a section without frames")
    factors = np.array([_factor(path, at + 1, unit) for unit in [*units, *[""] * len(columns)][: len(columns)]])
    table = np.array(rows) * factors
    return rate_Hz, np.array(rows)[:, 0], {name: _track(table[:, a:b], turn) for name, a, b, turn in groups}


def _groups(path: Path, line: int, names: list[str], columns: list[str]) -> list[tuple[str, int, int, int]]:
    """Name, first and last column, and numbers of the rotation, of each body or marker."""
    starts = [k for k, name in enumerate(names) if name and k >= 2]
    groups = []
    for start, end in zip(starts, [*starts[1:], len(columns)], strict=True):
        layout = tuple(column.upper() for column in columns[start:end] if column)
        if layout not in LAYOUTS:
            raise CaptureError(
                f"{path}, line {line}: {names[start]} has the columns {', '.join(layout) or 'none'}, expected RX RY RZ [RW] TX"
                " TY TZ, or X Y Z"
            )
        name = names[start].removeprefix("Global Angle ").split(":", 1)
        called = name[1] if len(name) > 1 and name[0] == name[1] else names[start]
        groups.append((called, start, start + len(layout), LAYOUTS[layout]))
    return groups


def _track(values: Array, turn: int) -> BodyTrack | Array:
    values = np.where((values == 0.0).all(axis=1)[:, None], np.nan, values)
    seen = np.asarray(np.isfinite(values).all(axis=1))
    place = np.where(seen[:, None], values[:, turn:], np.nan)
    if not turn:
        return place
    rotation = np.full((len(values), 3, 3), np.nan)
    if turn == 3:
        rotation[seen] = exponentials(values[seen, :3])
    else:
        quaternion = values[seen][:, [3, 0, 1, 2]]
        rotation[seen] = matrices(quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True))
    return BodyTrack(place, rotation)


def _number(path: Path, line: int, text: str) -> float:
    """A number; NaN for an empty cell."""
    if not text:
        return math.nan
    try:
        value = float(text)
    except ValueError:
        value = math.inf
    if math.isinf(value):
        raise CaptureError(f'{path}, line {line}: got "{text}", expected a number')
    return value


def _factor(path: Path, line: int, unit: str) -> float:
    if unit not in CSV_UNITS:
        raise CaptureError(f'{path}, line {line}: got the unit "{unit}", expected one of mm, m, deg, rad')
    return CSV_UNITS[unit]


# C3D files (www.c3d.org): the markers of the 3D section; Intel, DEC and SGI/MIPS processors, whole numbers or floats.
#
# Blocks of 512 bytes. Byte 0 of the first: block of the parameters, byte 1: 0x50. Parameters: byte 3 of their block is the
# processor (84 Intel, 85 DEC, 86 MIPS); then records: length of the name i8, group i8 (negative: a group), name, offset to the
# next i16; of a parameter: type i8, dimensions u8 and their sizes u8, data. A point is x, y, z and a fourth word whose sign is
# negative where it was not seen; POINT:SCALE is negative for floats.
#
# Most values stand twice: in words of the header (from 1, 16 bits each: 2 points, 3 analog values a frame, 4 and 5 first and last
# frame, 7-8 scale, 9 block of the data, 11-12 rate), which are too narrow for long recordings, and in parameters, which may be 0.


BLOCK_bytes = 512
KEY = 0x50
INTEL, DEC, MIPS = 84, 85, 86
UNITS = {"mm": 1e-3, "m": 1.0, "cm": 1e-2}
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
        raise CaptureError(f"{path}: rate {rate_Hz:g} Hz, scale {scale:g}, {points:g} points: expected a recording of markers")
    code = f"{order}i2" if scale > 0.0 else f"{order}u4" if kind == DEC else f"{order}f4"
    width = 4 * round(points) + analog
    held = max(0, len(content) - begin) // (width * np.dtype(code).itemsize)
    frames, notes = _frames(path, parameters, words[3:5], held)
    if begin < 0 or frames > held:
        raise ValueError(f"{frames} frames of {points:g} points do not fit into it")
    raw = np.frombuffer(content, code, frames * width, begin).reshape(frames, width)[:, : 4 * round(points)]
    values = _of_dec(raw.astype(np.uint32)) if code == "<u4" else raw.astype(np.float64)
    table = values.reshape(frames, round(points), 4)
    seen = (table[:, :, 3] >= 0.0) & np.isfinite(table[:, :, :3]).all(axis=2)
    unit = _unit(path, parameters)
    factor = unit * (scale if scale > 0.0 else 1.0)
    places = np.where(seen[:, :, None], factor * table[:, :, :3], np.nan)
    names = _names(parameters, round(points))
    tracks = {name: places[:, k] for k, name in enumerate(names)}
    return Capture(path, np.arange(frames) / rate_Hz, {}, tracks, notes)


def _frames(path: Path, parameters: dict[str, Value], header: tuple[int, ...], held: int) -> tuple[int, tuple[str, ...]]:
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
        notes.append(f"{path}: {frames} frames are stated, and there is room for {held}: the rest was not read")
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


def _of_dec(words: npt.NDArray[np.uint32]) -> Array:
    """Floats of a VAX (F): the halves of each word are exchanged, and the exponent is two more than IEEE's."""
    swapped = ((words >> np.uint32(16)) | (words << np.uint32(16))).astype(np.uint32)
    return np.asarray(swapped.view(np.float32).astype(np.float64) / 4.0)


def _parameters(content: bytes, start: int, kind: int) -> Iterator[tuple[str, Value]]:
    """GROUP:NAME and value of each parameter; groups may come after their parameters."""
    groups, unnamed = dict[int, str](), list[tuple[int, str, Value]]()
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
            unnamed.append((group, name, _value(content, name_end + 2, kind)))
        if step <= 0:
            break
        at = name_end + step
    for group, name, value in unnamed:
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
        return tuple(text[k : k + width].decode("latin-1").strip().strip("\0") for k in range(0, len(text), max(1, width)))
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
