"""One Feetech STS servo on a half-duplex line, seen from the host."""

import struct
from collections.abc import Mapping
from typing import ClassVar, Final

from firmware_iface import feetech_wire
from firmware_iface.clock import Clock
from firmware_iface.errors import WrongIdentity
from firmware_iface.link import ByteLink
from firmware_iface.smart_servo import ServoLine, ServoWire, SmartServo

STORED_SPAN = (0, 37)  # address and length: firmware to overload torque
RETURN_DELAY, TORQUE, ACCELERATION, GOAL_POSITION, GOAL_SPEED, TORQUE_LIMIT = 7, 40, 41, 42, 46, 48
STATE_SPAN = (40, 31)  # address and length: torque to current
CURRENT_UNIT_A: Final = 0.0065
MODELS: Final = {777: "STS3215", 2825: "STS3250"}
SERIES: Final = 9  # low byte of the model: all STS have one memory table
ON: Final = 1  # of the torque switch: 2 only damps, 128 sets the position's zero
# Torque; acceleration to lock; position, speed, load; voltage, temperature; asynchronous write; error; moving; two bytes; current
DELAY_STEP_s: Final = 2e-6
ALL_ANSWERED: Final = 1  # response level
COUNTS_PER_TURN: Final = 4096
FURTHEST: Final = 7 * COUNTS_PER_TURN  # of a goal without position limits: seven turns
BEYOND_A_TURN: Final = 0x10  # bit of the phase: the position counts on beyond a turn until the supply is cut
REVERSED: Final = 0x80  # bit of the phase: the position has the other sense
SPEED_0_IS_FULL: Final = 0x08  # bit of the phase; without it a goal speed of 0 lets it stand
NO_SPEED_LIMIT: Final = {True: 0, False: 0x7FFF}  # the goal speed, by that bit
OVERLOAD: Final = 0x20  # of the errors: load above a share of the torque for a time; it keeps another share
# Firmware; model; return delay, response level; least and greatest position; highest and lowest voltage; phase, unloading
# condition; resolution; position correction with its sign in bit 11; mode; protective torque, protection time, overload torque
_STORED = struct.Struct("<BBxH2xBBHHxBB2xBB10xBHBBBB")
_STATE = struct.Struct("<B15xHHHBBxBB2xH")


class FeetechLine(ServoLine):
    """A half-duplex line with STS servos, which add themselves."""

    def __init__(self, link: ByteLink, clock: Clock) -> None:
        self.servos: list[FeetechServo] = []
        super().__init__(link, clock, self.servos, self._goal_positions, self._all_states)

    def _goal_positions(self) -> bytes:
        goals = {servo.number: feetech_wire.raw(servo.goal) for servo in self.servos if servo.goal is not None}
        return feetech_wire.sync_write(GOAL_POSITION, goals) if goals else b""

    def _all_states(self) -> bytes:
        return feetech_wire.sync_read([servo.number for servo in self.servos], *STATE_SPAN)


class FeetechServo(SmartServo):
    """One STS servo. It has no bus watchdog: without the host it holds its last goal.

    A goal position that is written switches its torque on, whatever was written to the switch before.
    """

    CALLED = "STS servo"
    WIRE: ClassVar[ServoWire] = feetech_wire
    TORQUE, DELAY, FORCE = TORQUE, RETURN_DELAY, TORQUE_LIMIT
    ERRORS: ClassVar[Mapping[int, str]] = {0x01: "voltage", 0x02: "sensor", 0x04: "heat", 0x08: "current", OVERLOAD: "overload"}

    def __init__(self, line: FeetechLine, number: int, name: str) -> None:
        super().__init__(line, number, name)
        self._is_wanted = self._must_be_on = False  # the torque
        self._has_turns = False  # it counts on, and has no position limits
        self._speed_0_is_full = True
        self.values_question = self.state_question = self._reading(STATE_SPAN, self._take_state)
        line.servos.append(self)

    def _switching_on(self) -> bytes:
        """Torque on, no ramp, and the goal where it is: in one instruction, so that no older goal is ever gone to."""
        return b"\x01\0" + feetech_wire.raw(self.position)

    def post_torque(self, is_on: bool) -> None:
        """Queue switching the torque, if it is not so already."""
        self._is_wanted = is_on
        self._must_be_on &= is_on
        super().post_torque(is_on)

    # ---- outside of the cycle

    def identify(self) -> str:
        """Ask model, mode, and what is stored of its position, its answers and its errors. Raises BoardSilent, WrongIdentity."""
        (
            major,
            minor,
            model,
            delay,
            level,
            least,
            most,
            highest_100mV,
            lowest_100mV,
            phase,
            unloads_at,
            resolution,
            correction,
            mode,
            kept_percent,
            protection_10ms,
            overload_percent,
        ) = _STORED.unpack(self._read(*STORED_SPAN))
        if model & 0xFF != SERIES:
            known = ", ".join(f"{number} ({name})" for number, name in MODELS.items())
            raise WrongIdentity(
                f"{self.where}: expected an STS, model {known} or another {SERIES}.x, it is model {model}"
                f" ({model & 0xFF}.{model >> 8})"
            )
        for what, is_right, expected, got in (
            ("mode", mode == 0, "0 (position)", mode),
            ("angular resolution (register 30)", resolution <= 1, f"1 ({COUNTS_PER_TURN} counts a turn)", resolution),
        ):
            if not is_right:
                raise WrongIdentity(f"{self.where}: expected {what} {expected}, it is {got}: set it with Feetech's FD tool")
        if level != ALL_ANSWERED:
            self._require_answers(f"response level {ALL_ANSWERED} (register 8)", level, ACCELERATION, "Feetech's FD tool")
        self.model_name, self.bears_V = MODELS.get(model, ""), (lowest_100mV * 0.1, highest_100mV * 0.1)
        self._speed_0_is_full = bool(phase & SPEED_0_IS_FULL)
        self.return_delay_s = delay * DELAY_STEP_s
        self.known = range(COUNTS_PER_TURN)
        self.reached = range(least, most + 1) if most > least else range(-FURTHEST, FURTHEST + 1)
        self._has_turns = most <= least and bool(phase & BEYOND_A_TURN)
        self.weakens_at = unloads_at & OVERLOAD if kept_percent else 0
        self.frees_at = unloads_at & ~self.weakens_at
        called = self.model_name or f"{SERIES}.{model >> 8}, not known here: taken for one as the STS3215"
        notes = [f"model {called}", f"firmware {major}.{minor}", "position mode"]
        if most <= least:
            notes.append("no position limits: goals of several turns")
        elif (least, most) != (0, COUNTS_PER_TURN - 1):
            notes.append(f"goals {least} to {most}")
        notes += [f"position correction {feetech_wire.signed(correction, 11)}"] if correction else []
        notes += ["counts on beyond a turn until its supply is cut"] if phase & BEYOND_A_TURN else []
        notes += ["sense of its position reversed"] if phase & REVERSED else []
        notes += [f"response level {level}"] if level != ALL_ANSWERED else []
        overload = f" (above {overload_percent} % for {protection_10ms / 100:g} s; {kept_percent} % are left)"
        return ", ".join(notes) + "; " + self.at_errors(overload)

    def set_up(self, watchdog_s: float) -> None:
        """No ramp and no speed limit. Nothing is stored, the torque stays as it is; there is no watchdog to set."""
        self._write(ACCELERATION, b"\0")
        self._write(GOAL_SPEED, feetech_wire.raw(NO_SPEED_LIMIT[self._speed_0_is_full]))
        self._force.forget()
        self.read_state()

    def require_force_limit(self) -> None:
        """Every STS keeps a torque limit. WrongIdentity unless its counts and goals go on beyond the turn that it is found in."""
        if not self._has_turns:
            raise WrongIdentity(
                f"{self.where}: expected counts and goals beyond a turn for a gripper (register 18 with bit 4, position limits 0"
                " and 0): set them with Feetech's FD tool"
            )

    def limit_force(self, current_A: float, share: float) -> None:
        """A torque limit: a `share` of the duty, which gives the current at rest."""
        self._force.keep(max(round(1e3 * share), 1))

    def read_state(self) -> None:
        """Torque, errors, and all values as they are now."""
        now_s = self._line.clock.now_s()
        self._take_state(b"\0" + self._read(*STATE_SPAN), now_s)

    def reboot(self) -> None:
        """There is no restart by the bus: torque off ends an overload."""
        self._is_wanted = self._must_be_on = False
        self._write(TORQUE, b"\0")

    def _take_state(self, data: bytes, sent_at_s: float) -> None:
        torque, position, _, _, tenths_V, self.temperature_degC, error, _, current = _STATE.unpack(data[1:])
        self.position, self.current_A = feetech_wire.signed(position), feetech_wire.signed(current) * CURRENT_UNIT_A
        self.supply_V, self.hardware_error = tenths_V * 0.1, error
        self.at_s, self.late_s = sent_at_s, self._line.late_s
        self.is_torque_on = torque == ON
        if self.is_torque_on:
            self._must_be_on = self._is_wanted  # not by an answer from before it was switched off
        elif self._must_be_on:
            self._must_be_on = False
            self._note_restart()
