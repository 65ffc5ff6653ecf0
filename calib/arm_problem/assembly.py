"""Builds the identification problem from an arm and its points: the reference of each pose, and the unknowns."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from calib.arm_problem.arm_model import ArmModel, Bounds
from calib.arm_problem.joint_effects import FOLLOW_LOADS, corrections, effect_key, known_corrections, resting_points, with_effects
from calib.arm_problem.link_bending import FLEXURE, known_bending
from calib.arm_problem.observations import Correction, Frame, Observations, cross_matrix, rotation_of
from calib.arm_problem.posed import TARGET
from calib.arm_problem.problem import TOOL_NAMES, ArmProblem, ModelValues
from calib.arrays import Array, frozen
from calib.boards import best_motion
from calib.errors import CalibrationError, UnusablePointsError
from calib.points.points import Points, matrices_of
from control.kinematics.rotation import matrices
from control.model.arm import Arm, Effect
from control.model.table import SETUPS, board_cavities, board_origin, board_rotation, table_of

# Starting values for unknown tools and boards: closed forms at the nominal geometry.
#
# A tip in the same socket in many postures determines the tool (pivot calibration): base_p_flange + base_R_flange t
# is the same point for all of them, which is linear in the tool t and the socket.

ROUNDS, SETTLED_m = 30, 1e-6  # of tool and frames together
WEAK = 1e-2  # share of the best determined direction of the tool below which the nominal value is kept


def started_tool(model: ArmModel, observed: Observations) -> Array:
    """The tool (3,) for which poses in one socket, or with a known reference, agree best; nominal if they do not
    determine it. Where every place in a frame of unknown pose was measured once, tool and frame are started together.
    """
    slopes = model.slopes(model.nominal_dh, observed.q_rad)
    groups = _groups([*zip(observed.frame.tolist(), map(tuple, observed.position_m.tolist()), strict=True)])
    known = np.array([frame.is_placed for frame in observed.frames])[observed.frame]
    rows, wanted = [], []
    for group in groups:
        turns, tips = slopes.by_tool[group], slopes.tips[group]
        if known[group[0]]:
            references = observed.frames[observed.frame[group[0]]].to_base(observed.position_m[group])
            rows.append(turns)
            wanted.append(references - tips)
        else:
            rows.append(turns - turns.mean(axis=0))
            wanted.append(tips.mean(axis=0) - tips)
    step, *_ = np.linalg.lstsq(np.concatenate(rows).reshape(-1, 3), np.concatenate(wanted).ravel(), rcond=WEAK)
    unplaced = [group for group in groups if not known[group[0]]]
    if unplaced and all(len(group) == 1 for group in unplaced):
        step = _with_frames(slopes.tips, slopes.by_tool, observed)
    return np.asarray(model.nominal_tool_m + step)


def _with_frames(tips: Array, by_tool: Array, observed: Observations) -> Array:
    """The move of the tool (3,) for which tips (m, 3) fit their references, every unplaced frame where it then fits best.

    Gauss-Newton on the tool alone: what small motions of the frames do to the residuals is taken out of its columns.
    """
    step = np.zeros(3)
    for _ in range(ROUNDS):
        moved = tips + by_tool @ step
        residual_m, columns = np.empty_like(tips), by_tool.copy()
        for k, frame in enumerate(observed.frames):
            rows = observed.rows_of(k)
            if not len(rows):
                continue
            place = frame if frame.is_placed else _placed(frame, observed.position_m[rows], moved[rows])
            references = place.to_base(observed.position_m[rows])
            residual_m[rows] = references - moved[rows]
            if not frame.is_placed:
                arms = references - references.mean(axis=0)
                turns = np.array([-cross_matrix(arm) for arm in arms])
                motions = np.concatenate((np.broadcast_to(np.eye(3), turns.shape), turns), axis=2).reshape(-1, 6)
                flat = columns[rows].reshape(-1, 3)
                columns[rows] = (flat - motions @ np.linalg.lstsq(motions, flat)[0]).reshape(-1, 3, 3)
        move, *_ = np.linalg.lstsq(columns.reshape(-1, 3), residual_m.ravel(), rcond=WEAK)
        step = step + move
        if float(np.abs(move).max()) < SETTLED_m:
            break
    return step


def _placed(frame: Frame, positions_m: Array, tips_m: Array) -> Frame:
    """The frame where its positions fit these tips best."""
    motion = best_motion(positions_m, tips_m)
    return dataclasses.replace(frame, rotation=frozen(motion.rotation), origin_m=frozen(motion.shift_m), is_placed=True)


def with_started_frames(model: ArmModel, observed: Observations, tool_m: Array) -> Observations:
    """The observations with unknown frames placed where the nominal arm predicts them."""
    tips = model.tips(model.nominal_dh, observed.q_rad, tool_m)
    frames = list(observed.frames)
    for k, frame in enumerate(frames):
        rows = observed.rows_of(k)
        if not frame.is_placed and len(rows):
            frames[k] = _placed(frame, observed.position_m[rows], tips[rows])
    return dataclasses.replace(observed, frames=tuple(frames))


def _groups(keys: Sequence[Hashable]) -> list[list[int]]:
    """Rows with the same key."""
    rows_by_key: dict[Hashable, list[int]] = {}
    for row, key in enumerate(keys):
        rows_by_key.setdefault(key, []).append(row)
    return list(rows_by_key.values())


BASE = "base"
# Where neither the arm's [camera] nor an option says: a tracker's, and what its target of some 100 mm makes of it.
POSITION_NOISE_m = 0.00014
ORIENTATION_NOISE_rad = 0.002
NEARBY = 1e-3  # of a bound: a few micrometres, some tens of microradians, where loads are straight
CAMERA = "camera"
FREEABLE = (BASE, CAMERA, "table", "tool")
BASE_FRAME = ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")  # the effect's parameters: move, rotation vector


@dataclass(frozen=True, slots=True)
class Choice:
    """What is identified besides the DH parameters: `freed` of base, table, tool; `fixed` single parameters by name, or base.

    `boards` are measured board poses by setup, which override the arm's [table]. `effects`: static ones
    behind the encoders to identify too, such as "backlash:2"; `corrections`: any others. `orientation_noise_rad`: standard
    deviation of measured orientations about each axis, None: the arm's [camera], else ORIENTATION_NOISE_rad; "target" in `fixed`:
    the axes of the measured target are those of the last link.
    """

    bounds: Bounds = field(default_factory=Bounds)
    fixed: Collection[str] = ()
    freed: Collection[str] = ()
    boards: Mapping[str, Frame] = field(default_factory=dict)
    effects: tuple[str, ...] = ()
    corrections: tuple[Correction, ...] = ()
    orientation_noise_rad: float | None = None

    def for_points(self, arm: Arm, points: Points) -> Choice:
        """The same choice, with the base frame freed if the tips' frame has no known relation to the arm's base.

        That is so if the arm's file has neither a `base_frame` nor a table of known pose; "base" in `fixed` prevents it.
        Points of a camera free the camera's frame. A choice that is completed already stays as it is.
        """
        if points.in_camera_frame:
            return self if CAMERA in self.freed else replace(self, freed=(*self.freed, CAMERA))
        is_tied = _has_base_frame(arm) or _is_tied_by_table(arm)
        is_measured = bool(np.isfinite(points.tip_m).all(axis=1).any())
        is_asked_for = BASE in self.freed or BASE in self.fixed
        return replace(self, freed=(*self.freed, BASE)) if is_measured and not (is_tied or is_asked_for) else self

    def __post_init__(self) -> None:
        """CalibrationError for a name that cannot be freed."""
        wrong = sorted(set(self.freed) - set(FREEABLE))
        if wrong:
            raise CalibrationError(
                f'free: expected some of {", ".join(FREEABLE)}, got "{wrong[0]}"; single DH parameters are free'
                " unless they are fixed"
            )
        if CAMERA in self.freed and (BASE in self.freed or BASE in self.fixed):
            raise CalibrationError("tips in a camera's frame say nothing about the base frame: neither fix nor free base")
        if BASE in self.freed and BASE in self.fixed:
            raise CalibrationError("the base frame cannot be both fixed and free: omit one of the two")


def problem_of(arm: Arm, points: Points, choice: Choice | None = None, shaped: Arm | None = None) -> ArmProblem:
    """The identification problem of the points. UnusablePointsError for a pose without a reference.

    `shaped`: the arm at whose geometry and loads effects are evaluated, such as that of an identification before; else `arm`.
    """
    wanted = choice or Choice()
    model = ArmModel(arm)
    observed = observations_of(arm, points, wanted, shaped)
    is_tool_free = "tool" in wanted.freed or not arm.tool.known
    tool_m = started_tool(model, observed) if is_tool_free else model.nominal_tool_m
    return ArmProblem(
        model,
        with_started_frames(model, observed, tool_m),
        bounds=wanted.bounds,
        fixed=[name for name in wanted.fixed if name not in (BASE, TARGET)],
        is_tool_free=is_tool_free,
        tool_m=tool_m,
    )


def followed(arm: Arm, points: Points, problem: ArmProblem, at: ModelValues) -> dict[str, Array]:
    """How what soft gears and bent links do to the tips (m, 3) follows each parameter of an arm, per its own unit, by name.

    `arm` is that of the solution `at`. By finite differences: loads follow its geometry, and joints that give way to them. A
    loose gear has no such slope: it jumps. Empty where nothing follows loads.
    """
    steady = replace(arm, effects=tuple(effect for effect in arm.effects if effect.effect != "backlash"))
    if not any(e.effect in FOLLOW_LOADS for e in steady.effects) and not any(m.over == "load_Nm" for m in steady.maps):
        return {}
    here = resting_points(steady, points).joint_rad
    by_joint = problem.model.slopes(at.dh, here, at.tool_m).by_dh[:, :, list(problem.model.theta_places)]
    direct = {correction.name: correction for correction in problem.observed.corrections}

    def moved_m(there: Arm) -> Array:
        joint_rad = resting_points(there, points, here).joint_rad
        bent = known_bending(there, joint_rad, points.payload_kg)
        moved = np.einsum("mij,mj->mi", by_joint, joint_rad - here)
        return np.asarray(moved if bent is None else moved + bent.shift)

    before_m, slopes = moved_m(steady), {}
    for name, step, there in _nearby(steady, problem, at):
        slopes[name] = (moved_m(there) - before_m) / step
        if name in direct:
            slopes[name] -= np.einsum("mij,mj->mi", by_joint, direct[name].slope_rad)
            slopes[name] -= 0.0 if (slope_m := direct[name].slope_m) is None else slope_m
    return slopes


def _nearby(arm: Arm, problem: ArmProblem, at: ModelValues) -> Iterator[tuple[str, float, Arm]]:
    """Each parameter that shapes the arm, a step of it [own unit], and the arm with that step."""
    for k, parameter in enumerate(problem.everything):
        step = NEARBY * parameter.scale
        if k < at.dh.size:
            dh = np.array(at.dh)
            dh.flat[k] += step
            yield parameter.name, step, arm.with_dh(dh)
        elif parameter.name in TOOL_NAMES:
            x, y, z = (at.tool_m + step * np.eye(3)[TOOL_NAMES.index(parameter.name)]).tolist()
            yield parameter.name, step, replace(arm, tool=replace(arm.tool, position_m=(x, y, z)))
        elif parameter.name in at.corrections and not parameter.name.startswith("backlash"):
            there = with_effects(arm, {**at.corrections, parameter.name: at.corrections[parameter.name] + step})
            there = replace(there, effects=tuple(e for e in there.effects if e.effect != "backlash"))
            if there.effects != arm.effects:  # what cannot be is in no arm
                yield parameter.name, step, there


def observations_of(arm: Arm, points: Points, choice: Choice, shaped: Arm | None = None) -> Observations:
    """Each pose with its reference: the measured tip in the base frame, or the cavity in its board's frame.

    Joint angles are encoder angles corrected by the static effects that the arm already has.
    """
    frames = [_measuring_frame(arm, choice)]
    position, which = np.array(points.tip_m), np.zeros(len(points), dtype=np.intp)
    unmeasured = np.flatnonzero(np.isnan(points.tip_m).any(axis=1)).tolist()
    for setup in dict.fromkeys(points.setup[k] for k in unmeasured):
        rows = [k for k in unmeasured if points.setup[k] == setup]
        frame = _board(arm, setup, choice)
        which[rows] = 0 if frame is None else len(frames)
        cavities = _cavities(arm, setup, [points.point[k] for k in rows], rows)
        if frame is None:  # the board's pose is known, and the base frame is identified as a whole
            position[rows] = _known_frame(arm, setup, choice).to_base(cavities)
        else:
            position[rows] = cavities
            frames.append(frame)
    acting = shaped or arm
    made = corrections(acting, points, choice.effects)
    if shaped is not None:  # it shapes the slopes; what is nominal is the arm's own
        nominal = {one.name: one.nominal for one in corrections(arm, points, choice.effects)}
        made = tuple(replace(one, nominal=nominal.get(one.name, 0.0)) for one in made)
    keys = [effect_key(text, arm) for text in choice.effects]
    wanted = [link for effect, link in keys if effect == FLEXURE]
    joint_rad = resting_points(acting, points).joint_rad
    bent = known_bending(acting, joint_rad, points.payload_kg, wanted)
    return Observations(
        frozen(points.q_rad + known_corrections(acting, points, choice.effects)),
        frozen(position),
        which,
        tuple(frames),
        points.setup,
        points.point,
        (*made, *choice.corrections),
        None if bent is None else bent.shift,
        *_orientations(arm, points, choice),
        _covariances(arm, points, choice),
        None if bent is None else bent.turn,
    )


def _measuring_frame(arm: Arm, choice: Choice) -> Frame:
    """The frame of measured tips: a camera's of unknown place, or the base frame."""
    if CAMERA in choice.freed:
        return Frame.unplaced(CAMERA)
    base = base_frame_of(arm, BASE in choice.freed)
    return replace(base, is_placed=not base.is_free or _has_base_frame(arm) or _is_tied_by_table(arm))


def _orientations(arm: Arm, points: Points, choice: Choice) -> tuple[Array | None, float, bool]:
    """Measured rotations (m, 3, 3), the lever that makes their angles lengths, and whether the target's axes are known."""
    measured = np.isfinite(points.orientation).all(axis=1)
    if not measured.any():
        return None, 0.0, False
    rotation = np.full((len(points), 3, 3), np.nan)
    rotation[measured] = matrices(points.orientation[measured])
    return frozen(rotation), lever_m(arm, choice.orientation_noise_rad), TARGET in choice.fixed


def _covariances(arm: Arm, points: Points, choice: Choice) -> Array | None:
    """Covariances (m, 2, 3, 3) of position and orientation if a point has one; those without get the arm's noise."""
    if not np.isfinite(points.covariance).any():
        return None
    turn_rad = choice.orientation_noise_rad or turn_noise_rad(arm)
    usual = np.array([(lever_m(arm, turn_rad) * turn_rad) ** 2, turn_rad**2])[:, None, None] * np.eye(3)
    stated = matrices_of(points.covariance.reshape(-1, 2, 6))
    return frozen(np.where(np.isfinite(stated), stated, usual))


def lever_m(arm: Arm, noise_rad: float | None = None) -> float:
    """Position noise over orientation noise: as stated, else the arm's [camera], else usual values."""
    camera = arm.camera
    has_own = camera is not None and camera.position_noise_m > 0.0
    position = camera.position_noise_m if camera is not None and has_own else POSITION_NOISE_m
    return position / (turn_noise_rad(arm) if noise_rad is None else noise_rad)


def turn_noise_rad(arm: Arm) -> float:
    """Standard deviation of measured orientations about each axis: the arm's [camera], else a usual value."""
    own = arm.camera.orientation_noise_rad if arm.camera is not None else 0.0
    return own if own > 0.0 else ORIENTATION_NOISE_rad


def referenced(arm: Arm, points: Points, choice: Choice) -> Points:
    """The poses with a known tip: measured, or in a cavity of a board whose pose is given by `choice` or the arm's file."""
    table = arm.table
    cavities = board_cavities(table) if table is not None else {}
    setups = set(points.setup) if table is not None and not table.known_pose else {*choice.boards, *SETUPS}
    is_known = np.asarray(np.isfinite(points.tip_m).all(axis=1))
    for k in np.flatnonzero(~is_known):
        is_known[k] = points.point[k] in cavities and points.setup[k] in setups
    return points if is_known.all() else points.chosen(np.flatnonzero(is_known))


def base_frame_of(arm: Arm, is_free: bool = False) -> Frame:
    """The frame of camera and table in the arm's base frame: the arm's `base_frame` effect, if it has one."""
    for effect in arm.effects:
        if effect.effect == "base_frame":
            x, y, z, rx, ry, rz = (effect.parameters.get(name, 0.0) for name in BASE_FRAME)
            return Frame("base", frozen(rotation_of(np.array([rx, ry, rz]))), frozen([x, y, z]), is_free)
    return Frame.base(is_free)


def _board(arm: Arm, setup: str, choice: Choice) -> Frame | None:
    """The frame of a setup's board; None if it moves with the base frame."""
    if setup not in choice.boards and not table_of(arm).known_pose:
        return Frame.unplaced(f"board_{setup}")
    if "table" not in choice.freed and (BASE in choice.freed or _has_base_frame(arm)):
        return None
    known = _known_frame(arm, setup, choice)
    return Frame(known.name, known.rotation, known.origin_m, "table" in choice.freed)


def with_own_base(arm: Arm) -> Arm:
    """The arm whose file says that tips are measured in its base frame, unless it ties their frame to the base already."""
    if _has_base_frame(arm) or _is_tied_by_table(arm):
        return arm
    return replace(arm, effects=(*arm.effects, Effect("base_frame", None, dict.fromkeys(BASE_FRAME, 0.0))))


def without_base(arm: Arm) -> Arm:
    """The arm whose file does not say where the frame of tips and boards stands."""
    table = None if arm.table is None else replace(arm.table, known_pose=False)
    return replace(arm, table=table, effects=tuple(e for e in arm.effects if e.effect != "base_frame"))


def _has_base_frame(arm: Arm) -> bool:
    return any(effect.effect == "base_frame" for effect in arm.effects)


def _is_tied_by_table(arm: Arm) -> bool:
    """Whether a table of known pose relates the measurements to the arm's base."""
    return arm.table is not None and arm.table.known_pose


def _known_frame(arm: Arm, setup: str, choice: Choice) -> Frame:
    """The pose of a setup's board, measured or from the arm's file."""
    if setup in choice.boards:
        return choice.boards[setup]
    table = table_of(arm)
    if setup not in SETUPS:
        raise UnusablePointsError(
            f'setup "{setup}": its poses have no measured tip, and the board\'s pose is known only for'
            f" {', '.join(SETUPS)}; give x_m, y_m, z_m, markers of the board, or known_pose = false in [table]"
        )
    return Frame(f"table_{setup}", frozen(board_rotation(table, setup)), frozen(board_origin(table)))


def _cavities(arm: Arm, setup: str, names: list[str], rows: list[int]) -> Array:
    """Positions of cavities in the board's frame, (m, 3)."""
    known = board_cavities(table_of(arm))
    for name, row in zip(names, rows, strict=True):
        if name not in known:
            raise UnusablePointsError(
                f'point "{name}" of setup "{setup}" (pose {row + 1}) has no measured tip, and the table has no such'
                f" cavity; it has {_some(list(known))}"
            )
    return np.array([known[name] for name in names])


def _some(names: list[str]) -> str:
    return ", ".join(names) if len(names) <= 8 else f"{', '.join(names[:3])} ... {names[-1]}"
