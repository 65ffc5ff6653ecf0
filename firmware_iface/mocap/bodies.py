"""What every motion capture system says: where rigid bodies are in its own frame, frame by frame. Plain floats.

Positions in m, orientations as unit quaternions w, x, y, z that turn the body's axes into those of the system's frame.
`Fields` reads a packet of any of them; one that is too short, or holds what it must not, is Malformed.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from struct import Struct
from typing import Protocol

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
UNIT_TOLERANCE = 1e-3  # of a quaternion in single precision, and of a rotation matrix's columns


@dataclass(frozen=True, slots=True)
class RigidPose:
    """A rigid motion: p -> turned(quaternion, p) + position_m."""

    position_m: Vector
    quaternion: Quaternion


NOWHERE = RigidPose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))  # of a body that is hidden


@dataclass(frozen=True, slots=True)
class SeenBody:
    """A body in one frame. error_m: the system's own mean residual of its markers, None where it says none."""

    name: str
    pose: RigidPose
    is_visible: bool = True
    error_m: float | None = None


@dataclass(frozen=True, slots=True)
class BodyFrame:
    """All bodies of one picture. time_s: of the system's own clock, None where it says none."""

    number: int
    bodies: tuple[SeenBody, ...]
    time_s: float | None = None


class BodyStream(Protocol):
    """An open stream. It never blocks; `rejected` counts packets that were not understood."""

    name: str
    rejected: int

    def receive(self) -> list[BodyFrame]:
        """All frames received so far, in order of arrival. LinkLost if the connection is gone."""

    def close(self) -> None:
        """End the stream."""


def product(a: Quaternion, b: Quaternion) -> Quaternion:
    """The turn `b`, then the turn `a`."""
    (aw, ax, ay, az), (bw, bx, by, bz) = a, b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def opposite(q: Quaternion) -> Quaternion:
    """The turn back."""
    return q[0], -q[1], -q[2], -q[3]


def turned(q: Quaternion, v: Vector) -> Vector:
    """A vector after a turn."""
    _, x, y, z = product(product(q, (0.0, *v)), opposite(q))
    return x, y, z


def unit(q: Sequence[float]) -> Quaternion | None:
    """The quaternion scaled to length 1; None if it is none within the tolerance."""
    length = math.hypot(*q)
    if not abs(length - 1.0) <= UNIT_TOLERANCE:  # NaN comes here, too
        return None
    w, x, y, z = (value / length for value in q)
    return w, x, y, z


def angle_rad(a: Quaternion, b: Quaternion) -> float:
    """The angle between two orientations, 0 to pi."""
    w, x, y, z = product(opposite(a), b)
    return 2.0 * math.atan2(math.hypot(x, y, z), abs(w))


def compose(outer: RigidPose, inner: RigidPose) -> RigidPose:
    """a_T_c from a_T_b and b_T_c."""
    x, y, z = turned(outer.quaternion, inner.position_m)
    a, b, c = outer.position_m
    return RigidPose((a + x, b + y, c + z), product(outer.quaternion, inner.quaternion))


def inverse(pose: RigidPose) -> RigidPose:
    """b_T_a from a_T_b."""
    back = opposite(pose.quaternion)
    x, y, z = turned(back, pose.position_m)
    return RigidPose((-x, -y, -z), back)


FASTEST_m, FASTEST_rad = 0.1, 0.5  # in one frame; of a tip at 10 m/s, or 50 rad/s, in 100 frames a second
CLOSEST_m = 0.02  # of two bodies whose exchange is recognised
NEAR = 0.5  # of the leap: where the other body was, or where the body itself had been
LONGEST_GAP_frames = 20


class LeapWatch:
    """Bodies that leap between two frames: markers that were mistaken, or two bodies that exchanged their names.

    A body that leapt is not believed until it leaps back, or until the system has lost and found it again, which
    names it anew. Frame numbers tell how far a body may have moved; after a long gap nothing can be said.
    """

    def __init__(self) -> None:
        self._last: dict[str, tuple[int, RigidPose]] = {}  # newest place of each visible body
        self._before: dict[str, RigidPose] = {}  # of bodies that leapt: where they had been
        self._why: dict[str, str] = {}

    def problem(self, name: str) -> str:
        """Why a body is not believed now; empty if it is."""
        return self._why.get(name, "")

    def look(self, frame: BodyFrame) -> None:
        """Compare a frame with the one before."""
        seen = {body.name: body.pose for body in frame.bodies if body.is_visible}
        for lost in self._last.keys() - seen.keys():
            self._forget(lost)
        leapt = {name for name, pose in seen.items() if self._has_leapt(name, pose, frame.number)}
        leapt |= self._exchanged(seen)
        for name in sorted(leapt):
            self._judge(name, seen, leapt, frame.number)
        for name, pose in seen.items():
            self._last[name] = (frame.number, pose)

    def _has_leapt(self, name: str, pose: RigidPose, number: int) -> bool:
        if name not in self._last:
            return False
        before, last = self._last[name]
        steps = (number - before) & 0xFFFFFFFF
        if not 0 < steps <= LONGEST_GAP_frames:
            return False
        way_m = math.dist(pose.position_m, last.position_m)
        turn_rad = angle_rad(pose.quaternion, last.quaternion)
        return way_m > steps * FASTEST_m or turn_rad > min(steps * FASTEST_rad, 3.0)

    def _exchanged(self, seen: dict[str, RigidPose]) -> set[str]:
        """Pairs of bodies that are now where the other one was, however small the leap."""
        exchanged: set[str] = set()
        known = [name for name in seen if name in self._last]
        for first, second in itertools.combinations(known, 2):
            here_m, there_m = (self._last[name][1].position_m for name in (first, second))
            apart_m = math.dist(here_m, there_m)
            if apart_m > CLOSEST_m and all(
                math.dist(seen[name].position_m, place_m) < NEAR * apart_m
                and math.dist(seen[name].position_m, own_m) > NEAR * apart_m
                for name, own_m, place_m in ((first, here_m, there_m), (second, there_m, here_m))
            ):
                exchanged |= {first, second}
        return exchanged

    def _judge(self, name: str, seen: dict[str, RigidPose], leapt: set[str], number: int) -> None:
        """Whether a leap led away or back, and whom the body was mistaken for."""
        pose, last = seen[name], self._last[name][1]
        way_m = math.dist(pose.position_m, last.position_m)
        if name in self._before and _is_near(pose, self._before[name], way_m):
            self._why.pop(name, None)
            del self._before[name]
            return
        twin = next(
            (
                candidate
                for candidate in sorted(leapt)
                if candidate != name and math.dist(pose.position_m, self._last[candidate][1].position_m) < NEAR * way_m
            ),
            "",
        )
        what = f"and {twin} exchanged their names" if twin else f"leapt by {1e3 * way_m:.0f} mm"
        self._before.setdefault(name, last)
        self._why[name] = f"body {name} {what} at frame {number}: cover it for a moment so that it is found anew"

    def _forget(self, name: str) -> None:
        for known in (self._last, self._before, self._why):
            known.pop(name, None)


def _is_near(pose: RigidPose, before: RigidPose, way_m: float) -> bool:
    is_turned_back = angle_rad(pose.quaternion, before.quaternion) < FASTEST_rad
    return math.dist(pose.position_m, before.position_m) < max(NEAR * way_m, FASTEST_m) and is_turned_back


FRAMES = 500  # whose mean it is, some seconds
MOVED_m, MOVED = (
    0.01,
    0.02,
)  # from the mean; of a quaternion's components, some 2 degrees: it was moved, and the mean begins anew


class SteadyPose:
    """Mean of the newest poses of a body that stands still: a milliradian of its noise is half a millimetre at half a metre."""

    def __init__(self) -> None:
        self._count, self._mean = 0, RigidPose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))

    def after(self, pose: RigidPose) -> RigidPose:
        """The mean, with one pose more."""
        place, q = pose.position_m, pose.quaternion
        if sum(a * b for a, b in zip(q, self._mean.quaternion, strict=True)) < 0.0:
            w, x, y, z = q
            q = (-w, -x, -y, -z)
        has_moved = math.dist(place, self._mean.position_m) > MOVED_m or math.dist(q, self._mean.quaternion) > MOVED
        self._count = 1 if has_moved else min(self._count + 1, FRAMES)
        share = 1.0 / self._count
        x, y, z = (m + share * (v - m) for m, v in zip(self._mean.position_m, place, strict=True))
        turned = [m + share * (v - m) for m, v in zip(self._mean.quaternion, q, strict=True)]
        length = math.hypot(*turned)
        a, b, c, d = (value / length for value in turned)
        self._mean = RigidPose((x, y, z), (a, b, c, d))
        return self._mean


LONGEST_NAME = 256
MOST_ITEMS = 10_000  # of a kind in one packet; more is not a count
FARTHEST_m = 1000.0  # a larger coordinate is no capture volume


class Malformed(Exception):
    """The packet is not one of the format. Never leaves the module that unpacks."""


_COUNT = Struct("<i")


class Fields:
    """A cursor over bytes, little endian."""

    def __init__(self, content: bytes, at: int = 0) -> None:
        self._content, self.at = content, at

    @property
    def left(self) -> int:
        """Bytes that are not read yet."""
        return len(self._content) - self.at

    def read(self, layout: Struct, is_finite: bool = True) -> tuple[float, ...]:
        """The fields of a layout; all numbers are finite, unless told otherwise."""
        if layout.size > self.left:
            raise Malformed
        values = layout.unpack_from(self._content, self.at)
        self.at += layout.size
        if is_finite and not all(map(math.isfinite, values)):
            raise Malformed
        return values

    def skip(self, size: int) -> None:
        """Pass over bytes."""
        if not 0 <= size <= self.left:
            raise Malformed
        self.at += size

    def count(self) -> int:
        """A number of items, 32 bits."""
        (count,) = self.read(_COUNT)
        if not 0 <= count <= MOST_ITEMS:
            raise Malformed
        return int(count)

    def text(self, size: int) -> str:
        """Text in a field of this size, padded with zeros."""
        begin = self.at
        self.skip(size)
        return _decoded(self._content[begin : self.at].split(b"\0", 1)[0])

    def name(self) -> str:
        """Text that ends with a zero byte."""
        end = self._content.find(b"\0", self.at, self.at + LONGEST_NAME)
        if end < 0:
            raise Malformed
        begin, self.at = self.at, end + 1
        return _decoded(self._content[begin:end])


def _decoded(text: bytes) -> str:
    try:
        return text.decode()
    except UnicodeDecodeError:
        raise Malformed from None
