"""One Dynamixel X servo on a half-duplex line, seen from the host."""

import math
import struct
from collections.abc import Mapping
from typing import ClassVar, Final

from firmware_iface import dynamixel_wire
from firmware_iface.clock import Clock
from firmware_iface.errors import WrongIdentity
from firmware_iface.link import ByteLink
from firmware_iface.smart_servo import Instruction, ServoLine, ServoWire, SmartServo

REBOOT_s = 0.5
STORED_SPAN = (0, 69)  # address and length: model to status return level
RETURN_DELAY, TORQUE_ENABLE, LED, GOAL_PWM, GOAL_POSITION, PROFILE, GOAL_CURRENT = (9, 64, 65, 100, 116, 108, 102)
# Address and length: torque to bus watchdog; current to temperature.
STATE_SPAN, VALUES_SPAN = (64, 35), (126, 21)
HARDWARE_ERROR, BUS_WATCHDOG = 70, 98
WATCHDOG_STEP_s, LONGEST_WATCHDOG = 0.02, 127
WATCHDOG_ERROR = 0xFF
WATCHDOG_SINCE: Final = 38  # firmware that has a bus watchdog; in the XL330 and XC330 all have
TORQUE_AT_POWER_UP: Final = 0x01  # bit of the startup configuration; in older firmware that register is 0
DELAY_STEP_s: Final = 2e-6
ALL_ANSWERED: Final = 2  # status return level
COUNTS_PER_TURN: Final = 4096
WITHIN_LIMITS: Final = 3  # the mode that keeps its position limits; its homing offset is at most a quarter of a turn
REVERSED: Final = 0x01  # bit of the drive mode: its positions have the other sense
EXTENDED, WITH_FORCE = 4, 5
POSITION_MODES: Final = {WITHIN_LIMITS: "position", EXTENDED: "extended position", WITH_FORCE: "current-based position"}
# Models by number (e-Manual), and the unit of their present current (Dynamixel2Arduino of 2025, its table of each model).
SMALL: Final = {
    1190: "XL330-M077",
    1200: "XL330-M288",
    1210: "XC330-T181",
    1220: "XC330-T288",
    1230: "XC330-M181",
    1240: "XC330-M288",
}
_FINE: Final = {1040: "XH430-V350", 1050: "XH430-V210"}
_COARSE: Final = {
    1000: "XH430-W350",
    1010: "XH430-W210",
    1020: "XM430-W350",
    1030: "XM430-W210",
    1100: "XH540-W270",
    1110: "XH540-W150",
    1120: "XM540-W270",
    1130: "XM540-W150",
    1140: "XH540-V270",
    1150: "XH540-V150",
    1001: "XD430-T350",
    1011: "XD430-T210",
    1101: "XD540-T270",
    1111: "XD540-T150",
    1170: "XW540-T260",
    1180: "XW540-T140",
    1270: "XW430-T333",
    1280: "XW430-T200",
    1310: "XW540-H260",  # its control table is that of the XW540-T260
}
# They measure no current: at its place they have the load, the share of the supply that is on the motor, in 0.1 %.
WITH_LOAD: Final = {1060: "XL430-W250", 1070: "XC430-W150", 1080: "XC430-W240", 1090: "2XL430-W250", 1160: "2XC430-W250"}
CURRENT_UNIT_A: Final = {**dict.fromkeys(SMALL, 0.001), **dict.fromkeys(_FINE, 0.00134), **dict.fromkeys(_COARSE, 0.00269)}
MODELS: Final = {**SMALL, **_FINE, **_COARSE, **WITH_LOAD}
LOAD_UNIT: Final = 0.001
FULL_PWM: Final = 885
SPEED_UNIT_rad_s: Final = 0.229 * 2.0 * math.pi / 60.0
# Model; firmware; return delay, drive mode, operating mode; homing offset; highest and lowest voltage; position limits; startup
# configuration, shutdown; status return level
_STORED = struct.Struct("<H4xB2xBBB8xi8xHH12xii4xB2xB4xB")
_VALUES = struct.Struct("<hiiiiHB")  # current, velocity, position, two of a trajectory, voltage, temperature


class DynamixelLine(ServoLine):
    """A half-duplex line with Dynamixel servos, which add themselves."""

    def __init__(self, link: ByteLink, clock: Clock) -> None:
        self.servos: list[DynamixelServo] = []
        super().__init__(link, clock, self.servos, self._goal_positions, self._all_values)

    def _goal_positions(self) -> bytes:
        goals = {servo.number: struct.pack("<i", servo.goal) for servo in self.servos if servo.goal is not None}
        return dynamixel_wire.sync_write(GOAL_POSITION, goals) if goals else b""

    def _all_values(self) -> bytes:
        return dynamixel_wire.sync_read([servo.number for servo in self.servos], *VALUES_SPAN)


class DynamixelServo(SmartServo):
    """One Dynamixel X servo."""

    CALLED = "Dynamixel"
    WIRE: ClassVar[ServoWire] = dynamixel_wire
    TORQUE, DELAY, FORCE = TORQUE_ENABLE, RETURN_DELAY, GOAL_CURRENT
    REMEDY = ", protocol 2.0, status return level 2"
    ERRORS: ClassVar[Mapping[int, str]] = {0x01: "voltage", 0x04: "heat", 0x08: "encoder", 0x10: "shock", 0x20: "overload"}

    def __init__(self, line: DynamixelLine, number: int, name: str) -> None:
        super().__init__(line, number, name)
        self.model = 0
        self._current_unit_A = math.nan
        self._watchdog = 0
        self._mode = 0
        self.values_question = self._reading(VALUES_SPAN, self._take_values)
        self.state_question = self._reading(STATE_SPAN, self._take_state)
        line.servos.append(self)

    # ---- outside of the cycle

    def identify(self) -> str:
        """Ask model, mode, and what is stored of its position, its answers and its errors. Raises BoardSilent, WrongIdentity."""
        (
            self.model,
            firmware,
            delay,
            drive_mode,
            mode,
            offset,
            highest_100mV,
            lowest_100mV,
            most,
            least,
            startup,
            self.frees_at,
            level,
        ) = _STORED.unpack(self._read(*STORED_SPAN))
        if self.model not in MODELS:
            raise WrongIdentity(
                f"{self.where}: expected a Dynamixel X that measures its current or its load (docs/dynamixel.md), it is model"
                f" {self.model}, whose control table is not known here: put an X servo there, or drive the joint by another kind"
                " of board"
            )
        self.model_name, self.bears_V = MODELS[self.model], (lowest_100mV * 0.1, highest_100mV * 0.1)
        self._current_unit_A = CURRENT_UNIT_A.get(self.model, math.nan)
        self._mode = mode
        for is_right, expected, got, remedy in (
            (
                firmware >= WATCHDOG_SINCE or self.model in SMALL or not firmware,
                f"firmware {WATCHDOG_SINCE} or newer (bus watchdog)",
                firmware,
                "update it",
            ),
            (mode in POSITION_MODES, "operating mode 3, 4 or 5 (position)", mode, "set it"),
            (not startup & TORQUE_AT_POWER_UP, "no torque at power-up (register 60, bit 0)", f"{startup} there", "set it to 0"),
        ):
            if not is_right:
                raise WrongIdentity(f"{self.where}: expected {expected}, it is {got}: {remedy} with Dynamixel Wizard")
        if level != ALL_ANSWERED:
            self._require_answers(f"status return level {ALL_ANSWERED} (register 68)", level, LED, "Dynamixel Wizard")
        self.return_delay_s = delay * DELAY_STEP_s
        notes = [f"model {self.model_name}", f"firmware {firmware}", f"{POSITION_MODES[mode]} mode"]
        notes += ["current reckoned from its load"] if self.has_load else []
        if mode == WITHIN_LIMITS:
            offset = min(max(offset, -COUNTS_PER_TURN // 4), COUNTS_PER_TURN // 4)
            self.reached = range(least, most + 1) if most > least else self.reached
            notes += [f"goals {least} to {most}"] if (least, most) != (0, COUNTS_PER_TURN - 1) else []
        self.known = range(offset, offset + COUNTS_PER_TURN)
        notes += [f"homing offset {offset}"] if offset else []
        notes += ["sense of its position reversed"] if drive_mode & REVERSED else []
        notes += [f"status return level {level}"] if level != ALL_ANSWERED else []
        return ", ".join(notes) + "; " + self.at_errors()

    def set_up(self, watchdog_s: float) -> None:
        """No motion profile, and the bus watchdog, which a restart clears. Nothing is stored, and the torque stays as it is."""
        self._write(BUS_WATCHDOG, b"\0")
        self._write(PROFILE, bytes(8))
        steps = min(max(math.floor(watchdog_s / WATCHDOG_STEP_s + 1e-9), 1), LONGEST_WATCHDOG)
        self._watchdog = 0
        self._write(BUS_WATCHDOG, bytes((steps,)))
        self._watchdog = steps
        self._force.forget()
        self.read_state()

    def require_force_limit(self) -> None:
        """Raise WrongIdentity unless its operating mode keeps a goal current, or a duty, over several turns."""
        needed = EXTENDED if self.has_load else WITH_FORCE
        if self._mode != needed:
            raise WrongIdentity(
                f"{self.where}: expected operating mode {needed} ({POSITION_MODES[needed]}) for a gripper, it is"
                f" {self._mode}: set it with Dynamixel Wizard"
            )

    def limit_force(self, current_A: float, share: float) -> None:
        """At most this goal current, or this `share` of the duty where there is none."""
        units = share * FULL_PWM if self.has_load else current_A / self._current_unit_A
        self._force.keep(max(round(units), 1))

    @property
    def _force_at(self) -> int:
        return GOAL_PWM if self.has_load else self.FORCE

    @property
    def has_load(self) -> bool:
        """Whether it measures no current."""
        return self.model in WITH_LOAD

    def read_state(self) -> None:
        """Torque, errors, and all values as they are now."""
        self._take_state(b"\0" + self._read(*STATE_SPAN), 0.0)
        now_s = self._line.clock.now_s()
        self._take_values(b"\0" + self._read(*VALUES_SPAN), now_s)

    def reboot(self) -> None:
        """Restart the servo, which ends a hardware error; its torque is off then."""
        self._watchdog = 0
        self._converse(lambda: dynamixel_wire.packet(self.number, Instruction.REBOOT), 0, "REBOOT")
        clock = self._line.clock
        clock.wait_until_s(clock.now_s() + REBOOT_s)

    # ---- answers

    def _take_values(self, data: bytes, sent_at_s: float) -> None:
        current, speed, self.position, _, _, tenths_V, self.temperature_degC = _VALUES.unpack(data[1:])
        self.current_A, self.supply_V = current * self._current_unit_A, tenths_V * 0.1
        if self.has_load:
            self.load, self.speed_rad_s = current * LOAD_UNIT, speed * SPEED_UNIT_rad_s
        self.at_s, self.late_s = sent_at_s, self._line.late_s

    def _take_state(self, data: bytes, _: float) -> None:
        registers = data[1:]
        self.is_torque_on = bool(registers[0])
        self.hardware_error = registers[HARDWARE_ERROR - STATE_SPAN[0]]
        watchdog = registers[BUS_WATCHDOG - STATE_SPAN[0]]
        self.is_watchdog_expired = watchdog == WATCHDOG_ERROR
        if self._watchdog and watchdog == 0:
            self._watchdog = 0
            self._note_restart()
