"""Results of a calibration besides the report: the calibrated arm.toml and calibration.json."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path

from calib.arm_problem.assembly import BASE_FRAME, CAMERA, base_frame_of
from calib.arm_problem.frames import Frame, rotation_vector
from calib.arm_problem.joint_effects import with_effects
from calib.identify.identification import Estimate, Identification, OrientationFit
from calib.points.points import STREAM_FRAME, Points
from calib.validation.verify import Comparison, ErrorSummary
from control.files import write_whole
from control.kinematics.rotation import quaternion_of
from control.model.arm import Arm, Calibration, Effect
from control.model.description import save_arm

DECIMALS = 12  # of a metre or a radian, in calibration.json


def write_calibrated_arm(
    path: Path,
    nominal: Arm,
    found: Identification,
    inputs: Mapping[str, str],
    date: str,
    program_version: str,
    points: Points | None = None,
) -> Arm:
    """Save the arm with the identified parameters (`calibrated_arm`) as a new file, and return it.

    `inputs` maps files to their SHA-256. The nominal arm's file is not changed; an existing file at
    `path` is refused (ArmFileError).
    """
    source = str(nominal.path.name) if nominal.path is not None else nominal.name
    provenance = Calibration(source, dict(inputs), date, found.objective, program_version)
    calibrated = dataclasses.replace(calibrated_arm(nominal, found, points), calibration=provenance)
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
    inputs: Mapping[str, str],
    date: str,
    program_version: str,
    verification: Comparison | None = None,
    more: Mapping[str, object] | None = None,
) -> None:
    """Write the result for other programs. SI units; missing numbers are null.

    `more` is added under its own keys: outliers, held-out errors, the verdict.
    """
    content = {
        "format": "calibration/1",
        "arm": arm,
        "date": date,
        "program_version": program_version,
        "inputs": dict(inputs),
        **_found(found),
        "verification": None if verification is None else _verification(verification),
        **(more or {}),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


def _found(found: Identification) -> dict[str, object]:
    return {
        "objective": {
            "name": found.objective,
            "before": found.objective_before,
            "after": found.objective_after,
        },
        "points": len(found.error_after_m),
        "mean_error_m": {"before": found.mean_before_m, "after": found.mean_after_m},
        "noise_m": _number(found.noise_m),
        "rank": found.rank,
        "condition_number": _number(found.condition_number),
        "parameters": {estimate.parameter.name: _parameter(estimate) for estimate in found.estimates},
        "tool_m": _rounded(found.solution.tool_m.tolist()),
        "orientation": None if found.orientation is None else _orientation(found.orientation),
        "frames": {frame.name: _frame(frame) for frame in found.solution.frames if frame.is_free},
        "undetermined": [{"names": list(g.names), "freedoms": g.freedoms_count} for g in found.undetermined],
        "at_bound": list(found.binding),
        "in_words": list(found.in_words()),
    }


def _orientation(found: OrientationFit) -> dict[str, object]:
    """Errors of measured orientations, and the target's axes in the last link's frame (link_R_target)."""
    return {
        "points": len(found.rows),
        "mean_error_rad": {"before": found.mean_before_rad, "after": found.mean_after_rad},
        "target_rotation": [_rounded(row) for row in found.target.tolist()],
    }


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _rounded(values: list[float]) -> list[float]:
    return [round(value, DECIMALS) for value in values]


def _parameter(estimate: Estimate) -> dict[str, object]:
    return {
        "unit": estimate.parameter.unit,
        "nominal": estimate.parameter.nominal,
        "value": estimate.value,
        "deviation": estimate.deviation,
        "sd": _number(estimate.sd),
        "bound": _number(estimate.parameter.bound),
        "is_determined": estimate.is_determined,
        "is_at_bound": estimate.is_at_bound,
    }


def _frame(frame: Frame) -> dict[str, object]:
    """base_T_frame."""
    return {
        "origin_m": _rounded(frame.origin_m.tolist()),
        "rotation": [_rounded(row) for row in frame.rotation.tolist()],
    }


def _verification(comparison: Comparison) -> dict[str, object]:
    return {
        entry.setup: {
            "before": _summary(entry.before),
            "after": _summary(entry.after),
            "improvement_percent": entry.improvement_percent,
        }
        for entry in comparison.by_setup()
    }


def _summary(summary: ErrorSummary) -> dict[str, float | None]:
    return {key: _number(value) for key, value in dataclasses.asdict(summary).items()}
