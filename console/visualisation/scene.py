"""The arm as a MuJoCo scene: the commanded pose as a solid arm, the measured one as a ghost, paths as lines. No physics runs.

The arms are those exported by `calib.export` (MJCF).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import mujoco
import numpy as np

from calib.export import export_text
from calib.export.rigid import end_names
from console.visualisation.series import Array
from console.visualisation.snapshots import TipsOf, Traces, tips_in
from control.model.arm import Arm
from control.model.cell import Cell
from control.model.table import cavities
from control.motion.joint_limits import reach_m

Colour = tuple[float, float, float, float]
COMMANDED: Final[Colour] = (0.835, 0.369, 0.0, 1.0)  # Okabe and Ito
GHOST: Final[Colour] = (0.337, 0.706, 0.914, 0.2)
MEASURED: Final[Colour] = (0.0, 0.447, 0.698, 0.45)
CAMERA: Final[Colour] = (0.0, 0.62, 0.451, 1.0)
BOARD: Final[Colour] = (0.78, 0.76, 0.72, 1.0)
CAVITY: Final[Colour] = (0.25, 0.25, 0.28, 1.0)
GHOST_THICKER: Final = 1.25
PREFIX: Final = "measured/"
LINE_m, MARK_m = 0.0016, 0.003  # radii of lines and marks
LINE_PIECES, MARKS_MOST = 250, 150
SIZE_pixels: Final = (960, 720)
AZIMUTH_deg, ELEVATION_deg, HEIGHT_deg = (125.0, -16.0, 45.0)  # of the camera; HEIGHT: MuJoCo's usual field of view
WITHIN: Final = 0.95  # of the picture holds what is to be seen: lines have a width


class Viewpoint(NamedTuple):
    """Where a camera looks, and from how far away [m]."""

    lookat_m: tuple[float, float, float]
    distance_m: float


def view_of(domes: Sequence[tuple[Sequence[float], float]]) -> Viewpoint:
    """The nearest view that holds all domes: the half balls (centre, radius) [m] in which arms reach."""
    polar, around = np.meshgrid(np.linspace(0.0, math.pi / 2.0, 13), np.linspace(0.0, 2.0 * math.pi, 49))
    dome = np.stack((np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)), axis=-1)
    return nearest_view(np.concatenate([np.array(centre) + radius * dome.reshape(-1, 3) for centre, radius in domes]))


def nearest_view(points: Array) -> Viewpoint:
    """The nearest view that holds all points (m, 3) [m]."""
    lookat = (points.min(axis=0) + points.max(axis=0)) / 2.0
    a, e = math.radians(AZIMUTH_deg), math.radians(ELEVATION_deg)
    ahead = np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
    right = np.array([math.sin(a), -math.cos(a), 0.0])
    up = np.cross(right, ahead)
    high = WITHIN * math.tan(math.radians(HEIGHT_deg) / 2.0)
    wide = high * SIZE_pixels[0] / SIZE_pixels[1]
    seen = points - lookat
    needed = np.maximum(np.abs(seen @ up) / high, np.abs(seen @ right) / wide) - seen @ ahead
    x, y, z = lookat.tolist()
    return Viewpoint((x, y, z), float(needed.max()))


class Scene:
    """A MuJoCo model of one arm or of several, each twice, and its state. Joints in the order of `joints`."""

    def __init__(self, spec: Any, joints: Sequence[tuple[str, Arm]], tips: TipsOf, view: Viewpoint) -> None:
        """`joints`: prefix of an arm's names, and the arm. `tips`: of all arms, by all joint angles."""
        self.tips, self._view = tips, view
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._tip_names = {prefix: end_names(arm)[1] for prefix, arm in joints}
        names = [(prefix, joint) for prefix, arm in joints for joint in _exported_names(arm)]
        self._commanded = [self._address(f"{prefix}{joint}") for prefix, joint in names]
        self._measured = [self._address(f"{prefix}{PREFIX}{joint}") for prefix, joint in names]
        self.pose([0.0] * len(names), [0.0] * len(names))

    def _address(self, joint: str) -> int:
        return int(self.model.joint(joint).qposadr[0])

    def pose(self, q_rad: Sequence[float], q_set_rad: Sequence[float]) -> None:
        """Set the ghost to the measured pose and the solid arm to the commanded one."""
        for address, angle in zip(self._measured, q_rad, strict=True):
            self.data.qpos[address] = angle
        for address, angle in zip(self._commanded, q_set_rad, strict=True):
            self.data.qpos[address] = angle
        mujoco.mj_forward(self.model, self.data)

    def tip_m(self, which: str = "") -> Array:
        """Position of a tip in the scene: "" for the commanded arm, "measured/" for the ghost."""
        return np.array(self.data.site(which + self._tip_names[which.removesuffix(PREFIX)]).xpos)

    def trace(self, scene: Any, traces: Traces) -> None:
        """Add lines and marks to the scene, as far as it has room."""
        scene.ngeom = 0
        self.add_traces(scene, traces)

    def add_traces(self, scene: Any, traces: Traces) -> None:
        """Add lines and marks after the scene's contents."""
        for points, colour, radius in ((traces.commanded_m, COMMANDED, LINE_m), (traces.measured_m, MEASURED, 1.7 * LINE_m)):
            for a, b in _pieces(points):
                _connect(scene, a, b, radius, colour)
        marks = traces.camera_m[np.isfinite(traces.camera_m).all(axis=1)]
        for point in marks[:: 1 + len(marks) // MARKS_MOST]:
            _mark(scene, point)

    def look_at_arms(self, traces: Traces) -> None:
        """Let the camera see the arms in their present pose and the traces, from as near as it can."""
        arms = self.model.geom_bodyid > 0
        at_m, radius_m = self.data.geom_xpos[arms], self.model.geom_rbound[arms, None]
        ways = np.concatenate((np.eye(3), -np.eye(3)))
        seen_m = [at_m + radius_m * way for way in ways]
        seen_m += [traces.commanded_m, traces.measured_m, traces.camera_m]
        points = np.concatenate(seen_m)
        self._view = nearest_view(points[np.isfinite(points).all(axis=1)])

    def camera(self) -> Any:
        """A camera view of everything, from the front, slightly from above."""
        camera = mujoco.MjvCamera()
        mujoco.mjv_defaultFreeCamera(self.model, camera)
        camera.lookat[:], camera.distance = self._view
        camera.azimuth, camera.elevation = AZIMUTH_deg, ELEVATION_deg
        return camera


class ArmScene(Scene):
    """One arm in its base frame."""

    def __init__(self, arm: Arm) -> None:
        view = view_of([((0.0, 0.0, 0.0), _reach_m(arm))])
        super().__init__(_spec(arm), [("", arm)], tips_in(arm), view)


class CellScene(Scene):
    """The arms of a cell in its frame; joint angles arm after arm."""

    def __init__(self, cell: Cell) -> None:
        x, y, z = np.mean([placed.origin_m for placed in cell.arms], axis=0).tolist()
        size = max(math.dist((x, y, z), placed.origin_m) + _reach_m(placed.arm) for placed in cell.arms)
        spec = mujoco.MjSpec()
        for placed in cell.arms:
            both = _twice(placed.arm)
            for model_spec in (spec, both):  # MuJoCo warns where options differ; no physics runs here
                model_spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
                model_spec.option.gravity = cell.arms[0].arm.gravity_m_s2
            frame = spec.worldbody.add_frame(pos=placed.origin_m, quat=placed.orientation)
            spec.attach(both, prefix=f"{placed.name}/", frame=frame)
        _furnish(spec, size, min(placed.origin_m[2] + _floor_m(placed.arm) for placed in cell.arms))
        joints = [(f"{placed.name}/", placed.arm) for placed in cell.arms]
        view = view_of([(placed.origin_m, _reach_m(placed.arm)) for placed in cell.arms])
        super().__init__(spec, joints, tips_in(cell), view)


def scene_of(shown: Arm | Cell) -> Scene:
    """Of an arm, or of the arms of a cell."""
    return CellScene(shown) if isinstance(shown, Cell) else ArmScene(shown)


def _exported_names(arm: Arm) -> list[str]:
    """What the joints are called in the exported model."""
    turning = [link for link in arm.links if link.joint == "revolute"]
    return [link.joint_name or f"joint{number}" for number, link in enumerate(turning, 1)]


def _reach_m(arm: Arm) -> float:
    """Approximate largest distance of the tip from the base."""
    return max(0.1, reach_m(arm))


def _spec(arm: Arm) -> Any:
    """The commanded arm, the ghost, the floor, the board, light."""
    spec = _twice(arm)
    _furnish(spec, _reach_m(arm), _floor_m(arm))
    _add_board(spec.worldbody, arm)
    return spec


def _floor_m(arm: Arm) -> float:
    """Height of the floor in the base frame."""
    return min(0.0, arm.limits.floor_z_m if math.isfinite(arm.limits.floor_z_m) else 0.0)


def _twice(arm: Arm) -> Any:
    """The commanded arm and the ghost."""
    spec = mujoco.MjSpec.from_string(export_text(arm, "mjcf"))
    _paint(spec, COMMANDED)
    ghost = mujoco.MjSpec.from_string(export_text(arm, "mjcf"))
    _paint(ghost, GHOST)
    for geom in ghost.geoms:  # larger than the solid one, or both would flicker
        geom.size[0] *= GHOST_THICKER
    spec.attach(ghost, prefix=PREFIX, frame=spec.worldbody.add_frame())
    return spec


def _furnish(spec: Any, reach: float, floor_m: float) -> None:
    """Floor, light and the size of pictures, for arms that reach so far [m]."""
    world = spec.worldbody
    sun = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    world.add_light(pos=[0.5 * reach, -reach, 3.0 * reach], dir=[0.0, 0.3, -1.0], type=sun)
    world.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[1.6 * reach, 1.6 * reach, 0.1],
        pos=[0.0, 0.0, floor_m - 0.011],
        material=_tiles(spec, reach),
        contype=0,
        conaffinity=0,
    )
    spec.visual.global_.offwidth, spec.visual.global_.offheight = SIZE_pixels
    spec.visual.headlight.ambient = [0.35, 0.35, 0.35]
    spec.visual.headlight.diffuse = [0.3, 0.3, 0.3]


def _tiles(spec: Any, reach_m: float) -> str:
    """A floor with tiles of 0.1 m, and a light sky."""
    kinds, patterns = mujoco.mjtTexture, mujoco.mjtBuiltin
    spec.add_texture(
        name="sky",
        type=kinds.mjTEXTURE_SKYBOX,
        builtin=patterns.mjBUILTIN_GRADIENT,
        rgb1=[0.97, 0.98, 0.99],
        rgb2=[0.80, 0.84, 0.88],
        width=256,
        height=1536,
    )
    spec.add_texture(
        name="tiles",
        type=kinds.mjTEXTURE_2D,
        builtin=patterns.mjBUILTIN_CHECKER,
        rgb1=[0.55, 0.58, 0.61],
        rgb2=[0.49, 0.52, 0.55],
        width=256,
        height=256,
    )
    floor = spec.add_material(name="floor", texrepeat=[16.0 * reach_m, 16.0 * reach_m])
    floor.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "tiles"
    return "floor"


def _paint(spec: Any, colour: Colour) -> None:
    for geom in spec.geoms:
        geom.rgba = list(colour)
    for site in spec.sites:
        site.rgba = list(colour)


def _add_board(world: Any, arm: Arm) -> None:
    """The calibration board's cavities on a plate, if the level board's pose is known."""
    if arm.table is None or not arm.table.known_pose or arm.table.origin_m is None:
        return
    points = np.array(list(cavities(arm.table).values()))
    if not len(points):
        return
    low, high = points.min(axis=0) - 0.02, points.max(axis=0) + 0.02
    half, (x, y, _) = 0.5 * (high - low), (0.5 * (low + high)).tolist()
    world.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[half[0], half[1], 0.005],
        pos=[x, y, points[:, 2].min() - 0.006],
        rgba=list(BOARD),
        contype=0,
        conaffinity=0,
    )
    for point in points:
        world.add_site(pos=point.tolist(), size=[0.003, 0.003, 0.003], rgba=list(CAVITY))


def _pieces(points: Array) -> list[tuple[Array, Array]]:
    """Segments of a line, thinned to the scene's capacity; gaps where a point is not finite."""
    points = points[:: 1 + len(points) // LINE_PIECES]
    pairs = itertools.pairwise(points)
    return [(a, b) for a, b in pairs if np.isfinite(a).all() and np.isfinite(b).all()]


def _connect(scene: Any, a: Array, b: Array, radius_m: float, colour: Colour) -> None:
    if scene.ngeom >= scene.maxgeom or np.array_equal(a, b):
        return
    geom = _new(scene, mujoco.mjtGeom.mjGEOM_CAPSULE, colour)
    mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_CAPSULE, radius_m, a, b)


def _mark(scene: Any, at_m: Array) -> None:
    if scene.ngeom < scene.maxgeom:
        geom = _new(scene, mujoco.mjtGeom.mjGEOM_SPHERE, CAMERA)
        geom.pos = at_m


def _new(scene: Any, kind: Any, colour: Colour) -> Any:
    geom = scene.geoms[scene.ngeom]
    size, rotation = np.full(3, MARK_m), np.eye(3).ravel()
    mujoco.mjv_initGeom(geom, kind, size, np.zeros(3), rotation, np.array(colour, dtype=np.float32))
    scene.ngeom += 1
    return geom
