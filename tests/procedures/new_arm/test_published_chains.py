"""Known arms have their tip where the published URDF has it: its joints' origins and axes, multiplied out here."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from calib.export import export_text
from control.kinematics.kinematics import ForwardKinematics
from control.kinematics.rotation import logarithms
from control.model.description import load_arm
from tests.calib.export.test_export_arm import poses, urdf_reader_tips

AXES = {"x": 0, "y": 1, "z": 2}
ROUNDED_m = 1e-6  # rows are written to 0.1 um and 1 nrad


@dataclass(frozen=True)
class Chain:
    """Of a URDF without turned frames: each joint's axis, its origin in the frame before, and the tip's in the last one."""

    axes: str
    origins_m: tuple[tuple[float, float, float], ...]

    def frames(self, q_rad: np.ndarray) -> np.ndarray:
        """The tip (n, 4, 4) in the base frame at poses (n, joints)."""
        frames = np.tile(np.eye(4), (len(q_rad), 1, 1))
        for origin_m, axis, angle in zip(self.origins_m, self.axes, q_rad.T, strict=False):
            frames = frames @ _moved(origin_m) @ _turned(AXES[axis], angle)
        return frames @ _moved(self.origins_m[-1])


def _moved(by_m: tuple[float, float, float]) -> np.ndarray:
    frame = np.eye(4)
    frame[:3, 3] = by_m
    return frame


def _turned(axis: int, angle: np.ndarray) -> np.ndarray:
    first, second = (axis + 1) % 3, (axis + 2) % 3
    frames = np.tile(np.eye(4), (len(angle), 1, 1))
    frames[:, first, first] = frames[:, second, second] = np.cos(angle)
    frames[:, second, first] = np.sin(angle)
    frames[:, first, second] = -np.sin(angle)
    return frames


CHAINS = {
    # open_manipulator_x_arm.urdf.xacro of ROBOTIS-GIT/open_manipulator at 3fd6fa94
    "openmanipulatorx": Chain(
        "zyyy", ((0.012, 0.0, 0.0), (0.0, 0.0, 0.0595), (0.024, 0.0, 0.128), (0.124, 0.0, 0.0), (0.126, 0.0, 0.0))
    ),
    # px100, rx150, rx200, vx300, vx300s, wx200, wx250 and wx250s.urdf.xacro of Interbotix/interbotix_ros_manipulators at
    # 0bb2b0e6; the fixed frames behind the last joint are added up
    "pincherx100": Chain(
        "zyyy", ((0.0, 0.0, 0.05085), (0.0, 0.0, 0.04225), (0.035, 0.0, 0.1), (0.1, 0.0, 0.0), (0.113575, 0.0, 0.0))
    ),
    "reactorx150": Chain(
        "zyyyx",
        ((0.0, 0.0, 0.06566), (0.0, 0.0, 0.03891), (0.05, 0.0, 0.15), (0.15, 0.0, 0.0), (0.065, 0.0, 0.0), (0.093575, 0.0, 0.0)),
    ),
    "reactorx200": Chain(
        "zyyyx",
        ((0.0, 0.0, 0.06566), (0.0, 0.0, 0.03891), (0.05, 0.0, 0.2), (0.2, 0.0, 0.0), (0.065, 0.0, 0.0), (0.093575, 0.0, 0.0)),
    ),
    "viperx300": Chain(
        "zyyyx",
        ((0.0, 0.0, 0.079), (0.0, 0.0, 0.04805), (0.05955, 0.0, 0.3), (0.3, 0.0, 0.0), (0.069744, 0.0, 0.0), (0.1072, 0.0, 0.0)),
    ),
    "viperx300s": Chain(
        "zyyxyx",
        (
            *((0.0, 0.0, 0.079), (0.0, 0.0, 0.04805), (0.05955, 0.0, 0.3)),
            *((0.2, 0.0, 0.0), (0.1, 0.0, 0.0), (0.069744, 0.0, 0.0), (0.1072, 0.0, 0.0)),
        ),
    ),
    "widowx200": Chain(
        "zyyyx",
        ((0.0, 0.0, 0.072), (0.0, 0.0, 0.03865), (0.05, 0.0, 0.2), (0.2, 0.0, 0.0), (0.065, 0.0, 0.0), (0.093575, 0.0, 0.0)),
    ),
    "widowx250": Chain(
        "zyyyx",
        ((0.0, 0.0, 0.072), (0.0, 0.0, 0.03865), (0.04975, 0.0, 0.25), (0.25, 0.0, 0.0), (0.065, 0.0, 0.0), (0.093575, 0.0, 0.0)),
    ),
    "widowx250s": Chain(
        "zyyxyx",
        (
            *((0.0, 0.0, 0.072), (0.0, 0.0, 0.03865), (0.04975, 0.0, 0.25)),
            *((0.175, 0.0, 0.0), (0.075, 0.0, 0.0), (0.065, 0.0, 0.0), (0.093575, 0.0, 0.0)),
        ),
    ),
}


@pytest.mark.parametrize("name", CHAINS)
def test_a_known_arm_and_its_exported_urdf_have_the_tip_of_the_published_one(name: str) -> None:
    arm = load_arm(name)
    q_rad = poses(arm, 12)
    published = CHAINS[name].frames(q_rad)
    frames = ForwardKinematics(arm).link_transforms(q_rad)[:, -1]
    np.testing.assert_allclose(frames[:, :3, 3], published[:, :3, 3], atol=ROUNDED_m, rtol=0.0)
    turned = logarithms(np.swapaxes(frames[:, :3, :3], 1, 2) @ published[:, :3, :3])
    assert np.abs(turned).max() < ROUNDED_m
    nameless = replace(arm, links=tuple(replace(link, joint_name="", link_name="") for link in arm.links))
    exported_m = urdf_reader_tips(export_text(nameless, "urdf"), q_rad)
    np.testing.assert_allclose(exported_m, published[:, :3, 3], atol=ROUNDED_m, rtol=0.0)
