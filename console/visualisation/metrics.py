"""Key figures of a recording: following errors, currents, saturation, tip, cycle timing."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from console.visualisation.series import Array, Series
from control.plain_text import aligned

NEAR_LIMIT: Final = 0.98  # of current limit or supply: saturated
FORMAT: Final = "plot/1"


@dataclass(frozen=True, slots=True)
class JointMetrics:
    """Figures of one joint; None if not recorded. Shares are of the samples that have the value."""

    joint: int
    following_rms_rad: float | None
    following_max_rad: float | None
    current_rms_A: float | None
    current_peak_A: float | None
    current_limit_A: float | None
    current_saturated_share: float | None
    voltage_peak_V: float | None
    voltage_saturated_share: float | None
    supply_min_V: float | None
    temperature_max_C: float | None


@dataclass(frozen=True, slots=True)
class Metrics:
    """Figures of the whole recording, or of the selected part."""

    joints: tuple[JointMetrics, ...]
    tip_rms_m: float | None
    tip_max_m: float | None
    camera_frames: int
    late_p99_s: float | None
    late_max_s: float | None
    busy_p99_s: float | None
    missed_cycles: int | None
    age_p50_s: float | None
    age_p99_s: float | None
    switches: int | None
    page_faults: int | None


def metrics_of(series: Series) -> Metrics:
    """All figures that the recording has."""
    error, tip_m = series.following_error_rad, tip_error_m(series)
    joints = tuple(_joint(series, error, joint) for joint in range(series.joint_count))
    missed = series.missed[np.isfinite(series.missed)]
    return Metrics(
        joints,
        _rms(tip_m),
        _peak(tip_m),
        int(np.isfinite(series.tip_m[:, 0]).sum()),
        _quantile(series.late_s, 0.99),
        _peak(series.late_s),
        _quantile(series.busy_s, 0.99),
        int(missed[-1] - missed[0]) if len(missed) else None,
        _quantile(series.age_s, 0.5),
        _quantile(series.age_s, 0.99),
        _total(series.switches),
        _total(series.page_faults),
    )


def _total(values: Array) -> int | None:
    return int(np.nansum(values)) if np.isfinite(values).any() else None


def _joint(series: Series, error_rad: Array, k: int) -> JointMetrics:
    drive = series.drive(k + 1)
    current, voltage, supply = series.current_A[:, k], series.voltage_V[:, k], series.supply_V[:, k]
    limit_A = drive.current_limit_A if drive else None
    supply_V: Array | float | None = None
    if np.isfinite(supply).any() and np.nanmax(supply) > 0.0:
        supply_V = supply
    elif drive:
        supply_V = drive.supply_V
    return JointMetrics(
        joint=k + 1,
        following_rms_rad=_rms(error_rad[:, k]),
        following_max_rad=_peak(error_rad[:, k]),
        current_rms_A=_rms(current),
        current_peak_A=_peak(current),
        current_limit_A=limit_A,
        current_saturated_share=_saturated(current, limit_A),
        voltage_peak_V=_peak(voltage),
        voltage_saturated_share=_saturated(voltage, supply_V),
        supply_min_V=_least(supply),
        temperature_max_C=_most(series.temperature_C[:, k]),
    )


def tip_error_m(series: Series) -> Array:
    """Distance (m,) between the camera's tip and the model's at the joint angles.

    NaN if either is unknown, or the arm is not homed.
    """
    from control.kinematics.kinematics import ForwardKinematics

    distance = np.full(len(series), np.nan)
    if series.arm is None:
        return distance
    is_known = np.isfinite(series.tip_m).all(axis=1) & np.isfinite(series.joint_rad).all(axis=1)
    rows = np.flatnonzero(is_known & series.is_placed)
    if len(rows):
        modelled = ForwardKinematics(series.arm).tips(series.joint_rad[rows])
        distance[rows] = np.linalg.norm(series.tip_m[rows] - modelled, axis=1)
    return distance


def _finite(values: Array) -> Array:
    return values[np.isfinite(values)]


def _rms(values: Array) -> float | None:
    valid = _finite(values)
    return math.sqrt(float(np.mean(valid**2))) if len(valid) else None


def _peak(values: Array) -> float | None:
    valid = _finite(values)
    return float(np.max(np.abs(valid))) if len(valid) else None


def _least(values: Array) -> float | None:
    valid = _finite(values)
    valid = valid[valid > 0.0]  # before the first answer of a board
    return float(np.min(valid)) if len(valid) else None


def _most(values: Array) -> float | None:
    valid = _finite(values)
    return float(np.max(valid)) if len(valid) else None


def _quantile(values: Array, share: float) -> float | None:
    valid = _finite(values)
    return float(np.quantile(valid, share)) if len(valid) else None


def _saturated(values: Array, limit: Array | float | None) -> float | None:
    """Share of the samples at the limit."""
    is_there = np.isfinite(values)
    if limit is None or not is_there.any():
        return None
    bound = NEAR_LIMIT * np.broadcast_to(np.asarray(limit), values.shape)
    is_at = is_there & (np.abs(values) >= bound) & (bound > 0.0)
    return float(is_at.sum() / is_there.sum())


def metrics_json(series: Series, merit: Metrics) -> dict[str, Any]:
    """Output of `armwright plot --json`; docs/visualisation.md describes the keys."""
    from dataclasses import asdict

    return {
        "format": FORMAT,
        "log": series.name,
        "arm": series.arm.name if series.arm else None,
        "cell": series.cell.name if series.cell else None,
        "samples": len(series),
        "duration_s": float(series.t_s[-1] - series.t_s[0]) if len(series) else 0.0,
        "period_s": None if math.isnan(series.period_s) else series.period_s,
        "runs": list(series.runs_present),
        **asdict(merit),
        "notes": list(series.notes),
    }


def metrics_text(series: Series, merit: Metrics) -> str:
    """The figures as text."""
    runs = series.runs_present
    span = f"{len(series)} samples, {series.t_s[-1] - series.t_s[0]:.2f} s, {len(runs)} runs"
    joints = merit.joints
    rows = [
        ("joint", [series.joint_name(joint.joint).removeprefix("joint ") for joint in joints]),
        ("following error, rms [mrad]", [_shown(j.following_rms_rad, 1e3, 3) for j in joints]),
        ("following error, largest [mrad]", [_shown(j.following_max_rad, 1e3, 3) for j in joints]),
        ("current, rms [A]", [_shown(j.current_rms_A, 1.0, 3) for j in joints]),
        ("current, peak [A]", [_shown(j.current_peak_A, 1.0, 3) for j in joints]),
        ("current limit [A]", [_shown(j.current_limit_A, 1.0, 2) for j in joints]),
        ("at the current limit [%]", [_shown(j.current_saturated_share, 1e2, 2) for j in joints]),
        ("voltage, peak [V]", [_shown(j.voltage_peak_V, 1.0, 2) for j in joints]),
        ("at the supply's voltage [%]", [_shown(j.voltage_saturated_share, 1e2, 2) for j in joints]),
        ("supply, least [V]", [_shown(j.supply_min_V, 1.0, 2) for j in joints]),
        ("temperature, highest [°C]", [_shown(j.temperature_max_C, 1.0, 1) for j in joints]),
    ]
    lines = [f"{series.name}: {span}", "", aligned((title, *cells) for title, cells in rows)]
    if merit.tip_rms_m is not None:
        lines.append(
            f"\ntip, camera minus model: {_shown(merit.tip_rms_m, 1e3, 3)} mm rms, {_shown(merit.tip_max_m, 1e3, 3)}"
            f" mm at most, {merit.camera_frames} frames"
        )
    if merit.late_p99_s is not None:
        lines.append(
            f"loop: p99 {_shown(merit.late_p99_s, 1e6, 0)} us late, at most {_shown(merit.late_max_s, 1e6, 0)} us;"
            f" busy p99 {_shown(merit.busy_p99_s, 1e6, 0)} us; {merit.missed_cycles} cycles missed"
            f"{_causes(merit)}"
        )
    return "\n".join(lines) + "\n"


def _shown(value: float | None, scale: float, decimals: int) -> str:
    return "-" if value is None else f"{scale * value:.{decimals}f}"


def _causes(merit: Metrics) -> str:
    """How old the counts were, and what took time from the loop; empty for recordings of earlier versions."""
    if merit.switches is None:
        return ""
    return (
        f"\n      counts {_shown(merit.age_p50_s, 1e6, 0)} us old, p99 {_shown(merit.age_p99_s, 1e6, 0)} us;"
        f" {merit.switches} involuntary switches, {merit.page_faults} page faults"
    )
