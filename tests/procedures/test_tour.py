"""A tour: where the arm goes and when, what is kept, what is passed over, and how it ends."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.errors import SessionError
from calib.points.points import read_points
from calib.points.writer import PointsWriter
from calib.session.take import SessionSettings
from control.errors import ArmError
from control.hardware.measurement import Average, MeanPose
from procedures.tour import Bench, How, Stop, tour

HOW = How(SessionSettings())
A, B, OUT, MIDDLE = (0.1, -0.9, 0.2), (0.2, -0.8, 0.1), (0.5, 0.4, 0.3), (0.0, 0.0, 0.0)


@dataclass
class Runtime:
    """Writes down what it is asked; the camera sees the tip unless the arm stands where it is `hidden`."""

    hidden: tuple[float, ...] | None = None
    trembles: bool = False
    asked: list[Any] = field(default_factory=list)
    q_rad: tuple[float, ...] = MIDDLE
    t_s: float = 0.0

    def move_joints(self, q_rad: Any, speed: float = 1.0, as_encoders: bool = False) -> None:
        self.q_rad = tuple(q_rad)
        self.asked.append(self.q_rad)

    def wait(self, duration_s: float) -> None:
        self.t_s += duration_s
        self.asked.append(("wait", round(duration_s, 3)))

    def average(self, duration_s: float) -> Average:
        self.t_s += duration_s
        q_rad = tuple(q + (1e-3 * (round(50 * self.t_s) % 2) if self.trembles else 0.0) for q in self.q_rad)
        seen = None if self.q_rad == self.hidden else (0.51, 0.02, 0.1)
        target = None if seen is None else MeanPose(9, seen, (1e-4,) * 3, None)
        return Average(duration_s, 9, q_rad, (1e-5,) * 3, (0.3,) * 3, (1, -1, 1), 9, seen, None, (), self.t_s, target)

    def status(self) -> dict[str, Any]:
        return {"t_s": self.t_s, "temperature_C": (31.0, None, 29.0), "camera_problem": "the marker is hidden"}


def stop(name: str, q_rad: tuple[float, ...], **others: Any) -> Stop[None]:
    return Stop(name, q_rad, key=("free", name, 1), **others)


def toured(path: Path, runtime: Runtime, stops: list[Stop[None]], how: How = HOW, **others: Any) -> list[str]:
    with PointsWriter(path, 3) as points:
        bench = Bench(runtime, **others)  # type: ignore[arg-type]
        return [one.name for one in tour(bench, how, stops, points)]


def test_poses_are_measured_and_kept_and_the_same_tour_goes_on_with_what_is_left(tmp_path: Path) -> None:
    path, runtime = tmp_path / "points.csv", Runtime()
    toured(path, runtime, [stop("a", A)])
    assert toured(path, again := Runtime(), [stop("a", A), stop("b", B)]) == ["a", "b"]
    assert (runtime.asked, again.asked) == ([A], [B])
    points, _ = read_points(path, 3)
    np.testing.assert_allclose(points.tip_m, [(0.51, 0.02, 0.1)] * 2)
    np.testing.assert_allclose(points.q_rad, [A, B], atol=1e-9)
    assert points.extra["temperature1_C"] == ("31.0", "31.0")


def test_a_load_is_hung_once_inside_the_workspace_and_taken_off_at_the_end(tmp_path: Path) -> None:
    runtime = Runtime()
    stops = [stop("a", OUT, out_rad=MIDDLE), stop("b", OUT, out_rad=MIDDLE)]
    stops += [stop("c", A, payload_kg=0.4), stop("d", B, payload_kg=0.4)]
    toured(tmp_path / "points.csv", runtime, stops, hang=runtime.asked.append)
    assert runtime.asked == [MIDDLE, OUT, OUT, MIDDLE, 0.4, A, B, 0.0]
    with pytest.raises(ArmError, match="nobody can hang loads"):
        toured(tmp_path / "other.csv", Runtime(), [stop("a", A, payload_kg=0.4)])


def test_a_stop_waits_until_it_is_due(tmp_path: Path) -> None:
    runtime = Runtime()
    toured(tmp_path / "points.csv", runtime, [stop("a", A, due_s=0.0), stop("b", B, due_s=5.0)])
    assert runtime.asked[0] == A
    assert runtime.asked[1][0] == "wait"
    assert 4.0 < runtime.asked[1][1] < 5.0


def test_a_pose_whose_tip_is_hidden_ends_the_tour_or_is_kept_without_one(tmp_path: Path) -> None:
    stops = [stop("a", A), stop("b", B)]
    with pytest.raises(ArmError, match=r"no tip from the camera within 1 s \(the marker is hidden\)"):
        toured(tmp_path / "a.csv", Runtime(hidden=B), stops)
    assert read_points(tmp_path / "a.csv", 3)[0].point == ("a",)
    toured(tmp_path / "b.csv", Runtime(hidden=B), stops, How(SessionSettings(), needs_tip=False))
    assert np.isnan(read_points(tmp_path / "b.csv", 3)[0].tip_m).any(axis=1).tolist() == [False, True]


def test_an_arm_that_never_rests_ends_the_tour_and_nothing_is_kept(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match="does not come to rest"):
        toured(tmp_path / "points.csv", Runtime(trembles=True), [stop("a", A)])
    with PointsWriter(tmp_path / "points.csv", 3) as points:
        assert not points.recorded
