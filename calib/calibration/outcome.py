"""Results of a calibration besides the report: the calibrated arm.toml and calibration.json."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

from calib.arm_problem.assembly import BASE_FRAME, CAMERA, base_frame_of
from calib.arm_problem.frames import Frame, rotation_vector
from calib.arm_problem.joint_effects import with_effects
from calib.identify.identification import Identification
from calib.points.points import STREAM_FRAME, Points
from calib.results import Provenance, entries, write_json
from calib.validation.verify import Comparison
from control.kinematics.rotation import quaternion_of
from control.model.arm import Arm, Effect
from control.model.description import save_arm

DECIMALS = 12  # of a metre or a radian, in calibration.json


def write_calibrated_arm(
    path: Path,
    nominal: Arm,
    found: Identification,
    made: Provenance,
    points: Points | None = None,
) -> Arm:
    """Save the arm with the identified parameters (`calibrated_arm`) as a new file, and return it.

    The nominal arm's file is not changed; an existing file at `path` is refused (ArmFileError).
    """
    calibration = made.of_arm(nominal, found.objective)
    calibrated = dataclasses.replace(calibrated_arm(nominal, found, points), calibration=calibration)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_arm(calibrated, path)
    return calibrated


def calibrated_arm(nominal: Arm, found: Identification, points: Points | None = None) -> Arm:
    """The arm with the identified DH table, tool, base frame and effects, and the place of the stream that gave its points."""
    x, y, z = found.solution.tool_m.tolist()
    tool = nominal.tool
    if any(estimate.parameter.name.startswith("tool_") for estimate in found.estimates):
        tool = dataclasses.replace(tool, position_m=(x, y, z), known=True)
    framed = with_base_frame(nominal.with_dh(found.dh), found.solution.frames[0])
    if points is not None and STREAM_FRAME in points.extra.get("frame", ()):
        framed = with_placed_stream(framed, found.solution.frames[0])
    return with_effects(dataclasses.replace(framed, tool=tool), found.solution.corrections)


def with_placed_stream(arm: Arm, frame: Frame) -> Arm:
    """The arm whose [camera.stream] says where its frame is, so that it measures tips as table and camera have them."""
    camera = arm.camera
    if camera is None or camera.stream is None:
        return arm
    base = base_frame_of(arm)
    x, y, z = (base.rotation.T @ (frame.origin_m - base.origin_m)).tolist()
    orientation = quaternion_of((base.rotation.T @ frame.rotation).tolist())
    stream = dataclasses.replace(camera.stream, origin_m=(x, y, z), orientation=orientation)
    return dataclasses.replace(arm, camera=dataclasses.replace(camera, stream=stream))


def with_base_frame(arm: Arm, base: Frame) -> Arm:
    """The arm with a base frame that was identified; unchanged if it was not, or if the frame is a camera's."""
    if not base.is_free or base.name == CAMERA:
        return arm
    vector = [*base.origin_m.tolist(), *rotation_vector(base.rotation).tolist()]
    effect = Effect("base_frame", None, dict(zip(BASE_FRAME, vector, strict=True)))
    others = (e for e in arm.effects if e.effect != "base_frame")
    return dataclasses.replace(arm, effects=(*others, effect))


def write_calibration_json(
    path: Path,
    arm: str,
    found: Identification,
    made: Provenance,
    verification: Comparison | None = None,
    more: Mapping[str, object] | None = None,
) -> None:
    """Write the result for other programs; `more` under its own keys: outliers, held-out errors, the verdict."""
    content = made.heading("calibration/1", arm=arm) | _found(found)
    content["verification"] = None
    if verification is not None:
        content["verification"] = {
            entry.setup: entries(entry, "before", "after", "improvement_percent")
            for entry in verification.by_setup()
        }
    write_json(path, content | dict(more or {}))


def _found(found: Identification) -> dict[str, object]:
    return {
        "objective": {
            "name": found.objective,
            "before": found.objective_before,
            "after": found.objective_after,
        },
        "points": len(found.error_after_m),
        "mean_error_m": {"before": found.mean_before_m, "after": found.mean_after_m},
        "noise_m": found.noise_m,
        "rank": found.rank,
        "condition_number": found.condition_number,
        "parameters": {
            one.parameter.name: entries(one.parameter, "unit", "nominal", "bound")
            | entries(one, "value", "deviation", "sd", "is_determined", "is_at_bound")
            for one in found.estimates
        },
        "tool_m": found.solution.tool_m.round(DECIMALS),
        "orientation": None
        if found.orientation is None
        else {
            "points": len(found.orientation.rows),
            "mean_error_rad": {
                "before": found.orientation.mean_before_rad,
                "after": found.orientation.mean_after_rad,
            },
            "target_rotation": found.orientation.target.round(DECIMALS),  # link_R_target
        },
        "frames": {
            frame.name: {
                "origin_m": frame.origin_m.round(DECIMALS),
                "rotation": frame.rotation.round(DECIMALS),  # base_T_frame
            }
            for frame in found.solution.frames
            if frame.is_free
        },
        "undetermined": [{"names": g.names, "freedoms": g.freedoms_count} for g in found.undetermined],
        "at_bound": found.binding,
        "in_words": found.in_words(),
    }
