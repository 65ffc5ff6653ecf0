"""Scenario files: hidden errors of the mock robot, and its environment. `armwright arm --keys scenario` prints the keys.

Strict: an unknown key, a wrong type or a non-finite number is an error that names file and key.
"""

from __future__ import annotations

import math
import random
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from control.files import parsed_toml, read_text
from control.model.reference import NOT_A_KEY
from hil_mocks.errors import ScenarioError

SHIPPED = Path(__file__).parent / "scenarios"
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0.0)]
Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
Count = Annotated[int, msgspec.Meta(ge=0)]


class TrueDh(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Deviations of the real arm from its nominal DH parameters: drawn within +- sizes, or given."""

    seed: Annotated[int | None, "for this draw", "the scenario's"] = None
    d_m: Annotated[NotNegative, "each d is off by a uniform draw within +- this"] = 0.0
    theta_rad: Annotated[NotNegative, "the same"] = 0.0
    L_m: Annotated[NotNegative, "the same"] = 0.0
    alpha_rad: Annotated[NotNegative, "the same"] = 0.0
    deviations: Annotated[dict[str, float], "link1_d_m ...: given deviations, instead of drawn ones"] = {}


class EffectTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An effect of docs/formats.md that the arm has; it replaces the same one of the same joint in arm.toml."""

    effect: Annotated[str, "its name"]
    joint: Annotated[int, "its joint or link, from 1"] = 0
    parameters: Annotated[dict[str, float], "by name"] = {}
    arms: Annotated[tuple[str, ...], "names of those that have it", "all"] = ()


class EveryJoint(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What each joint has that no [[effect]] gives it.

    Torques are shares of the joint's torque at its current limit, so that the same scenario fits a wrist and a shoulder.
    """

    coulomb_share: Annotated[NotNegative, "Coulomb friction"] = 0.0
    viscous_share_s_rad: Annotated[NotNegative, "viscous friction at 1 rad/s"] = 0.0
    backlash_rad: Annotated[NotNegative, "play"] = 0.0


class Start(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The arm at power-up."""

    q_rad: Annotated[tuple[float, ...] | None, "where it stands", "[rest] of arm.toml, else 0"] = None
    raw_counts: Annotated[tuple[int, ...] | None, "what the encoder board counts there", "0"] = None
    homed: Annotated[bool, "zeroed earlier, and kept its power: counts nominal, ZERO_SET set"] = False


class PlantTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The physics."""

    timestep_s: Annotated[Positive, "of the physics"] = 5e-4
    link_share: Annotated[Share, "of a joint's friction, on the link side of the gear"] = 0.5
    end_stop_margin_rad: Annotated[Positive, "of the end stops behind each joint limit"] = 0.05
    arm_effects: Annotated[bool, "whether the [[effect]] of arm.toml are real"] = True


class HandTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The hand that seats the tip in a cavity."""

    speed_m_s: Annotated[Positive, "of the tip in the hand"] = 0.3
    seating_noise_m: Annotated[NotNegative, "standard deviation per axis"] = 0.0


class EncoderBoardTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The encoder board's own imperfections."""

    clock_ppm: Annotated[float, "by which its clock runs fast"] = 20.0
    index_error_rad: Annotated[NotNegative, "the true index is off by a uniform draw within +- this, at the joint"] = 0.0


class MotorBoardTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The motor boards' own imperfections."""

    current_noise_A: Annotated[NotNegative, "standard deviation of the measured current"] = 0.005
    current_step_A: Annotated[Positive, "of the analogue-to-digital converter"] = 0.001
    supply_noise_V: Annotated[NotNegative, "standard deviation of the measured supply"] = 0.01
    ambient_degC: Annotated[float, "around the power stage"] = 25.0
    thermal_K_W: Annotated[NotNegative, "from power stage to ambient"] = 2.0
    thermal_time_s: Annotated[Positive, "time constant of the power stage"] = 60.0
    bridge_ohm: Annotated[NotNegative, "heats the power stage"] = 0.02
    rated_degC: Annotated[float, "above it the board is over-temperature"] = 90.0
    digital_pins: Annotated[int, msgspec.Meta(ge=0, le=8), "spare pins of each board; 0: an older board"] = 8


class GripperTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The gripper of arm.toml as it really is, and what is between its fingers."""

    start: Annotated[Share, "opening at power-up, as a share of the travel"] = 0.5
    friction_N: Annotated[NotNegative, "dry friction"] = 1.0
    object_m: Annotated[NotNegative | None, "width of an object", "none is there"] = None
    object_N_m: Annotated[Positive, "its stiffness"] = 2e4


class CameraTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The camera that sees the tip."""

    rate_Hz: Annotated[Positive, "of its frames"] = 100.0
    noise_m: Annotated[NotNegative | None, "standard deviation per axis", "arm.toml's, else 0.14 mm"] = None
    latency_s: Annotated[NotNegative, "from the picture to the frame"] = 0.008
    dropout: Annotated[Share, "share of frames without the tip"] = 0.0
    clock_ppm: Annotated[float, "by which its clock runs fast"] = 0.0
    place_m: Annotated[tuple[float, float, float], "of a motion capture system's frame, in the base frame"] = (1.4, -0.9, 0.2)
    turn_rad: Annotated[tuple[float, float, float], "the same, its rotation vector"] = (0.1, -0.2, 2.0)


class FaultTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A fault on a line, a board or the wiring, of a kind below."""

    kind: Annotated[str, "its name"]
    board: Annotated[str, "encoder, encoder2 ...; motor1 ... by node; camera; roboclaw1 ..., drive11 ..., servo1 ..."]
    channel: Annotated[int, "of the encoder board or RoboClaw, from 0"] = 0
    at_s: Annotated[NotNegative, "when it begins; 0 for one that is built in"] = 0.0
    until_s: Annotated[float | None, "when it ends", "never"] = None
    probability: Annotated[Share, "of frames, where the kind acts on frames"] = 1.0
    value: Annotated[float | None, "by kind"] = None


class Scenario(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A scenario: hidden deviations, effects, noise and faults that are not in arm.toml. The defaults are an ideal robot."""

    name: Annotated[str, "of the scenario"] = "ideal"
    seed: Annotated[int, "fixes all that is random"] = 0
    tick_s: Annotated[Positive, "of the boards; a multiple of plant.timestep_s"] = 1e-3
    firmware: Annotated[Literal["python", "c"] | None, "of the reference boards", "$ARMWRIGHT_MOCK_FIRMWARE, else python"] = None
    true_dh: TrueDh = TrueDh()
    effect: tuple[EffectTable, ...] = ()
    every_joint: EveryJoint = EveryJoint()
    start: Start = Start()
    plant: PlantTable = PlantTable()
    hand: HandTable = HandTable()
    encoder_board: EncoderBoardTable = EncoderBoardTable()
    motor_board: MotorBoardTable = MotorBoardTable()
    gripper: GripperTable = GripperTable()
    wire: Annotated[dict[str, str], "from an output's name in arm.toml to that of the input it is connected to"] = {}
    camera: CameraTable = CameraTable()
    fault: tuple[FaultTable, ...] = ()
    path: Annotated[str, NOT_A_KEY] = ""

    def drawn_deviations(self, links: int) -> dict[str, float]:
        """The true DH deviations by name, `link1_d_m` ...; drawn ones, overridden by given ones."""
        table = self.true_dh
        source = random.Random(f"dh {self.seed if table.seed is None else table.seed}")
        sizes = {"d_m": table.d_m, "theta_rad": table.theta_rad, "L_m": table.L_m, "alpha_rad": table.alpha_rad}
        drawn = {f"link{i + 1}_{key}": source.uniform(-s, s) for i in range(links) for key, s in sizes.items()}
        return {**{name: value for name, value in drawn.items() if value != 0.0}, **table.deviations}


def shipped_scenarios() -> list[str]:
    """Names of the supplied scenarios."""
    return sorted(file.stem for file in SHIPPED.glob("*.toml"))


def load_scenario(path_or_name: str | Path) -> Scenario:
    """Read a scenario file, or a supplied one by name. Raises ScenarioError."""
    where = str(path_or_name)
    if where in shipped_scenarios():
        return parse_scenario((SHIPPED / f"{where}.toml").read_text("utf-8"), f"{where}.toml")
    path = Path(path_or_name)
    if not path.is_file():
        known = ", ".join(shipped_scenarios())
        raise ScenarioError(f"scenario {where}: there is no such file; expected a file or one of {known}.")
    try:
        text = read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else f"byte {error.start} is not UTF-8 text"
        raise ScenarioError(f"scenario {where}: cannot be read: {reason}.") from None
    return parse_scenario(text, where)


def parse_scenario(text: str, where: str) -> Scenario:
    """Scenario from TOML text; `where` names it in errors."""

    def refused(what: str) -> ScenarioError:
        return ScenarioError(f"scenario {where}: {what}.")

    try:
        document = parsed_toml(text)
    except tomllib.TOMLDecodeError as error:
        raise refused(f"not valid TOML: {error}") from error
    for key, value in _not_finite(document, ""):
        raise refused(f"{key} must be finite, got {value}")
    if "path" in document:
        raise refused('unknown key "path"')
    try:
        return msgspec.convert({**document, "path": where}, Scenario)
    except msgspec.ValidationError as error:
        raise refused(_in_terms_of_toml(str(error))) from error


def _not_finite(value: object, key: str) -> Iterator[tuple[str, float]]:
    if isinstance(value, float) and not math.isfinite(value):
        yield key.lstrip("."), value
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _not_finite(inner, f"{key}.{name}")
    if isinstance(value, list):
        for i, inner in enumerate(value):
            yield from _not_finite(inner, f"{key}[{i}]")


def _in_terms_of_toml(message: str) -> str:
    """Msgspec's `Object contains unknown field `x` - at `$.camera``."""
    what, _, at = message.partition(" - at ")
    what = what.replace("Object contains unknown field", "unknown key").replace("Object missing required field", "missing key")
    what = what.replace("`object | null`", "a table").replace("`object`", "a table")
    place = at.strip("`").removeprefix("$").lstrip(".")
    return f"[{place}] {what}" if place else what
