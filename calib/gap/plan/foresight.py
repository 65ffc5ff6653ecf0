"""What a plan would make nameable, before anything moves: the workflow on poses as they would be recorded, nothing hidden."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from calib.arm_problem.assembly import ORIENTATION_NOISE_rad
from calib.arrays import Array
from calib.gap.effects.catalogue import RECORDS
from calib.gap.finding import Nameable
from calib.gap.plan.plan import AVERAGE_s, PlannedVisit, RecordingPlan
from calib.gap.poses.find import find
from calib.points.points import Points, make_points
from control.dynamics.static_pose import ASSUMED_FRICTION, gravity_Nm, torque_per_A
from control.errors import MissingModel
from control.kinematics.kinematics import ForwardKinematics, PoseKinematics
from control.kinematics.rotation import exponentials, quaternions
from control.model.arm import Arm

CAMERA_Hz = 100.0
NOISE_m = 0.0003  # where the arm's file says nothing about its camera
SEEN_BY = {
    "ramps": "Coulomb, viscous and asymmetric friction",
    "slow ramps": "Stribeck friction and cogging",
    "swing": "inertias and torque constants",
    "fast": "viscous friction and supply sag",
    "shake": "compliance and command delay",
    "wide": "load friction and masses",
}


def foreseen(arm: Arm, plan: RecordingPlan) -> tuple[Nameable, ...]:
    """Every static effect with how well the planned poses would show it; empty without poses."""
    visits = plan.visits
    if not visits:
        return ()
    return find(arm, as_recorded(arm, visits, plan.duration_s)).finding.nameable


def as_recorded(arm: Arm, visits: tuple[PlannedVisit, ...], duration_s: float) -> Points:
    """The visits' points.csv of an arm that is as its file says: camera noise of an average, friction by direction."""
    draw = np.random.default_rng(0)
    q = np.array([visit.q_rad for visit in visits])
    direction = np.array([visit.direction for visit in visits], dtype=np.float64)
    payload = np.array([visit.payload_kg for visit in visits])
    noise = arm.camera.position_noise_m if arm.camera and arm.camera.position_noise_m > 0.0 else NOISE_m
    tips = ForwardKinematics(arm).tips(q) + draw.normal(0.0, noise / np.sqrt(AVERAGE_s * CAMERA_Hz), (len(q), 3))
    try:
        per_A = torque_per_A(arm)
        limits_A = np.array([arm.drive(j + 1).current_limit_A for j in range(arm.joint_count)])
        friction_A = ASSUMED_FRICTION * np.where(np.isfinite(limits_A), limits_A, 0.0)
        current = gravity_Nm(arm, q, payload) / per_A + friction_A * direction
    except MissingModel:
        current = np.full(q.shape, np.nan)
    return make_points(
        [visit.setup for visit in visits],
        [visit.point for visit in visits],
        [visit.repeat for visit in visits],
        q,
        tips,
        direction,
        current,
        np.linspace(0.0, duration_s, len(q)),
        payload,
        orientation=_orientations(arm, q, draw),
    )


def _orientations(arm: Arm, q: Array, draw: np.random.Generator) -> Array | None:
    """Quaternions (m, 4) of the last frame, as averages of the camera have them; None if it sends positions only."""
    camera = arm.camera
    if camera is None or not camera.measures_orientation:
        return None
    noise = (camera.orientation_noise_rad or ORIENTATION_NOISE_rad) / np.sqrt(AVERAGE_s * CAMERA_Hz)
    turned = exponentials(draw.normal(0.0, noise, (len(q), 3)))
    return quaternions(turned @ PoseKinematics(ForwardKinematics(arm)).batch(q).rotation)


def of_boards(arm: Arm) -> tuple[str, ...]:
    """What the motions cannot show because of the boards, and what can be done about it; nothing where boards are told volts."""
    without = [drive for drive in arm.drives if drive.pid.mode != "voltage"]
    if not without:
        return ()
    which = "every joint" if len(without) == len(arm.drives) else f"joint {', '.join(str(d.joint) for d in without)}"
    hidden = ", ".join(
        name.replace("_", " ")
        for name, record in RECORDS.items()
        if record.series is not None and record.series.needs == "electrical"
    )
    able = [drive for drive in without if "voltage" in arm.kind_of(drive).modes]
    remedy = 'mode = "voltage" in [drive.pid] would show them' if len(able) == len(without) else "measure these by hand"
    return (f"The board of {which} sets the motor's voltage itself, so no motion can name {hidden}: {remedy}.",)


def in_short(arm: Arm, plan: RecordingPlan) -> str:
    """One sentence about how much there is to record."""
    loads = sorted({step.payload_kg for step in plan.steps if step.payload_kg})
    loaded = f", some of them with {loads[0]:g} kg at the tip" if loads else ""
    return (
        f"Arm {arm.name}: {len(plan.visits)} poses and {len(plan.runs)} motions{loaded}: about {plan.duration_s / 60.0:.1f}"
        " minutes. All are inside the joints' ranges and limits, and clear of floor and board."
    )


def in_words(arm: Arm, plan: RecordingPlan, payload_kg: float) -> tuple[str, ...]:
    """The plan for an operator: what is recorded, its duration, what it could name, and what not and why."""
    sentences = [in_short(arm, plan)]
    ranges = ", ".join(
        f"q{j + 1} {math.degrees(a):.0f} to {math.degrees(b):.0f}"
        for j, (a, b) in enumerate(zip(plan.room.lower_rad, plan.room.upper_rad, strict=True))
    )
    sentences.append(f"Collision-free box: {ranges} deg; a few poses outside it are reached from its middle.")
    could = foreseen(arm, plan)
    if could:
        yes = [str(entry.name) for entry in could if entry.is_nameable]
        sentences.append(f"Of usual size, the poses could name: {', '.join(yes) or 'nothing'}.")
        sentences += _unnamed([entry for entry in could if not entry.is_nameable], payload_kg)
    kinds = dict.fromkeys(run.kind for run in plan.runs)
    if kinds:
        sentences += of_boards(arm)
        sentences.append("The motions show " + "; ".join(f"{SEEN_BY[kind]} ({kind})" for kind in kinds) + ".")
        if not payload_kg:
            sentences.append("Without --payload, load-dependent friction, torque constants and masses are hard to distinguish.")
    return tuple(sentences)


def _unnamed(entries: Sequence[Nameable], payload_kg: float) -> Iterator[str]:
    """What cannot be named, by reason."""
    weak = [entry for entry in entries if not entry.confusable_with]
    if weak:
        effects = {entry.name.effect for entry in weak}
        more = " --minutes helps thermal_drift." if "thermal_drift" in effects else ""
        if "joint_compliance" in effects and not payload_kg:
            more += " --payload helps joint_compliance."
        seen = ", ".join(f"{entry.name} ({entry.detectability:.1f})" for entry in weak)
        yield f"They could not name what is too small beside the noise (in standard deviations): {seen}.{more}"
    alike = [f"{entry.name} ({', '.join(map(str, entry.confusable_with))})" for entry in entries if entry.confusable_with]
    if alike:
        yield f"They could not name what looks like another effect (in brackets): {'; '.join(alike)}."
