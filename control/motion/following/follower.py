"""What the planner needs of a way to follow the tip's path with the joints."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

from control.kinematics.inverse import Branch
from control.motion.samples import JointSamples, TipSamples
from control.motion.spline import CartesianSpline, TimedWaypoints

Pose = tuple[float, ...]
LEAST_SAMPLES = 12  # of a section, however short
SEED_STEP_M = 0.02  # between poses that are solved one after the other


@dataclass(frozen=True, slots=True)
class PathStart:
    """A pose in which the path can begin, and its branch where those have names."""

    q_rad: Pose
    branch: Branch | None = None


@dataclass(frozen=True, slots=True)
class Followed:
    """Tip and joints all along the path, and the poses at the way-points."""

    tip: TipSamples
    joints: JointSamples
    at_waypoints: tuple[Pose, ...]


class Follower(Protocol):
    """Follows one set of way-points with one arm; errors are PathError and name the way-point."""

    def starts(self, q_near: Sequence[float]) -> Iterator[PathStart]:
        """Poses at the first way-point, nearest first."""
        ...

    def check(self, start: PathStart) -> None:
        """PathError if a way-point cannot be reached from this start."""
        ...

    def follow(
        self, recipe: TimedWaypoints, spline: CartesianSpline, start: PathStart, rate_Hz: float
    ) -> Followed:
        """Sample the path at a rate, or at LEAST_SAMPLES a section."""
        ...
