"""One model's part of a verification: planned before anything moves, then visits of the points and runs of the paths."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.points.points import Points, joined, make_points
from calib.points.reading import read_points
from calib.points.writer import PointsWriter
from calib.validation.verify import Comparison, Track, TrackPair, compare_repeated
from control.server.client import ArmClient
from procedures.tour import Stop
from procedures.verify.driving import Run, planned, poses_at, require_clear, run, visit
from procedures.verify.models import Model
from procedures.verify.places import Place, Way
from procedures.verify.tracks import track_of

PATH_SPEED_m_s = 0.15


@dataclass(frozen=True, slots=True)
class Programme:
    """The places of a verification, and the visits of each."""

    places: tuple[Place, ...]
    ways: tuple[Way, ...]
    repeats: int = 1
    path_speed_m_s: float = PATH_SPEED_m_s


class Survey:
    """The arm moved by one model. ArmError if a place or a path is out of reach, or a move from one to the next meets
    something, before anything moves.
    """

    def __init__(self, model: Model, programme: Programme, q_near_rad: Sequence[float], file: Path) -> None:
        self.model = model
        self._programme = programme
        self._file = file
        self._poses = poses_at(programme.places, model, q_near_rad)
        angles = [pose.q_rad or () for pose in self._poses]
        near = angles[0] if angles else q_near_rad
        self._paths = [planned(way, model, programme.path_speed_m_s, near) for way in programme.ways]
        stays = [(q_rad, q_rad) for q_rad in angles]
        runs = [(path.q_start_rad, path.q_waypoints_rad[-1]) for path in self._paths]
        require_clear(model.arm, [*stays, *runs])
        self._runs: list[tuple[Way, Run]] = []

    @property
    def q_rad(self) -> np.ndarray:
        """The poses of the places, (m, n)."""
        return np.array([pose.q_rad for pose in self._poses])

    def tour(
        self, repeat: int, runtime_model: Model, client: ArmClient, speed: float
    ) -> Iterator[Stop[None]]:
        """Visit every place once."""
        as_encoders = not self.model.has_gears_of(runtime_model)
        with PointsWriter(self._file, self.model.arm.joint_count) as writer:
            yield from visit(self._poses, repeat, client, speed, writer, as_encoders)

    def run_ways(self, runtime_model: Model, client: ArmClient, speed: float) -> Iterator[Way]:
        """Run every path once; yields each run."""
        for way, path in zip(self._programme.ways, self._paths, strict=True):
            self._runs.append((way, run(path, self.model, runtime_model, client, speed)))
            yield way

    def points(self) -> Points:
        """The measurements at the places, from the file."""
        return read_points(self._file, self.model.arm.joint_count)[0]

    def tracks(self, recording: Path) -> list[Track]:
        """The measured tracks of the paths."""
        return [track_of(recording, self.model, ran, way.name) for way, ran in self._runs]


def compared(programme: Programme, before: Points, after: Points) -> Comparison:
    """Errors (measured minus target) at every place, by both models."""
    wanted = {(place.setup, place.point): place.tip_m for place in programme.places}
    found = [_by_key(points) for points in (before, after)]
    keys = [key for key in found[0] if key in found[1]]
    tips = np.array([wanted[setup, point] for setup, point, _ in keys])
    errors = [np.array([measured[key] for key in keys]) - tips for measured in found]
    return compare_repeated([key[0] for key in keys], [key[1] for key in keys], tips, *errors)


def _by_key(points: Points) -> dict[tuple[str, str, int], np.ndarray]:
    return {
        key: points.tip_m[row]
        for row, key in enumerate(zip(points.setup, points.point, points.repeat, strict=True))
    }


def paired(programme: Programme, before: Sequence[Track], after: Sequence[Track]) -> tuple[TrackPair, ...]:
    """The tracks by both models."""
    return tuple(
        TrackPair(way.name, way.setup, first, second)
        for way, first, second in zip(programme.ways, before, after, strict=True)
    )


def raw_points(programme: Programme, before: Points, after: Points) -> Points:
    """All measurements as one points.csv: columns `model` and `wanted_x_m` ... beyond those of the format."""
    both = joined([before, after])
    wanted = {(place.setup, place.point): place.tip_m for place in programme.places}
    tips = [wanted[name] for name in zip(both.setup, both.point, strict=True)]
    extra = {"model": ("nominal",) * len(before) + ("calibrated",) * len(after)} | {
        f"wanted_{axis}_m": tuple(f"{tip[k]:.9f}" for tip in tips) for k, axis in enumerate("xyz")
    }
    return make_points(
        both.setup,
        both.point,
        both.repeat,
        both.q_rad,
        both.tip_m,
        both.direction,
        both.current_A,
        both.t_s,
        both.payload_kg,
        extra,
    )
