"""Bring-up of an arm, joint by joint; results are saved after each, so that an interruption loses only one."""

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from control.dynamics.dynamics import Dynamics
from control.errors import ArmError, MissingModel
from control.files import parsed_json, read_text, write_whole
from control.model.arm import Arm, Drive, Effect, Home
from procedures.bringup.diagnosis import Diagnosis, diagnose
from procedures.bringup.measuring import JointDriver, JointMeasurements, measure
from procedures.bringup.wiring import Caution, MeasuredWiring, Pulse, WiringFound, pulse, wiring_of
from procedures.bringup.workbench import BringupOperator, SafetyTrip, Workbench, named

FORMAT = "bringup/1"
FRICTION = ("coulomb_friction", "viscous_friction")
LEAST_FRICTION_Nm = 0.005


class Journal:
    """A journal file next to the new arm.toml. `joints` are those that passed."""

    def __init__(self, path: Path, draft: Arm) -> None:
        """Raises ArmError if an existing journal belongs to another draft."""
        self.path = path
        digest = hashlib.sha256(draft.path.read_bytes()).hexdigest() if draft.path and draft.path.exists() else ""
        self._content: dict[str, Any] = {
            "format": FORMAT,
            "arm": draft.name,
            "draft": str(draft.path),
            "draft_sha256": digest,
            "began": datetime.now(UTC).isoformat(timespec="seconds"),
            "pulses": [],
            "joints": {},
        }
        if path.exists():
            self._resume(digest)

    def _resume(self, digest: str) -> None:
        try:
            content = parsed_json(read_text(self.path))
            is_ours = content["format"] == FORMAT
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ArmError(f"{self.path}: not a bring-up journal ({error}): remove it, or choose another --out") from None
        if not is_ours or content.get("draft_sha256") != digest:
            raise ArmError(
                f"{self.path}: this journal belongs to another draft, or the draft has changed: remove it to start"
                " again, or choose another --out"
            )
        self._content = content

    def note_pulses(self, pulses: list[Pulse]) -> None:
        """Record the survey."""
        self._content["pulses"] = [pulse.as_json() for pulse in pulses]
        self._save()

    def note_joint(self, joint: int, wiring: MeasuredWiring, measured: JointMeasurements, result: Diagnosis) -> None:
        """Record one joint; it counts as done if there are no problems."""
        self._content["joints"][str(joint)] = {
            "passed": not result.problems,
            "wiring": asdict(wiring),
            "measured": asdict(measured),
            "figures": result.figures,
            "changes": result.changes,
            "notes": result.notes,
            "problems": result.problems,
            "drive": _keys(result.drive),
            "friction": [result.coulomb_Nm, result.viscous_Nm_s_rad],
        }
        self._save()

    def passed(self) -> list[int]:
        """Joints that are done."""
        return sorted(int(joint) for joint, entry in self._content["joints"].items() if entry["passed"])

    def entry(self, joint: int) -> dict[str, Any]:
        """The entry of a joint."""
        found: dict[str, Any] = self._content["joints"][str(joint)]
        return found

    def _save(self) -> None:
        text = json.dumps(_finite(self._content), indent=1)
        write_whole(self.path, text)


def _keys(drive: Drive) -> dict[str, Any]:
    """The keys of a drive that bring-up may change."""
    names = (
        "motor_node",
        "motor_direction",
        "board",
        "board_channel",
        "encoder_board",
        "encoder_channel",
        "encoder_direction",
        "encoder_counts_per_rev",
        "gear_ratio",
        "joint_lower_rad",
        "joint_upper_rad",
    )
    keys: dict[str, Any] = {name: getattr(drive, name) for name in names}
    keys["home"] = asdict(drive.home) if drive.home else None
    return keys


def _finite(value: Any) -> Any:
    """JSON has no NaN and no infinity."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, dict):
        return {str(key): _finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(inner) for inner in value]
    return value


def brought_up(draft: Arm, journal: Journal, serials: dict[int, int]) -> Arm:
    """The draft with the measured values. `serials`: of motor boards by node, for drives whose serial is checked."""
    drives, effects = [], list(draft.effects)
    for drive in draft.drives:
        if drive.joint not in journal.passed():
            drives.append(drive)
            continue
        entry = journal.entry(drive.joint)
        keys = {name: value for name, value in entry["drive"].items() if value is not None and name != "home"}
        home = entry["drive"]["home"]
        if drive.motor_serial_number is not None:
            keys["motor_serial_number"] = serials.get(keys["motor_node"], drive.motor_serial_number)
        drives.append(replace(drive, **keys, home=Home(**home) if home else None))
        effects = _with_friction(effects, drive.joint, entry["friction"])
    return replace(draft, drives=tuple(drives), effects=tuple(effects))


def _with_friction(effects: list[Effect], joint: int, friction: list[float | None]) -> list[Effect]:
    """Coulomb and viscous friction of a joint as measured, in place of the draft's."""
    coulomb_Nm, viscous = friction
    if coulomb_Nm is None or viscous is None:
        return effects
    others = [e for e in effects if not (e.joint == joint and e.effect in FRICTION)]
    if coulomb_Nm > LEAST_FRICTION_Nm:
        others.append(Effect("coulomb_friction", joint, {"torque_Nm": round(coulomb_Nm, 4)}))
    if viscous > LEAST_FRICTION_Nm:
        others.append(Effect("viscous_friction", joint, {"coefficient_Nm_s_rad": round(viscous, 4)}))
    return others


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


def bring_up(arm: Arm, bench: Workbench, operator: BringupOperator, journal: Journal, options: BringupOptions) -> BringupOutcome:
    """Pulse, then measure the joints that have not passed yet. Raises Stopped and board errors; all drives are then off."""
    outcome = BringupOutcome()
    if options.with_stops and not bench.limits_current:
        operator.say(
            "These boards do not take a current limit from armwright (docs/boards.md): end stops are left out, and so are home"
            " switches."
        )
        options = replace(options, with_stops=False)
    currents = {drive.joint: caution_of(arm, drive, options) for drive in arm.drives}
    operator.say("Motor survey: a short pulse on each motor board.")
    pulses = []
    for drive in arm.drives:
        try:
            pulses.append(pulse(bench, operator, drive, currents[drive.joint], arm.joint_count))
        except SafetyTrip as trip:
            outcome.problems.append(f"{named(drive)}: {trip}")
    journal.note_pulses(pulses)
    outcome.wiring = wiring_of(pulses, arm.drives)
    outcome.problems += outcome.wiring.problems
    _say_all(operator, outcome.wiring.problems, outcome.wiring.notes)
    for joint in options.joints:
        wiring = outcome.wiring.joints.get(joint)
        if wiring is None:
            outcome.problems.append(f"joint {joint}: no motor board moved it, so it was not measured")
            continue
        driver = JointDriver(bench, arm.drive(joint), wiring, currents[joint])
        measure_joint(driver, operator, journal, options, outcome)
    return outcome


def measure_joint(
    driver: JointDriver, operator: BringupOperator, journal: Journal, options: BringupOptions, outcome: BringupOutcome
) -> None:
    bench, drive, wiring = driver.bench, driver.drive, driver.wiring
    most = f", at most {driver.caution.current_A:.2f} A" if bench.limits_current else ""
    operator.say(f"Joint {wiring.joint}{most}.")
    try:
        measured = measure(driver, operator, options.speed_rad_s, options.with_stops)
    except SafetyTrip as trip:
        outcome.problems.append(f"joint {wiring.joint}: {trip}")
        _say_all(operator, [outcome.problems[-1]], ())
        return
    board_counts = bench.counts_per_turn(wiring.channel) or drive.encoder_counts_per_rev
    result = diagnose(drive, wiring, measured, board_counts)
    outcome.diagnoses[wiring.joint] = result
    outcome.problems += result.problems
    journal.note_joint(wiring.joint, wiring, measured, result)
    _say_all(operator, result.problems, result.changes + result.notes)


def _say_all(operator: BringupOperator, problems: Sequence[str], others: Sequence[str]) -> None:
    for text in problems:
        operator.say(f"  BAD   {text}")
    for text in others:
        operator.say(f"        {text}")


def caution_of(arm: Arm, drive: Drive, options: BringupOptions) -> Caution:
    """Limits for a current that just moves the joint: the gravity load by the draft's masses, with a margin for friction."""
    speed_rad_s = min(SURVEY_SPEED_rad_s, drive.joint_speed_limit_rad_s)
    if options.current_A is not None:
        return Caution(options.current_A, speed_rad_s)
    limit_A = drive.current_limit_A if math.isfinite(drive.current_limit_A) else drive.supply_V / drive.resistance_ohm
    least_A = CURRENT_SHARE * limit_A
    lifting_A = LIFTING * _gravity_Nm(arm, drive.joint) / (drive.gear_ratio * drive.torque_constant_Nm_A) + 0.5 * least_A
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
