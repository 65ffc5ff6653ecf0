"""ODrives on a CAN bus, seen from the host: they send what they measure unasked; commands are not answered.
The frames come first, without I/O; then the driver.

Frames of an ODrive on CAN (CANSimple, firmware 0.6). Source: ODrive's CAN documentation and its DBC, 0.6.10.

    11-bit id: node << 5 | command; numbers are little endian, f32 unless said otherwise

    from the ODrive, at rates of its own                 to the ODrive
    HEARTBEAT 0x01     u32 errors, u8 state,             SET_AXIS_STATE 0x07       u32 state
                       u8 procedure result, u8 done      SET_CONTROLLER_MODE 0x0B  u32 control, u32 input
    ENCODER 0x09       turns, turns/s                    SET_INPUT_POS 0x0C        turns, i16 1e3/(turns/s), i16 1e3/Nm
    IQ 0x14            set A, measured A                 SET_INPUT_TORQUE 0x0E     Nm
    TEMPERATURE 0x15   FETs degC, motor degC             SET_LIMITS 0x0F           turns/s, A
    BUS 0x17           V, A                              CLEAR_ERRORS 0x18         u8 0

Firmware 0.5 has messages of the same form and another meaning. It answers an empty frame of SENSORLESS_ERROR 0x05 by the same,
u32 error and four bytes of 0, which 0.6 does not know (ODrive's own can_simple.cpp of 0.5.6). There 0x05 carries answers about
settings: u8 0, u16 which, u8 0, the value.

The errors of HEARTBEAT are those that there are, and those that ended the last operation until CLEAR_ERRORS.
"""

import math
import struct
from enum import IntEnum, IntFlag
from typing import Final, NamedTuple

from firmware_iface.errors import BoardFaulted, BoardRefused, BoardReset, BoardSilent, ProtocolViolation, WrongIdentity
from firmware_iface.node_bus import NodeBus, UnaskedBoard

NODES: Final = range(63)  # 63 is all of them
MOST_SPEED_turns_s: Final = 32.767  # of a feed-forward
PASSTHROUGH: Final = 1  # an input mode: set-points take effect as they come

Frame = tuple[int, bytes]


class OdriveCommand(IntEnum):
    """Commands of CANSimple."""

    HEARTBEAT = 0x01
    SENSORLESS_ERROR = 0x05  # of firmware 0.5
    SET_AXIS_STATE = 0x07
    ENCODER = 0x09
    SET_CONTROLLER_MODE = 0x0B
    SET_INPUT_POS = 0x0C
    SET_INPUT_TORQUE = 0x0E
    SET_LIMITS = 0x0F
    IQ = 0x14
    TEMPERATURE = 0x15
    BUS = 0x17
    CLEAR_ERRORS = 0x18


class AxisState(IntEnum):
    """States of an axis that are used here."""

    IDLE = 1
    CLOSED_LOOP_CONTROL = 8


class OdriveControlMode(IntEnum):
    """Control modes that are used here."""

    TORQUE = 1
    POSITION = 3


class Error(IntFlag):
    """Errors of an axis."""

    INITIALIZING = 1 << 0
    SYSTEM_LEVEL = 1 << 1
    TIMING_ERROR = 1 << 2
    MISSING_ESTIMATE = 1 << 3
    BAD_CONFIG = 1 << 4
    DRV_FAULT = 1 << 5
    MISSING_INPUT = 1 << 6
    DC_BUS_OVER_VOLTAGE = 1 << 8
    DC_BUS_UNDER_VOLTAGE = 1 << 9
    DC_BUS_OVER_CURRENT = 1 << 10
    DC_BUS_OVER_REGEN_CURRENT = 1 << 11
    CURRENT_LIMIT_VIOLATION = 1 << 12
    MOTOR_OVER_TEMP = 1 << 13
    INVERTER_OVER_TEMP = 1 << 14
    VELOCITY_LIMIT_VIOLATION = 1 << 15
    POSITION_LIMIT_VIOLATION = 1 << 16
    WATCHDOG_TIMER_EXPIRED = 1 << 24
    ESTOP_REQUESTED = 1 << 25
    SPINOUT_DETECTED = 1 << 26
    BRAKE_RESISTOR_DISARMED = 1 << 27
    THERMISTOR_DISCONNECTED = 1 << 28
    CALIBRATION_ERROR = 1 << 30


class Heartbeat(NamedTuple):
    """Errors, state (AxisState, or another number), and how the last procedure ended (0: well, 1: it goes on)."""

    errors: Error
    state: int
    result: int


def frame_id(node: int, command: int) -> int:
    """The 11-bit id of a command to or from a node."""
    return node << 5 | command


def axis_state(node: int, state: AxisState) -> Frame:
    """Ask for a state. An axis that is asked for the state that it has leaves it and enters it anew."""
    return frame_id(node, OdriveCommand.SET_AXIS_STATE), struct.pack("<I", state)


def controller_mode(node: int, control: OdriveControlMode) -> Frame:
    """Choose what the inputs are; they take effect as they come."""
    return frame_id(node, OdriveCommand.SET_CONTROLLER_MODE), struct.pack("<II", control, PASSTHROUGH)


def position(node: int, turns: float, speed_turns_s: float = 0.0) -> Frame:
    """Set the encoder's position, and the speed at which it moves there: at most MOST_SPEED_turns_s, the field's end."""
    speed = round(1e3 * min(max(speed_turns_s, -MOST_SPEED_turns_s), MOST_SPEED_turns_s))
    return frame_id(node, OdriveCommand.SET_INPUT_POS), struct.pack("<fhh", turns, speed, 0)


def torque(node: int, torque_Nm: float) -> Frame:
    """Set the motor's torque."""
    return frame_id(node, OdriveCommand.SET_INPUT_TORQUE), struct.pack("<f", torque_Nm)


def limits(node: int, speed_turns_s: float, current_A: float) -> Frame:
    """Limit speed and current until the next start; nothing is stored."""
    return frame_id(node, OdriveCommand.SET_LIMITS), struct.pack("<ff", speed_turns_s, current_A)


def clear_errors(node: int) -> Frame:
    """Forget errors whose cause is gone."""
    return frame_id(node, OdriveCommand.CLEAR_ERRORS), b"\x00"


def ask_sensorless_error(node: int) -> Frame:
    """A question that firmware 0.5 answers, and no other."""
    return frame_id(node, OdriveCommand.SENSORLESS_ERROR), b""


def is_sensorless_error(payload: bytes) -> bool:
    """Whether an answer is one of firmware 0.5, of whose errors the first byte has all; else it is 0.6's about a setting."""
    return len(payload) == 8 and not any(payload[1:])


def heartbeat(payload: bytes) -> Heartbeat:
    """HEARTBEAT, with or without what follows the result. struct.error if it is shorter."""
    errors, state, result = struct.unpack_from("<IBB", payload)
    return Heartbeat(Error(errors), state, result)


def pair(payload: bytes) -> tuple[float, float]:
    """The two numbers of ENCODER, IQ, TEMPERATURE or BUS. struct.error if it has another length."""
    first, second = struct.unpack("<ff", payload)
    return first, second


STATUS_WAIT_s = 0.5  # an ODrive that sends more slowly cannot be used
VERSION_WAIT_s = 0.01  # for an answer that only firmware 0.5 gives; no longer, as watchdogs of other axes run
GAP_s = 0.1  # without a heartbeat: it may have restarted meanwhile
ASK_AGAIN_s = 0.1  # for a state: the heartbeat tells of it a little later, and asking twice leaves the state
_GOES_ON: Final = (0, 1, 2, 3)  # procedure results: well, busy, cancelled, disarmed (an error says why)
# What switches a message on that is needed here: the loop watches current and supply. As delivered IQ and BUS are off.
_SETTINGS: Final = {
    OdriveCommand.HEARTBEAT: "heartbeat_msg_rate_ms = 10",
    OdriveCommand.ENCODER: "encoder_msg_rate_ms = 4",
    OdriveCommand.IQ: "iq_msg_rate_ms = 4",
    OdriveCommand.BUS: "bus_voltage_msg_rate_ms = 10",
}


class OdriveBus(NodeBus["OdriveAxis"]):
    """A bus of 11-bit ids with its axes."""

    def _take(self, can_id: int, payload: bytes, now_s: float) -> None:
        if (axis := self.nodes.get(can_id >> 5)) is not None:
            axis.take(can_id & 0x1F, payload, now_s)


class OdriveAxis(UnaskedBoard):
    """Keeps the latest values of an axis and what is wanted of it; times are the host's, on arrival, but for the count's."""

    make, numbered, numbers = "ODrive", "node id", NODES

    def __init__(self, bus: OdriveBus, node: int, name: str, counts_per_turn: int) -> None:
        """`counts_per_turn`: the position comes as turns, and is made counts of so many a turn."""
        super().__init__(bus, node, name, _SETTINGS)
        self.node, self.counts_per_turn = node, counts_per_turn
        self.errors: Error | None = None
        self.state = 0
        self._is_old = False
        self._wanted: AxisState | None = None
        self._control: OdriveControlMode | None = None  # as the axis has it
        self._input: tuple[OdriveControlMode, Frame] = (OdriveControlMode.TORQUE, torque(node, 0.0))
        self._asked_s = -math.inf
        self._bus = bus

    @property
    def is_known(self) -> bool:
        """Whether its state has come."""
        return self.errors is not None

    @property
    def is_driving(self) -> bool:
        """Whether it was in closed-loop control at its last heartbeat."""
        return self.state == AxisState.CLOSED_LOOP_CONTROL

    # ---- what is wanted

    def want_torque(self, torque_Nm: float) -> None:
        """Drive with a torque of the motor."""
        self._wanted = AxisState.CLOSED_LOOP_CONTROL
        self._input = (OdriveControlMode.TORQUE, torque(self.node, torque_Nm))

    def want_count(self, count: int, speed_count_s: float = 0.0) -> None:
        """Be at a count that moves at a speed, or hold it."""
        self._wanted = AxisState.CLOSED_LOOP_CONTROL
        turns, turns_s = count / self.counts_per_turn, speed_count_s / self.counts_per_turn
        self._input = (OdriveControlMode.POSITION, position(self.node, turns, turns_s))

    def want_idle(self) -> None:
        """Drive nothing: the motor is free."""
        self._wanted = AxisState.IDLE
        self._input = (OdriveControlMode.TORQUE, torque(self.node, 0.0))

    def want_nothing(self) -> None:
        """Send nothing: the axis goes on with what it does."""
        self._wanted = None

    def frames(self) -> list[Frame]:
        """The input, which feeds the axis's watchdog too; before it matters, what changes its meaning and the state."""
        if self._wanted is None:
            return []
        control, input_frame = self._input
        now_s = self._bus.clock.now_s()
        asks = self.state != self._wanted and now_s - self._asked_s > ASK_AGAIN_s
        frames = [input_frame]  # comes first: a new mode then never begins with an old input
        if self._control is not control or asks:
            frames.append(controller_mode(self.node, control))
            self._control = control
        if asks:
            frames.append(axis_state(self.node, self._wanted))
            self._asked_s = now_s
        return frames

    def send_now(self) -> None:
        """Send what is wanted before the cycle's end. Raises LinkLost."""
        for frame in self.frames():
            self._bus.send(frame)

    # ---- outside of the cycle

    def identify(self) -> None:
        """Check that it is of firmware 0.6 and sends what is needed. WrongIdentity; BoardSilent says what is missing.

        An error of its watchdog alone is cleared: without a host it had to expire.
        """
        self._is_old, end_s = False, self._bus.clock.now_s() + VERSION_WAIT_s
        self._bus.send(ask_sensorless_error(self.node))
        try:
            self.await_status()
        finally:  # with 0.5, the settings of what is missing have other names
            self._require_new_firmware(end_s)
        if self.errors == Error.WATCHDOG_TIMER_EXPIRED:
            self.clear_errors()

    def _require_new_firmware(self, until_s: float) -> None:
        if self._bus.waits(lambda: self._is_old, until_s - self._bus.clock.now_s()):
            raise WrongIdentity(
                f"{self.where}: expected firmware 0.6, it is 0.5, whose errors mean others: update it with odrivetool (an"
                " ODrive v3 has no 0.6, and is not driven)"
            )

    def await_status(self) -> None:
        """Wait for values that are sent from now on. BoardSilent."""
        asked_s = self._bus.clock.now_s()
        if not self._bus.waits(lambda: self.at_s > asked_s, STATUS_WAIT_s):
            missing = [command for command, at_s in self._at_s.items() if at_s <= asked_s]
            remedy = (
                f"set {', '.join(map(_SETTINGS.__getitem__, missing))} in axis0.config.can with odrivetool, and save it"
                if len(missing) < len(_SETTINGS)
                else f"check its supply, node id {self.node} and bit rate"
            )
            names = ", ".join(command.name for command in missing)
            raise BoardSilent(f"{self.where}: no {names} within {STATUS_WAIT_s} s: {remedy}")

    def await_count(self) -> None:
        """Wait for a count that is sent from now on; its other messages may be slower. BoardSilent."""
        asked_s = self._bus.clock.now_s()
        arrived_at_s = self._at_s
        if not self._bus.waits(
            lambda: arrived_at_s[OdriveCommand.ENCODER] > asked_s and self.counted.at_s > -math.inf, STATUS_WAIT_s
        ):
            self.await_status()

    def clear_errors(self) -> bool:
        """Forget errors whose cause is gone; whether there is none left. BoardSilent."""
        self._bus.send(clear_errors(self.node))
        self._bus.send(torque(self.node, 0.0))  # for its watchdog
        self.await_status()
        return not self.errors

    def limit(self, speed_turns_s: float, current_A: float) -> None:
        """Limit the motor's speed and current; nothing is stored. Raises LinkLost."""
        self._bus.send(limits(self.node, speed_turns_s, current_A))

    # ---- frames

    def take(self, command: int, payload: bytes, now_s: float) -> None:
        """Process a frame of this axis."""
        try:
            self._take(command, payload, now_s)
        except struct.error:
            self._bus.problems.append(
                ProtocolViolation(
                    f"{self.where}: command 0x{command:02X} with {len(payload)} bytes: check that its firmware is 0.6"
                )
            )

    def _take(self, command: int, payload: bytes, now_s: float) -> None:
        match command:
            case OdriveCommand.HEARTBEAT:
                self._follow(heartbeat(payload), now_s)
            case OdriveCommand.ENCODER:
                self._count(pair(payload)[0], now_s)
            case OdriveCommand.IQ:
                self.current_A = pair(payload)[1]
            case OdriveCommand.TEMPERATURE:
                self.temperature_degC = max(pair(payload))  # without a motor's thermistor, NaN is the second
            case OdriveCommand.SENSORLESS_ERROR:
                self._is_old |= is_sensorless_error(payload)
            case OdriveCommand.BUS:
                self.supply_V = pair(payload)[0]
        if command in self._at_s:
            self._at_s[OdriveCommand(command)] = now_s

    def _count(self, turns: float, now_s: float) -> None:
        if math.isfinite(turns):
            self.count = round(turns * self.counts_per_turn)
            self.counted.arrived(self._bus.drained_s, now_s)
        elif self.counted.at_s != -math.inf or not self._bus.problems:
            self.counted.forget()
            self._bus.problems.append(
                BoardFaulted(f"{self.where}: its encoder has no position (NaN): calibrate it with odrivetool")
            )

    def _follow(self, heartbeat: Heartbeat, now_s: float) -> None:
        was_driving, before_s = self.is_driving, self._at_s[OdriveCommand.HEARTBEAT]
        self.errors, self.state = heartbeat.errors & ~Error.INITIALIZING, heartbeat.state
        # An operation that ends by an error says so; one that ends without was ended by the host, or by a restart.
        is_unasked = self._wanted is AxisState.CLOSED_LOOP_CONTROL or now_s - before_s > GAP_s
        if Error.INITIALIZING in heartbeat.errors or (was_driving and not self.is_driving and not self.errors and is_unasked):
            self._restarted()
        elif self._asked_s >= before_s and heartbeat.result not in _GOES_ON:
            self._bus.problems.append(
                BoardRefused(
                    f"{self.where}: it does not go into closed-loop control (procedure result {heartbeat.result}): calibrate it"
                    " with odrivetool"
                )
            )

    def _restarted(self) -> None:
        """A restart leaves no error: the axis is idle, and nobody has asked for that."""
        self._control = None
        self._wanted, self._asked_s = AxisState.IDLE, -math.inf
        if math.isnan(self.supply_V):
            return
        self.resets += 1
        self.supply_V = math.nan
        self._bus.problems.append(BoardReset(f"{self.where}: restarted by itself; its motor is free: check its supply and cable"))
