"""Scenario files: hidden errors of the mock robot, and its environment. Reference: docs/mock_robot.md.

Strict: an unknown key, a wrong type or a non-finite number is an error that names file and key.
"""

from __future__ import annotations

import random
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from control.files import read_text
from control.strict_toml import converted
from hil_mocks.errors import ScenarioError

SHIPPED = Path(__file__).parent / "scenarios"
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0.0)]
Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
Count = Annotated[int, msgspec.Meta(ge=0)]


class TrueDh(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Deviations of the real arm from its nominal DH parameters: drawn from a seed within +- sizes, or given."""

    seed: int | None = None  # absent: the scenario's
    d_m: NotNegative = 0.0
    theta_rad: NotNegative = 0.0
    L_m: NotNegative = 0.0
    alpha_rad: NotNegative = 0.0
    deviations: dict[str, float] = {}  # link{i}_d_m ...; replaces drawn values


class EffectTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One `[[effect]]`; `joint` is the link's number for an effect of a link. `arms`: whose it is by name; empty: any arm's."""

    effect: str
    joint: int = 0
    parameters: dict[str, float] = {}
    arms: tuple[str, ...] = ()


class EveryJoint(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """For arms of any number of joints: what each joint has that no `[[effect]]` gives it.

    Torques are shares of the joint's torque at its current limit, so that the same scenario fits a wrist and a shoulder.
    """

    coulomb_share: NotNegative = 0.0
    viscous_share_s_rad: NotNegative = 0.0  # viscous torque at 1 rad/s
    backlash_rad: NotNegative = 0.0


class Start(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The arm at power-up."""

    q_rad: tuple[float, ...] | None = None  # absent: the rest pose of arm.toml, else all zero
    raw_counts: tuple[int, ...] | None = None  # counters of the encoder board; absent: 0
    homed: bool = False  # the encoder board was zeroed earlier and kept its power


class PlantTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Options of the physics."""

    timestep_s: Positive = 5e-4
    link_share: Share = 0.5
    end_stop_margin_rad: Positive = 0.05
    arm_effects: bool = True  # the [[effect]] tables of arm.toml are real


class HandTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The hand that seats the tip in a cavity."""

    speed_m_s: Positive = 0.3
    seating_noise_m: NotNegative = 0.0  # standard deviation per axis


class EncoderBoardTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The encoder board's own imperfections."""

    clock_ppm: float = 20.0  # its clock runs fast by this
    index_error_rad: NotNegative = 0.0  # joint angle; the true index is off nominal by up to this, seeded


class MotorBoardTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The motor boards' own imperfections."""

    current_noise_A: NotNegative = 0.005
    current_step_A: Positive = 0.001  # of the analogue-to-digital converter
    supply_noise_V: NotNegative = 0.01
    ambient_degC: float = 25.0
    thermal_K_W: NotNegative = 2.0  # power stage to ambient
    thermal_time_s: Positive = 60.0
    bridge_ohm: NotNegative = 0.02  # heats the power stage
    rated_degC: float = 90.0
    digital_pins: Annotated[int, msgspec.Meta(ge=0, le=8)] = 8  # spare pins of each board; 0: an older firmware


class GripperTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The gripper of arm.toml as it really is, and what is between its fingers."""

    start: Share = 0.5  # of its travel, at power-up
    friction_N: NotNegative = 1.0
    object_m: NotNegative | None = None  # width of an object; absent: nothing
    object_N_m: Positive = 2e4  # its stiffness


class CameraTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The camera that sees the tip."""

    rate_Hz: Positive = 100.0
    noise_m: NotNegative | None = None  # absent: that of arm.toml, else 0.14 mm
    latency_s: NotNegative = 0.008
    dropout: Share = 0.0  # share of frames without the tip
    clock_ppm: float = 0.0
    place_m: tuple[float, float, float] = (1.4, -0.9, 0.2)  # of a motion capture system's frame, in the base frame
    turn_rad: tuple[float, float, float] = (0.1, -0.2, 2.0)


class FaultTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One `[[fault]]`: `board` is encoder, motor1 ... or camera; `until_s` absent: to the end."""

    kind: str
    board: str
    channel: int = 0  # of the encoder board, 0-based
    at_s: NotNegative = 0.0
    until_s: float | None = None
    probability: Share = 1.0  # of frames, where the kind acts on frames
    value: float | None = None  # by kind


class Scenario(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Everything that is not in arm.toml: hidden deviations, effects, noise, faults. The defaults are an ideal robot."""

    name: str = "ideal"
    seed: int = 0
    tick_s: Positive = 1e-3  # of the boards
    firmware: Literal["python", "c"] | None = None  # of the reference boards; absent: $ARMWRIGHT_MOCK_FIRMWARE, else python
    true_dh: TrueDh = TrueDh()
    effect: tuple[EffectTable, ...] = ()
    every_joint: EveryJoint = EveryJoint()
    start: Start = Start()
    plant: PlantTable = PlantTable()
    hand: HandTable = HandTable()
    encoder_board: EncoderBoardTable = EncoderBoardTable()
    motor_board: MotorBoardTable = MotorBoardTable()
    gripper: GripperTable = GripperTable()
    wire: dict[str, str] = {}  # from an output's name to the input that it is connected to
    camera: CameraTable = CameraTable()
    fault: tuple[FaultTable, ...] = ()
    path: str = ""  # set by the reader

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
    return converted(text, Scenario, lambda what: ScenarioError(f"scenario {where}: {what}."), path=where)
