"""The lens of a camera: pinhole with radial and tangential distortion, and its exact derivatives.

    (a, b) = (X, Y) / Z,   s = a^2 + b^2,   g = 1 + k1 s + k2 s^2 + k3 s^3
    a' = a g + 2 p1 a b + p2 (s + 2 a^2),   b' = b g + p1 (s + 2 b^2) + 2 p2 a b
    u = fx a' + cx,   v = fy b' + cy

(Brown, Photogrammetric Engineering 37 (1971) 855; the order k1, k2, p1, p2, k3 is OpenCV's.) The camera's frame: x to the right
of the picture, y down, z along the view. Pixel centres have whole coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from calib.arm_problem.observations import rotation_of
from calib.arrays import Array, frozen
from calib.vision.targets import SeenCorners, opencv
from control.kinematics.rotation import cross_matrices

NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")


@dataclass(frozen=True, slots=True)
class Lens:
    """Values (9,) in the order of NAMES, of pictures of width_px by height_px.

    covariance (9, 9), zero where a value is not estimated; noise_px: standard deviation of one coordinate of a found corner.
    readout_s: from the first to the last row of a picture (rolling shutter), 0: all rows at once.
    """

    values: Array
    width_px: int
    height_px: int
    covariance: Array = field(default_factory=lambda: frozen(np.zeros((len(NAMES), len(NAMES)))))
    noise_px: float = 0.0
    readout_s: float = 0.0

    @property
    def matrix(self) -> Array:
        """Camera matrix (3, 3)."""
        fx, fy, cx, cy = self.values[:4]
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    @property
    def distortion(self) -> Array:
        """Values k1, k2, p1, p2, k3."""
        return np.asarray(self.values[4:])

    @property
    def sd(self) -> Array:
        """Standard deviations (9,)."""
        return np.sqrt(np.diag(self.covariance))

    def project(self, points_m: Array) -> Array:
        """Pixels (k, 2) of points (k, 3) in the camera's frame."""
        return self.slopes(points_m)[0]

    def slopes(self, points_m: Array) -> tuple[Array, Array, Array]:
        """Pixels (k, 2), and their derivatives by the point (k, 2, 3) and by the values (k, 2, 9)."""
        fx, fy, cx, cy, k1, k2, p1, p2, k3 = self.values
        z = points_m[:, 2]
        a, b = points_m[:, 0] / z, points_m[:, 1] / z
        s = a * a + b * b
        g, by_s = 1.0 + s * (k1 + s * (k2 + s * k3)), k1 + s * (2.0 * k2 + 3.0 * s * k3)
        bent = np.array([a * g + 2 * p1 * a * b + p2 * (s + 2 * a * a), b * g + p1 * (s + 2 * b * b) + 2 * p2 * a * b])
        cross = 2 * a * b * by_s + 2 * p1 * a + 2 * p2 * b
        by_ray = np.array(
            [[g + 2 * a * a * by_s + 2 * p1 * b + 6 * p2 * a, cross], [cross, g + 2 * b * b * by_s + 6 * p1 * b + 2 * p2 * a]]
        )
        zero, one = np.zeros_like(a), np.ones_like(a)
        ray = np.array([[one, zero, -a], [zero, one, -b]]) / z
        focal = np.array([fx, fy])
        by_point = np.einsum("i,ijk,jlk->kil", focal, by_ray, ray)
        by_bend = np.array(
            [[a * s, a * s**2, 2 * a * b, s + 2 * a * a, a * s**3], [b * s, b * s**2, s + 2 * b * b, 2 * a * b, b * s**3]]
        )
        by_values = np.zeros((len(a), 2, len(NAMES)))
        by_values[:, 0, 0], by_values[:, 1, 1] = bent
        by_values[:, 0, 2] = by_values[:, 1, 3] = 1.0
        by_values[:, :, 4:] = np.einsum("i,ijk->kij", focal, by_bend)
        return (focal[:, None] * bent).T + np.array([cx, cy]), by_point, by_values


# Where a target stood before a camera: reprojection, and its least-squares solution for many pictures at once.
#
# A picture's pose (R, t) takes the target's points into the reference camera's frame. It is varied as exp([w]) R, t + s; its
# unknowns are (s, w). What pictures share, a lens or where cameras stand to each other, is solved with all poses at once: the
# normal equations are reduced to the shared unknowns (Schur complement; Triggs et al., Bundle Adjustment, 2000, section 6).


STEPS_MOST = 30
CONVERGED = 1e-8  # relative fall of the sum of squares
SAME_POSE_rad = 0.02  # two solutions nearer than this are one


@dataclass(frozen=True, slots=True)
class Pose:
    """camera_T_target: rotation (3, 3), position_m (3,)."""

    rotation: Array
    position_m: Array

    def of(self, points_m: Array) -> Array:
        """Points (k, 3) of the target in the camera's frame."""
        return np.asarray(points_m @ self.rotation.T + self.position_m)

    def moved(self, step: Array) -> Pose:
        """The pose after a step (6,): a shift, and a turn about the target's origin in the camera's axes."""
        return Pose(rotation_of(step[3:]) @ self.rotation, self.position_m + step[:3])

    def after(self, first: Pose) -> Pose:
        """This pose of that pose: the product self T first."""
        return Pose(self.rotation @ first.rotation, self.of(first.position_m[None])[0])

    @property
    def inverse(self) -> Pose:
        """target_T_camera."""
        return Pose(self.rotation.T, -self.rotation.T @ self.position_m)


HERE = Pose(np.eye(3), np.zeros(3))


@dataclass(frozen=True, slots=True)
class CameraView:
    """Corners that a camera saw; `stand`: camera_T_reference camera."""

    lens: Lens
    corners: SeenCorners
    stand: Pose = HERE


@dataclass(frozen=True, slots=True)
class Misfit:
    """Seen minus projected corners (2k,) [px], and its derivatives: projection by pose (2k, 6), lens (2k, 9), stand (2k, 6)."""

    error_px: Array
    by_pose: Array
    by_lens: Array
    by_stand: Array


def misfit(view: CameraView, pose: Pose) -> Misfit:
    """How a view differs from what a pose predicts."""
    turned = view.corners.target_m @ pose.rotation.T
    points = view.stand.of(turned + pose.position_m)
    pixels, by_point, by_lens = view.lens.slopes(points)
    by_here = by_point @ view.stand.rotation
    by_pose = np.concatenate((by_here, -by_here @ cross_matrices(turned)), axis=2)
    about = points - view.stand.position_m
    by_stand = np.concatenate((by_point, -by_point @ cross_matrices(about)), axis=2)
    rows = 2 * len(pixels)
    return Misfit(
        (view.corners.picture_px - pixels).ravel(), by_pose.reshape(rows, 6), by_lens.reshape(rows, -1), by_stand.reshape(rows, 6)
    )


def solved_pose(views: Sequence[CameraView], start: Pose) -> tuple[Pose, float]:
    """The pose with the least sum of squares [px^2] over views, near a start, and that sum."""
    pose, before = start, np.inf
    for _ in range(STEPS_MOST):
        parts = [misfit(view, pose) for view in views]
        error = np.concatenate([part.error_px for part in parts])
        total = float(error @ error)
        if before - total <= CONVERGED * total:
            break
        before = total
        jacobian = np.concatenate([part.by_pose for part in parts])
        pose = pose.moved(np.linalg.lstsq(jacobian, error, rcond=None)[0])
    return pose, _squares(views, pose)


def candidates(view: CameraView, is_flat: bool) -> list[Pose]:
    """Poses of one view in closed form, in the reference camera's frame: of a flat target two.

    (Collins and Bartoli, Infinitesimal Plane-Based Pose Estimation, 2014; Terzakis and Lourakis, SQPnP, 2020; both by OpenCV.)
    """
    cv2 = opencv()
    method = cv2.SOLVEPNP_IPPE if is_flat else cv2.SOLVEPNP_SQPNP
    points, lens = view.corners.target_m, view.lens
    origin, axes = (points.mean(axis=0), _plane(points)) if is_flat else (np.zeros(3), np.eye(3))
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(
            (points - origin) @ axes, view.corners.picture_px, lens.matrix, np.array(lens.distortion), flags=method
        )
    except cv2.error:
        return []
    found = [Pose(rotation_of(np.ravel(w)) @ axes.T, np.ravel(s)) for w, s in zip(turns, shifts, strict=True)]
    local = [Pose(one.rotation, one.position_m - one.rotation @ origin) for one in found]
    return [view.stand.inverse.after(one) for one in local if np.isfinite(one.position_m).all() and one.position_m[2] > 0.0]


def started_pose(view: CameraView, is_flat: bool) -> Pose | None:
    """The better of one view's poses in closed form; None if it fits none."""
    found = candidates(view, is_flat)
    return min(found, key=lambda pose: _squares([view], pose)) if found else None


def best_poses(views: Sequence[CameraView], is_flat: bool) -> list[tuple[Pose, float]]:
    """Different poses that are least squares of the views, with their sums of squares [px^2], the best first."""
    minima: list[tuple[Pose, float]] = []
    for start in (start for view in views for start in candidates(view, is_flat)):
        pose, total = solved_pose(views, start)
        if np.isfinite(total) and all(_angle(pose, other) > SAME_POSE_rad for other, _ in minima):
            minima.append((pose, total))
    return sorted(minima, key=lambda minimum: minimum[1])


def shared_step(
    errors: Sequence[Array], by_shared: Sequence[Array], by_pose: Sequence[Array]
) -> tuple[Array, list[Array], Array]:
    """Gauss-Newton's step of shared unknowns (p,) and of every pose (6,), and the reduced normal matrix (p, p)."""
    p = by_shared[0].shape[1]
    normal, pull, inner = np.zeros((p, p)), np.zeros(p), []
    for error, shared, lever in zip(errors, by_shared, by_pose, strict=True):
        gain = np.linalg.pinv(lever)
        projected = shared - lever @ (gain @ shared)
        normal += shared.T @ projected
        pull += projected.T @ error
        inner.append((gain @ error, gain @ shared))
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    step = scale * np.linalg.lstsq(normal * np.outer(scale, scale), scale * pull, rcond=1e-14)[0]
    return step, [own - mixed @ step for own, mixed in inner], normal


def _squares(views: Sequence[CameraView], pose: Pose) -> float:
    if any(pose.rotation[2] @ point + pose.position_m[2] <= 0.0 for view in views for point in view.corners.target_m[:1]):
        return float("inf")
    return float(sum(np.sum(misfit(view, pose).error_px ** 2) for view in views))


def _angle(first: Pose, second: Pose) -> float:
    """Between two orientations."""
    cosine = 0.5 * (np.trace(first.rotation @ second.rotation.T) - 1.0)
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _plane(points: Array) -> Array:
    """Axes (3, 3), in columns, of the plane of points (k, 3); the third is its normal."""
    axes = np.linalg.svd(points - points.mean(axis=0))[2].T
    return np.asarray(axes * np.array([1.0, 1.0, np.linalg.det(axes)]))
