"""The whole bring-up: pulses on every motor board, then joint by joint; the journal lists the joints that passed."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from control.dynamics.dynamics import Dynamics
from control.errors import MissingModel
from control.model.arm import Arm, Drive
from procedures.bringup.diagnosis import diagnose
from procedures.bringup.driving import JointDriver
from procedures.bringup.findings import Diagnosis
from procedures.bringup.journal import Journal
from procedures.bringup.measuring import measure
from procedures.bringup.operator import BringupOperator
from procedures.bringup.survey import Caution, pulse
from procedures.bringup.wiring import MeasuredWiring, WiringFound, wiring_of
from procedures.bringup.workbench import SafetyTrip, Workbench, named

SURVEY_SPEED_rad_s = 0.3
PASS_SPEED_rad_s = 0.45  # of the fastest friction pass
CURRENT_SHARE = 0.15  # of the current limit, unless gravity needs more
LIFTING = 1.6  # times the largest gravity load: margin for friction and for errors of the draft
LOAD_SHARE = 0.6  # of the current limit, at most


@dataclass(frozen=True, slots=True)
class BringupOptions:
    """Options of the operator."""

    joints: tuple[int, ...]
    current_A: float | None
    speed_rad_s: float
    with_stops: bool


@dataclass(slots=True)
class BringupOutcome:
    """Result of a run."""

    diagnoses: dict[int, Diagnosis] = field(default_factory=dict)
    wiring: WiringFound = field(default_factory=WiringFound)
    problems: list[str] = field(default_factory=list)


def bring_up(
    arm: Arm,
    bench: Workbench,
    operator: BringupOperator,
    journal: Journal,
    options: BringupOptions,
    say: Callable[[str], None],
) -> BringupOutcome:
    """Pulse, then measure the joints that have not passed yet. Raises Stopped and board errors; all drives are then off."""
    outcome = BringupOutcome()
    if options.with_stops and not bench.limits_current:
        say(
            "These boards do not take a current limit from armwright (docs/boards.md): end stops are left out, and so are home"
            " switches."
        )
        options = replace(options, with_stops=False)
    currents = {drive.joint: caution_of(arm, drive, options) for drive in arm.drives}
    say("Motor survey: a short pulse on each motor board.")
    pulses = []
    for drive in arm.drives:
        try:
            pulses.append(pulse(bench, operator, drive, currents[drive.joint], arm.joint_count))
        except SafetyTrip as trip:
            outcome.problems.append(f"{named(drive)}: {trip}")
    journal.note_pulses(pulses)
    outcome.wiring = wiring_of(pulses, arm.drives)
    outcome.problems += outcome.wiring.problems
    _say_all(say, outcome.wiring.problems, outcome.wiring.notes)
    for joint in options.joints:
        wiring = outcome.wiring.joints.get(joint)
        if wiring is None:
            outcome.problems.append(f"joint {joint}: no motor board moved it, so it was not measured")
            continue
        measure_joint(arm, bench, operator, journal, options, outcome, wiring, currents[joint], say)
    return outcome


def measure_joint(
    arm: Arm, bench: Workbench, operator: BringupOperator, journal: Journal, options: BringupOptions, outcome: BringupOutcome,
    wiring: MeasuredWiring, caution: Caution, say: Callable[[str], None],
) -> None:  # fmt: skip
    drive = arm.drive(wiring.joint)
    say(f"Joint {wiring.joint}, at most {caution.current_A:.2f} A.")
    driver = JointDriver(
        bench, drive, wiring.node, wiring.channel, wiring.motor_direction, wiring.encoder_direction, caution
    )
    try:
        found = measure(driver, operator, options.speed_rad_s, options.with_stops, wiring.joint)
    except SafetyTrip as trip:
        outcome.problems.append(f"joint {wiring.joint}: {trip}")
        say(f"  BAD   joint {wiring.joint}: {trip}")
        return
    board_counts = bench.counts_per_turn(wiring.channel) or drive.encoder_counts_per_rev
    result = diagnose(drive, wiring, found, board_counts)
    outcome.diagnoses[wiring.joint] = result
    outcome.problems += result.problems
    journal.note_joint(wiring.joint, wiring, found, result)
    _say_all(say, result.problems, result.changes + result.notes)


def _say_all(say: Callable[[str], None], problems: Sequence[str], others: Sequence[str]) -> None:
    for text in problems:
        say(f"  BAD   {text}")
    for text in others:
        say(f"        {text}")


def caution_of(arm: Arm, drive: Drive, options: BringupOptions) -> Caution:
    """Limits for a current that just moves the joint: the gravity load by the draft's masses, with a margin for friction."""
    speed_rad_s = min(SURVEY_SPEED_rad_s, drive.joint_speed_limit_rad_s)
    if options.current_A is not None:
        return Caution(options.current_A, speed_rad_s)
    limit_A = (
        drive.current_limit_A
        if math.isfinite(drive.current_limit_A)
        else drive.supply_V / drive.resistance_ohm
    )
    least_A = CURRENT_SHARE * limit_A
    lifting_A = (
        LIFTING * _gravity_Nm(arm, drive.joint) / (drive.gear_ratio * drive.torque_constant_Nm_A)
        + 0.5 * least_A
    )
    return Caution(min(max(least_A, lifting_A), LOAD_SHARE * limit_A), speed_rad_s)


def _gravity_Nm(arm: Arm, joint: int) -> float:
    """The largest torque of gravity that the draft's masses make at a joint; 0 where it has none."""
    try:
        dynamics = Dynamics(arm)
        lower, upper = np.clip(np.array(arm.limits_rad), -np.pi, np.pi).T
        poses = np.random.default_rng(0).uniform(lower, upper, (200, arm.joint_count))
        still = [0.0] * arm.joint_count
        return max(abs(dynamics.inverse(pose.tolist(), still, still)[joint - 1]) for pose in poses)
    except MissingModel:
        return 0.0
