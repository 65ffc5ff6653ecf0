"""An arm that stands still before a mock camera."""

from typing import NamedTuple

from hil_mocks.devices.cameras import Point, TipPose


class Standing(NamedTuple):
    """Its tip, and the axes of its last link."""

    place_m: Point
    axes: tuple[Point, Point, Point]

    def tip_m(self) -> Point:
        return self.place_m

    def tip_pose(self) -> TipPose:
        return self.place_m, self.axes
