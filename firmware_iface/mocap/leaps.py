"""Bodies that leap between two frames: markers that were mistaken, or two bodies that exchanged their names.

A body that leapt is not believed until it leaps back, or until the system has lost and found it again, which
names it anew. Frame numbers tell how far a body may have moved; after a long gap nothing can be said.
"""

from __future__ import annotations

import itertools
import math

from firmware_iface.mocap.bodies import BodyFrame, RigidPose, angle_rad

FASTEST_m, FASTEST_rad = 0.1, 0.5  # in one frame; of a tip at 10 m/s, or 50 rad/s, in 100 frames a second
CLOSEST_m = 0.02  # of two bodies whose exchange is recognised
NEAR = 0.5  # of the leap: where the other body was, or where the body itself had been
LONGEST_GAP_frames = 20


class LeapWatch:
    """Looks at every frame of a stream."""

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
        found: set[str] = set()
        known = [name for name in seen if name in self._last]
        for one, other in itertools.combinations(known, 2):
            here_m, there_m = (self._last[name][1].position_m for name in (one, other))
            apart_m = math.dist(here_m, there_m)
            if apart_m > CLOSEST_m and all(
                math.dist(seen[name].position_m, place_m) < NEAR * apart_m
                and math.dist(seen[name].position_m, own_m) > NEAR * apart_m
                for name, own_m, place_m in ((one, here_m, there_m), (other, there_m, here_m))
            ):
                found |= {one, other}
        return found

    def _judge(self, name: str, seen: dict[str, RigidPose], leapt: set[str], number: int) -> None:
        """Whether a leap led away or back, and whom the body was mistaken for."""
        pose, last = seen[name], self._last[name][1]
        way_m = math.dist(pose.position_m, last.position_m)
        if name in self._before and _is_near(pose, self._before[name], way_m):
            self._why.pop(name, None)
            del self._before[name]
            return
        other = next(
            (
                one
                for one in sorted(leapt)
                if one != name and math.dist(pose.position_m, self._last[one][1].position_m) < NEAR * way_m
            ),
            "",
        )
        what = f"and {other} exchanged their names" if other else f"leapt by {1e3 * way_m:.0f} mm"
        self._before.setdefault(name, last)
        self._why[name] = (
            f"body {name} {what} at frame {number}: cover it for a moment so that it is found anew"
        )

    def _forget(self, name: str) -> None:
        for known in (self._last, self._before, self._why):
            known.pop(name, None)


def _is_near(pose: RigidPose, before: RigidPose, way_m: float) -> bool:
    is_turned_back = angle_rad(pose.quaternion, before.quaternion) < FASTEST_rad
    return math.dist(pose.position_m, before.position_m) < max(NEAR * way_m, FASTEST_m) and is_turned_back
