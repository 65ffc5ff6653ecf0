"""Results of bring-up so far, saved after every joint, so that an interruption loses only one joint."""

import hashlib
import json
import math
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from control.errors import ArmError
from control.files import parsed_json, read_text, write_whole
from control.model.arm import Arm, Drive, Effect, Home
from procedures.bringup.findings import Diagnosis
from procedures.bringup.measuring import JointMeasurements
from procedures.bringup.survey import Pulse
from procedures.bringup.wiring import MeasuredWiring

FORMAT = "bringup/1"
FRICTION = ("coulomb_friction", "viscous_friction")
LEAST_FRICTION_Nm = 0.005


class Journal:
    """A journal file next to the new arm.toml. `joints` are those that passed."""

    def __init__(self, path: Path, draft: Arm) -> None:
        """Raises ArmError if an existing journal belongs to another draft."""
        self.path = path
        digest = (
            hashlib.sha256(draft.path.read_bytes()).hexdigest() if draft.path and draft.path.exists() else ""
        )
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
            raise ArmError(
                f"{self.path}: not a bring-up journal ({error}): remove it, or choose another --out"
            ) from None
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

    def note_joint(
        self, joint: int, wiring: MeasuredWiring, found: JointMeasurements, result: Diagnosis
    ) -> None:
        """Record one joint; it counts as done if there are no problems."""
        self._content["joints"][str(joint)] = {
            "passed": not result.problems,
            "wiring": asdict(wiring),
            "measured": asdict(found),
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
        "motor_node", "motor_direction", "board", "board_channel", "encoder_board", "encoder_channel", "encoder_direction",
        "encoder_counts_per_rev", "gear_ratio", "joint_lower_rad", "joint_upper_rad",
    )  # fmt: skip
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
        drives.append(_replaced(drive, keys, Home(**home) if home else None))
        effects = _with_friction(effects, drive.joint, entry["friction"])
    return replace(draft, drives=tuple(drives), effects=tuple(effects))


def _replaced(drive: Drive, keys: dict[str, Any], home: Home | None) -> Drive:
    return replace(drive, **keys, home=home)


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
