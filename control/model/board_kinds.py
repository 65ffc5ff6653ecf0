"""Kinds of boards and smart servos that drive joints, as data: what each offers, and what the loop may expect of it; and the CAN
bus that boards share: its load by joints, gripper and pins of all arms on it, and the rate that it leaves the loop.

A `[[drive]]` without `board` is on a reference motor board (docs/motor_board.md): REFERENCE. `control.hardware.connect` opens the
others; each has a page in docs. A servo's data sheet is what `servo = "..."` of a [[drive]] or [gripper] stands for. A key that
stands in the file beside it counts instead: a servo that was measured, or one on another supply.
"""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Annotated, Any, Final, Literal, Protocol

from control.model.drive import Drive
from control.model.end_effector import Digital, Gripper
from control.model.reader import Rejected, show
from control.model.rules import ONE_OR_MORE, Rule


@dataclass(frozen=True, slots=True)
class BoardKind:
    """What a board offers. `modes` are those of [drive.pid], the usual one first."""

    line: Literal["serial", "can"]
    addresses: range  # on its line
    modes: tuple[Literal["voltage", "current", "position"], ...]
    can_free: bool  # opens the motor's circuit; else a hand moves the joint against shorted windings
    can_hold: bool  # brings its joint to rest and holds it without the host
    usual_rate_Hz: float  # of the loop
    motors: int = 1  # on one board
    has_encoder: bool = True  # its own, which the loop can use
    is_absolute: bool = False  # that encoder knows its place within one turn at power-up: there is nothing to home
    stops_early: bool = False  # begins its own stop some cycles after the last command, not only at its watchdog
    limits_force: bool = False  # in position mode, to what the host says: it can drive a gripper
    limits_current: bool = False  # it takes `current_limit_A` from the host; else its own settings alone limit the current
    needs_fd: bool = False  # it speaks CAN FD alone
    needs_own_bus: bool = False  # takes reference boards' frames for its own, and they take its
    uses_other_encoder: bool = True  # in modes other than position; else it closes its loop on its own in every mode
    may_be_absolute: bool = False  # as is_absolute, where its settings make it so: `absolute` of [[board]]
    frees_in: tuple[str, ...] = ()  # modes in which it frees its motor without the host: nothing stops the joint
    moves_on: bool = False  # in position mode at the speed of the last command; else it stays at its position
    current_step_A: float = 0.0  # to which it rounds the current, where that is much
    current_is_newest: bool = True  # measured after the last command; else before the one that it answers
    counts_per_turn: int = 0  # that it sends, whatever the encoder; 0: its encoder's
    first_count: int | None = None  # of the turn that an absolute encoder knows; None: its settings say
    highest_supply_V: float = math.inf  # of its usual types
    cycle_bits: int = 0  # of a CAN bus with worst stuffing, in each cycle of the loop: its command, and what answers it
    shared_bits: int = 0  # the same, once for all boards of a bus
    sent_bits_s: float = 0.0  # of what it sends unasked, at the rates that its page asks for
    has_switch: bool = True  # reads a home switch, where it does not know the joint's angle
    has_limit_inputs: bool = False  # says of limit switches at its own inputs
    limits_are_levels: bool = True  # it says their levels; else whether a switch is met, by its own settings
    switch_inputs: int = 1  # of each motor, for home and limit switches


REFERENCE: Final = BoardKind(
    line="can",
    addresses=range(1, 16),
    modes=("voltage", "current", "position"),
    has_encoder=False,  # what the loop uses is the encoder board's
    can_free=True,
    can_hold=True,
    usual_rate_Hz=500.0,
    stops_early=True,
    limits_current=True,
    current_is_newest=False,
    cycle_bits=2 * 135,  # 8 bytes each
)

KINDS: Final[Mapping[str, BoardKind]] = MappingProxyType(
    {
        "roboclaw": BoardKind(
            line="serial",
            motors=2,
            addresses=range(0x80, 0x88),
            modes=("voltage",),
            can_free=False,
            can_hold=False,
            usual_rate_Hz=100.0,
            limits_current=True,
            highest_supply_V=34.0,
            has_limit_inputs=True,
            limits_are_levels=False,
        ),
        "cia402": BoardKind(
            line="can",
            addresses=range(1, 127),
            modes=("position", "current"),
            can_free=True,
            can_hold=True,
            usual_rate_Hz=250.0,
            limits_force=True,
            needs_own_bus=True,
            uses_other_encoder=False,
            cycle_bits=125 + 75 + 2 * 135,  # its PDOs of 7, 2, 8 and 8 bytes
            shared_bits=55,  # SYNC
            has_limit_inputs=True,
            switch_inputs=3,
        ),
        "dynamixel": BoardKind(
            line="serial",
            addresses=range(253),
            modes=("position",),
            is_absolute=True,
            can_free=True,
            can_hold=True,
            usual_rate_Hz=100.0,
            limits_force=True,
            counts_per_turn=4096,
        ),
        "feetech": BoardKind(
            line="serial",
            addresses=range(253),
            modes=("position",),
            is_absolute=True,
            can_free=True,
            can_hold=True,
            usual_rate_Hz=100.0,
            limits_force=True,
            counts_per_turn=4096,
            first_count=0,
        ),
        "moteus": BoardKind(
            line="can",
            addresses=range(1, 128),
            modes=("position", "current"),
            can_free=True,
            can_hold=True,
            usual_rate_Hz=250.0,
            limits_force=True,
            limits_current=True,
            needs_fd=True,
            highest_supply_V=44.0,
            may_be_absolute=True,
            moves_on=True,
            cycle_bits=355,  # as long at 1 Mbit/s; what is sent at 5 Mbit/s counts a fifth
        ),
        "odrive": BoardKind(
            line="can",
            addresses=range(63),
            modes=("position", "current"),
            can_free=True,
            can_hold=True,
            usual_rate_Hz=250.0,
            limits_force=True,
            limits_current=True,
            needs_own_bus=True,
            may_be_absolute=True,
            moves_on=True,
            frees_in=("current",),
            has_switch=False,
            cycle_bits=135,
            sent_bits_s=135 * (2 * 250 + 2 * 100 + 10),  # encoder, IQ; heartbeat, bus; temperature
        ),
        "vesc": BoardKind(
            line="can",
            addresses=range(254),
            modes=("voltage", "current", "position"),
            can_free=True,
            can_hold=False,
            usual_rate_Hz=200.0,
            limits_current=True,
            counts_per_turn=18_000,
            current_step_A=0.1,
            cycle_bits=120,  # 4 bytes, with a 29-bit id
            shared_bits=150 + 160,  # the question for a fault code, and its answer
            sent_bits_s=160 * (4 * 200 + 2 * 5),  # status 1, 4, 5, 6; 2, 3
        ),
    }
)
KIND: Final = Rule(f"a kind of board: {', '.join(KINDS)}", lambda kind: kind in KINDS)


def bus_conflict(kinds: Collection[str]) -> str | None:
    """Why boards of these kinds cannot share a CAN bus, "" for the reference boards; None if they can."""
    alone = sorted(kind for kind in set(kinds) if kind and KINDS[kind].needs_own_bus)
    others = [*alone[1:], *(["reference motor boards"] if alone and "" in kinds else [])]
    if not others:
        return None
    return f"no {alone[0]} beside {others[0]} on one CAN bus: each takes the other's frames for its own"


FRAME_bits: Final = 135  # 8 bytes with worst stuffing (docs/motor_board.md)
USUAL_LOAD: Final = 0.7  # of a CAN bus, at most; `doctor` expects it
RATE_STEP_Hz: Final = 50.0
GRIPPER_FRAMES: Final = 4  # a COMMAND, a question for the count, and their answers
GRIPPER_PERIOD_s: Final = 0.01  # its frames in this time are 5 % of a bus of 1 Mbit/s
PIN_FRAMES: Final = 2  # a DIGITAL_COMMAND and its reply, for each board with pins
PIN_PERIOD_s: Final = 0.02  # between questions: 1.4 % of a bus of 1 Mbit/s for each board with pins


@dataclass(frozen=True, slots=True)
class CanBus:
    """The bus of the motor boards, in python-can's terms."""

    interface: Annotated[str, "socketcan, slcan, ..."]
    channel: Annotated[str, "can0, /dev/ttyACM1, ..."]
    bitrate: Annotated[int, ONE_OR_MORE, "of the bus, in bit/s"] = 1_000_000
    options: Annotated[Mapping[str, str | int | float | bool], "passed to the interface unchanged"] = field(default_factory=dict)


class OnBus(Protocol):
    """What an arm has on its bus."""

    @property
    def can(self) -> CanBus | None: ...
    @property
    def motors(self) -> tuple[Drive, ...]: ...
    @property
    def gripper(self) -> Gripper | None: ...
    @property
    def digital(self) -> tuple[Digital, ...]: ...
    @property
    def boards_rate_Hz(self) -> float: ...
    def kind_of(self, drive: Drive) -> BoardKind: ...


def bus_load(arms: Sequence[OnBus], rate_Hz: float, with_unasked: bool = True) -> float:
    """Worst-case share of the busiest CAN bus, for all that its boards are sent and send, or only for what they are asked."""
    loads: dict[tuple[str, str], float] = {}
    for arm in arms:
        if arm.can is not None:
            bus = (arm.can.interface, arm.can.channel)
            on_can = [kind for kind in map(arm.kind_of, arm.motors) if kind.line == "can"]
            cycle_bits = sum(kind.cycle_bits for kind in on_can) + max((kind.shared_bits for kind in on_can), default=0)
            bits_s = cycle_bits * rate_Hz + _end_frames_Hz(arm) * FRAME_bits
            bits_s += with_unasked * sum(kind.sent_bits_s for kind in on_can)
            loads[bus] = loads.get(bus, 0.0) + bits_s / arm.can.bitrate
    return max(loads.values(), default=0.0)


def good_rate_Hz(arms: Sequence[OnBus], rate_Hz: float) -> float:
    """The highest rate with a good load, by the load at any `rate_Hz`; infinite where no board is asked in each cycle."""
    fixed = bus_load(arms, 0.0)
    asked = bus_load(arms, rate_Hz) - fixed
    return max(0.0, (USUAL_LOAD - fixed) / asked * rate_Hz) if asked > 0.0 else math.inf


def usual_rate_Hz(arms: Sequence[OnBus]) -> float:
    """The loop's rate if none is asked for: what the slowest boards of all arms carry, and their buses.

    What bought boards send unasked comes at rates of their own, which a slower loop does not change: `serve` tells of it.
    """
    rate_Hz = min(arm.boards_rate_Hz for arm in arms)
    while bus_load(arms, rate_Hz, with_unasked=False) > USUAL_LOAD and rate_Hz > RATE_STEP_Hz:
        rate_Hz = max(RATE_STEP_Hz, RATE_STEP_Hz * math.ceil(rate_Hz / RATE_STEP_Hz - 1.0))
    return rate_Hz


def _end_frames_Hz(arm: OnBus) -> float:
    """Frames a second for gripper and pins, whatever the rate of the loop."""
    is_on_node = arm.gripper is not None and not arm.gripper.board
    grips = GRIPPER_FRAMES / GRIPPER_PERIOD_s if is_on_node else 0.0
    return grips + PIN_FRAMES * len({pin.board for pin in arm.digital}) / PIN_PERIOD_s


RPM: Final = 2.0 * math.pi / 60.0
KG_CM: Final = 0.0980665  # N m
HORN_TEETH: Final = 25  # of an STS3215
DRIVE_KEYS: Final = (
    "gear_ratio",
    "encoder_counts_per_rev",
    "torque_constant_Nm_A",
    "resistance_ohm",
    "supply_V",
    "current_limit_A",
)
GRIPPER_KEYS: Final = ("encoder_counts_per_rev", "torque_constant_Nm_A", "resistance_ohm", "supply_V")


@dataclass(frozen=True, slots=True)
class ServoType:
    """A servo at its output, whose gear is inside: stalled and without load, at its nominal supply; a speed of 0 is not known."""

    kind: str
    supply_V: float
    stall_Nm: float
    stall_A: float
    free_rad_s: float
    horn_teeth: int = 0  # places in which the horn fits its shaft, where it can be put on wrongly

    @property
    def torque_constant_Nm_A(self) -> float:
        """At the output, less what its gear loses when stalled."""
        return self.stall_Nm / self.stall_A

    @property
    def resistance_ohm(self) -> float:
        """Of the winding: a stalled motor has no other voltage."""
        return self.supply_V / self.stall_A

    def values(self, servos: int = 1) -> dict[str, float | int]:
        """What it gives a drive that so many of them turn together: one motor of their summed current."""
        return {
            "gear_ratio": 1.0,
            "encoder_counts_per_rev": KINDS[self.kind].counts_per_turn,
            "torque_constant_Nm_A": self.torque_constant_Nm_A,
            "resistance_ohm": self.resistance_ohm / servos,
            "supply_V": self.supply_V,
            "current_limit_A": self.stall_A * servos,
        }


SERVOS: Final[Mapping[str, ServoType]] = MappingProxyType(
    {
        # ROBOTIS e-Manual: stall torque and current, speed without load, at the recommended voltage
        "XL330-M288": ServoType("dynamixel", 5.0, 0.52, 1.47, 103.0 * RPM),
        "XL430-W250": ServoType("dynamixel", 12.0, 1.5, 1.4, 61.0 * RPM),
        "XM430-W350": ServoType("dynamixel", 12.0, 4.1, 2.3, 46.0 * RPM),
        "XM540-W270": ServoType("dynamixel", 12.0, 10.6, 4.4, 30.0 * RPM),
        # Feetech's data sheet of the ST-3215-C018, gear 1:345: 30 kg cm, 2.7 A, 0.222 s for 60 deg
        "STS3215-12V": ServoType("feetech", 12.0, 30.0 * KG_CM, 2.7, 45.0 * RPM, HORN_TEETH),
        # C001, the same gear: 19.5 kg cm by those who sell it. The current is reckoned: a motor of the same size loses as much
        # heat for the square of its torque, however it is wound
        "STS3215-7.4V": ServoType("feetech", 7.4, 19.5 * KG_CM, 12.0 * 2.7 / 7.4 * (19.5 / 30.0) ** 2, 0.0, HORN_TEETH),
    }
)


def with_servo_values(document: dict[str, Any]) -> dict[str, Any]:
    """A parsed arm.toml with what its servos' data sheets say where it says nothing. Rejected: no such servo."""

    def filled(table: Any, path: tuple[str | int, ...], keys: tuple[str, ...]) -> Any:
        return _sheet(table, path, keys) | table if _names_servo(table) else table

    return _each(document, filled)


def without_servo_values(document: dict[str, Any]) -> dict[str, Any]:
    """The opposite, for a file that is written: what the data sheet says is left out."""

    def emptied(table: Any, path: tuple[str | int, ...], keys: tuple[str, ...]) -> Any:
        said = _sheet(table, path, keys) if _names_servo(table) else {}
        return {key: value for key, value in table.items() if said.get(key) != value}

    return _each(document, emptied)


def _each(document: dict[str, Any], changed: Callable[[Any, tuple[str | int, ...], tuple[str, ...]], Any]) -> dict[str, Any]:
    """The document with what may name a servo changed; what is no table is left to the reader to refuse."""
    others = dict(document)
    if isinstance(drives := document.get("drive"), list):
        others["drive"] = [changed(drive, ("drive", i), DRIVE_KEYS) for i, drive in enumerate(drives)]
    if "gripper" in document:
        others["gripper"] = changed(document["gripper"], ("gripper",), GRIPPER_KEYS)
    return others


def _names_servo(table: Any) -> bool:
    return isinstance(table, dict) and table.get("servo", "") != ""


def _sheet(table: dict[str, Any], path: tuple[str | int, ...], keys: tuple[str, ...]) -> dict[str, float | int]:
    named, servos = table["servo"], table.get("servos", 1)
    if not isinstance(named, str) or named not in SERVOS:
        raise Rejected((*path, "servo"), " or ".join(f'"{name}"' for name in SERVOS), show(named))
    values = SERVOS[named].values(servos if type(servos) is int and servos > 0 else 1)
    return {key: values[key] for key in keys}
