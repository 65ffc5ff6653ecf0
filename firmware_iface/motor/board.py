"""One DC-motor board on a CAN bus, seen from the host. docs/motor_board.md defines the protocol."""

import contextlib
import math
import struct
from dataclasses import dataclass

from firmware_iface.errors import (
    BoardFaulted,
    BoardRefused,
    BoardReset,
    BoardSilent,
    LinkError,
    MisuseError,
    ProtocolViolation,
    WrongIdentity,
)
from firmware_iface.motor import wire
from firmware_iface.motor.bus import ANSWER_TIMEOUT_s, MotorBus, ParameterChannel
from firmware_iface.motor.cia402 import STATE_OF_STATUSWORD, DriveCommand, DriveState, next_command
from firmware_iface.motor.wire import SEQUENCE_MASK, DigitalCommand, DigitalReply, MotorParameter, SetpointMode

_STEP_s = 0.001
_RESEND_s = 0.02  # a COMMAND without REPLY for this long is sent again during state changes
_SECOND_REPLIES = 3  # CAN may duplicate a frame now and then, but not three times in a row
_OFF_STATES = (DriveState.NOT_READY_TO_SWITCH_ON, DriveState.SWITCH_ON_DISABLED)
_KEEPS_OFF = (DriveCommand.DISABLE_VOLTAGE, DriveCommand.QUICK_STOP, DriveCommand.FAULT_RESET)


@dataclass(frozen=True, slots=True)
class MotorIdentity:
    """Identity of a motor board; `encoder_counts_per_turn` of its motor, after quadrature decoding."""

    protocol: int
    serial_number: int
    firmware: int
    encoder_counts_per_turn: int


class MotorBoard:
    """Sends COMMANDs and keeps the latest REPLY; `MotorBus.update()` delivers the replies.

    `command…()` sends one frame and returns. The other requests wait for answers through the clock;
    use them before and after a run only.
    """

    def __init__(self, bus: MotorBus, node: int, name: str = "", problems: list[LinkError] | None = None) -> None:
        """`problems`: where restarts and violations of this board go, if not to those that `MotorBus.update` raises."""
        self._problems = bus.problems if problems is None else problems
        self.node = node
        self.name = name or f"motor{node}"
        self.reply: wire.Reply | None = None
        self.reply_at_s = -math.inf
        self.identity: MotorIdentity | None = None
        self.replies = 0
        self.resets = 0
        self._bus = bus
        self._sequence = 0
        self._commands_sent = 0
        self._answered = 0  # of them: the number of the one that the latest reply answers
        self._last = (0, 0)  # mode and set-point of the last COMMAND
        self._sent_at_s = -math.inf
        self._command_id = wire.COMMAND_ID + node
        self._controlword = int(DriveCommand.DISABLE_VOLTAGE)
        self.state: DriveState | None = None
        """In the latest reply; None before the first, and after a reset."""
        self._holds_alone = True  # without a host, by its watchdog's action, unless it was found to do something else
        self._is_as_found = True  # no state was commanded since it was connected
        self._order = ReplyOrder()
        self._parameters = ParameterChannel(bus, node, lambda: self.where)
        bus.add_node(node, self._take_reply, self._take_answer)
        bus.keepers.append(self._keep)

    @property
    def where(self) -> str:
        """Name in messages: `motor board "motor1" (node 1) on socketcan:can0`."""
        return f'motor board "{self.name}" (node {self.node}) on {self._bus.name}'

    @property
    def has_torque(self) -> bool:
        """Whether it is in operation, or holds by itself after its watchdog has expired."""
        if self.state is DriveState.FAULT and self.reply is not None:
            return self._holds_alone and self.reply.faults == wire.MotorFault.WATCHDOG
        return self.state is DriveState.OPERATION_ENABLED

    @property
    def reply_lag(self) -> int:
        """Number of COMMANDs sent since the one answered by the latest reply; 0: the newest was answered.

        Counted when the reply comes: the 5-bit sequence alone repeats, and a silent board would seem to answer again.
        """
        return self._commands_sent - self._answered if self.reply else self._commands_sent

    @property
    def lost(self) -> int:
        """Number of COMMANDs without a REPLY."""
        return self._order.lost

    @property
    def stale(self) -> int:
        """Number of REPLYs dropped: late, duplicated, or to another host's COMMAND."""
        return self._order.stale

    def require_fresh(self, now_s: float, limit_s: float) -> None:
        """Raises BoardSilent if the latest reply came more than `limit_s` ago."""
        if now_s - self.reply_at_s > limit_s:
            age = f"for {now_s - self.reply_at_s:.3f} s" if self.reply else "yet"
            raise BoardSilent(f"{self.where}: no reply {age} (limit {limit_s:.3f} s)")

    def command(self, mode: int, setpoint_raw: int = 0, feedforward_mV: int = 0) -> None:
        """Send one COMMAND with the controlword of the current target state. Raises MisuseError, LinkLost."""
        sequence = (self._sequence + 1) & wire.SEQUENCE_MASK
        try:
            payload = wire.pack_raw_command(self._controlword, mode | sequence << 3, setpoint_raw, feedforward_mV)
        except struct.error as problem:
            raise MisuseError(
                f"{self.where}: cannot send mode {mode}, set-point {setpoint_raw}, feed-forward {feedforward_mV} mV: {problem}"
            ) from None
        self._bus.link.send(self._command_id, payload)
        self._sequence, self._last = sequence, (mode, setpoint_raw)
        self._commands_sent += 1

    def command_off(self) -> None:
        """Command open circuit: the motor turns freely."""
        self.command(0)

    def command_voltage(self, voltage_V: float) -> None:
        """Command a terminal voltage; 0 shorts the windings and brakes."""
        self.command(1, self._milli(voltage_V))

    def command_current(self, current_A: float) -> None:
        """Command a motor current, controlled by the board."""
        self.command(2, self._milli(current_A))

    def command_position(self, count: int, feedforward_V: float = 0.0) -> None:
        """Command a position in counts of the board's own encoder, and a voltage added to its PID output."""
        self.command(3, count, self._milli(feedforward_V))

    def command_hold(self) -> None:
        """Command the board to come to rest and hold, by its own encoder."""
        self.command(4)

    def ask_state(self) -> None:
        """Ask for a REPLY, and change nothing: a board in operation stops and holds, every other one stays out of operation."""
        before = self._controlword
        is_between = self.state in (DriveState.READY_TO_SWITCH_ON, DriveState.SWITCHED_ON)
        self._controlword = int(DriveCommand.DISABLE_VOLTAGE if is_between else DriveCommand.ENABLE_OPERATION)
        self.command(SetpointMode.HOLD)
        self._controlword = before

    def find_state(self) -> None:
        """Wait for what the board does now, which is not changed. BoardSilent."""
        deadline_s = self._bus.clock.now_s() + 3.0 * ANSWER_TIMEOUT_s
        while self.reply is None:
            if self._is_due():
                self._sent_at_s = self._bus.clock.now_s()
                self.ask_state()
            self._wait_step(deadline_s, "does not reply to COMMAND")
        if self.state is DriveState.FAULT and self.reply.faults == wire.MotorFault.WATCHDOG:
            self._holds_alone = self.read(MotorParameter.WATCHDOG_ACTION) == wire.IdleOutput.HOLD

    def _keep(self) -> None:
        """While the loop waits for another board: brake or turn freely as before, else hold."""
        if self.state is DriveState.OPERATION_ENABLED and self._is_as_found:
            with contextlib.suppress(LinkError):
                self.ask_state()
        elif self.state is DriveState.OPERATION_ENABLED:
            with contextlib.suppress(LinkError):
                self.command(self._last[0] if self._last in ((0, 0), (1, 0)) else 4)

    def ask_count(self) -> None:
        """Ask for the count of the board's own encoder without waiting; see `count_taken`."""
        self._parameters.begin_read(MotorParameter.POSITION_COUNT)

    def count_taken(self) -> int | None:
        """The count that `ask_count` asked for, once it has come; None before, and after a restart of the board."""
        return self._parameters.taken(MotorParameter.POSITION_COUNT)

    def _milli(self, quantity: float) -> int:
        try:
            return round(quantity * 1e3)
        except (ValueError, OverflowError):
            raise MisuseError(f"{self.where}: a set-point must be finite, got {quantity}") from None

    def go_to(self, state: DriveState, timeout_s: float = 0.5) -> None:
        """Change to `state`; OPERATION ENABLED is entered at 0 V, so the motor brakes.

        Raises BoardFaulted from FAULT (see acknowledge_fault), BoardSilent, MisuseError if unreachable.
        """
        deadline_s = self._bus.clock.now_s() + timeout_s
        while not self.step_towards(state):
            self._wait_step(deadline_s, f"does not reach {state.value}, stays in {self._state_name()}")

    def step_towards(self, state: DriveState) -> bool:
        """One step of `go_to` without waiting: send the command that is due; True once a reply confirms the state.

        To change several boards together, call this for each, then `MotorBus.update()`.
        """
        if state in (DriveState.NOT_READY_TO_SWITCH_ON, DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE):
            raise MisuseError(f"{self.where}: no command leads to {state.value}")
        now = self.state
        if now in (DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE) and self.reply is not None:
            raise BoardFaulted(
                f"{self.where}: in FAULT ({self._fault_names()}): remove the cause, acknowledge the fault, "
                f"then go to {state.value}"
            )
        if now is state and self._is_answered():
            return True
        if now is not None and now is not state and now is not DriveState.NOT_READY_TO_SWITCH_ON:
            self._step_from(now, state)
        elif self._is_due():
            self._send_walking(self._controlword)
        return False

    def _step_from(self, now: DriveState, state: DriveState) -> None:
        command = next_command(now, state)
        if command is None:
            raise MisuseError(f"{self.where}: no transition from {now.value} to {state.value}")
        if self._is_answered() or self._is_due():
            self._send_walking(command)

    def _send_walking(self, controlword: int) -> None:
        self._controlword, self._is_as_found = controlword, False
        self._sent_at_s = self._bus.clock.now_s()
        self.command(SetpointMode.VOLTAGE)

    def _is_answered(self) -> bool:
        return self.reply is not None and self._commands_sent > 0 and self.reply_lag == 0

    def _is_due(self) -> bool:
        return self._bus.clock.now_s() - self._sent_at_s >= _RESEND_s

    def acknowledge_fault(self, timeout_s: float = 0.2) -> None:
        """Reset a fault by a rising edge of controlword bit 7; ends in SWITCH ON DISABLED.

        Call this only on a person's request. Without a fault the board answers, and stays as it is.
        Raises BoardFaulted if the cause persists.
        """
        deadline_s = self._bus.clock.now_s() + timeout_s
        if self.state is DriveState.OPERATION_ENABLED and self._is_as_found:
            return
        if self.state is DriveState.OPERATION_ENABLED:
            self._send_and_wait(self._controlword, deadline_s)
            if self.state is DriveState.OPERATION_ENABLED:
                return
        while True:
            # 0 first, so that there is an edge whatever was sent before
            self._send_and_wait(DriveCommand.DISABLE_VOLTAGE, deadline_s)
            if self.state not in (DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE):
                return
            if self._bus.clock.now_s() >= deadline_s:
                raise BoardFaulted(f"{self.where}: its fault ({self._fault_names()}) cannot be acknowledged: the cause persists")
            self._send_and_wait(DriveCommand.FAULT_RESET, deadline_s)

    def step_fault_reset(self) -> bool:
        """One step of `acknowledge_fault` without waiting; True once no reply says FAULT. LinkLost."""
        if self.state not in (DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE):
            return True
        if self._is_answered() or self._is_due():
            was_reset = self._controlword == DriveCommand.FAULT_RESET
            self._send_walking(DriveCommand.DISABLE_VOLTAGE if was_reset else DriveCommand.FAULT_RESET)
        return False

    def _send_and_wait(self, controlword: int, deadline_s: float) -> None:
        self._send_walking(controlword)
        while True:
            self._wait_step(deadline_s + ANSWER_TIMEOUT_s, "does not reply to COMMAND")
            if self._is_answered():
                return
            if self._is_due():
                self._send_walking(controlword)

    def _wait_step(self, deadline_s: float, what: str) -> None:
        now_s = self._bus.clock.now_s()
        if now_s >= deadline_s:
            raise BoardSilent(f"{self.where}: {what}; check its supply, wiring and node id")
        self._bus.wait(now_s + _STEP_s)

    def _state_name(self) -> str:
        return self.state.value if self.state else "an unknown state"

    def _fault_names(self) -> str:
        faults = self.reply.fault_flags if self.reply else wire.MotorFault(0)
        return ", ".join(str(fault.name).replace("_", " ").lower() for fault in faults) or "no bit set"

    def identify(self, serial_number: int | None = None) -> MotorIdentity:
        """Request the identity. Raises WrongIdentity for another protocol version or (if given) serial number,
        ProtocolViolation if two boards answer as this node.
        """
        self.identity = None
        protocol = self.read(MotorParameter.PROTOCOL_VERSION)
        if protocol != wire.PROTOCOL_VERSION:
            raise WrongIdentity(
                f"{self.where}: speaks protocol version {protocol}, expected {wire.PROTOCOL_VERSION}; "
                "update the board's firmware or this program"
            )
        actual_number = self.read(MotorParameter.BOARD_SERIAL_NUMBER) & 0xFFFFFFFF
        self._parameters.require_single_board(MotorParameter.BOARD_SERIAL_NUMBER)
        if serial_number is not None and actual_number != serial_number:
            raise WrongIdentity(
                f"{self.where}: expected the board with serial number {serial_number}, found {actual_number}; "
                "check for swapped boards or node ids"
            )
        firmware = self.read(MotorParameter.FIRMWARE_VERSION)
        counts = self.read(MotorParameter.ENCODER_COUNTS_PER_TURN)
        self.identity = MotorIdentity(protocol, actual_number, firmware, counts)
        return self.identity

    def read(self, index: int) -> int:
        """Read the raw value of parameter `index`. Raises RequestRefused, BoardSilent."""
        return self._parameters.read(index)

    def write(self, index: int, value: int) -> None:
        """Set parameter `index` to the raw `value`, not while enabled. Raises RequestRefused, BoardSilent."""
        self._parameters.write(index, value)

    # Frames delivered by the bus

    def _take_reply(self, payload: bytes, now_s: float) -> None:
        if len(payload) != 8:
            self._violation("sent a REPLY that is not 8 bytes long", payload)
            return
        reply = wire.unpack_reply(payload)
        if not self._order.is_newer(reply.sequence, self._sequence, self._commands_sent):
            if self._order.doubled == _SECOND_REPLIES:
                self._violation("answers each COMMAND twice: check for two boards with this node id", payload)
            return
        state = STATE_OF_STATUSWORD[reply.statusword]
        if state is None:
            self._violation(f"sent a statusword of an unknown state ({reply.statusword:#04x})", payload)
            return
        self.reply = reply
        self._answered = self._commands_sent - ((self._sequence - reply.sequence) & wire.SEQUENCE_MASK)
        self.reply_at_s = now_s
        self.replies += 1
        if state is not self.state:
            self._take_state(state)

    def _take_state(self, state: DriveState) -> None:
        before, self.state = self.state, state
        # Only a command leads to this state; without one, it is a restart whose start-up message was lost.
        if state in _OFF_STATES and before not in (None, *_OFF_STATES) and self._controlword not in _KEEPS_OFF:
            self._was_reset()

    def _take_answer(self, payload: bytes, now_s: float) -> None:
        if len(payload) != 8:
            self._violation("sent a PARAMETER_ANSWER that is not 8 bytes long", payload)
            return
        answer = wire.ParameterAnswer.unpack(payload)
        if answer.sequence != 0:
            self._parameters.take(answer)
        elif self.identity is not None or self.reply is not None:
            self._was_reset()

    def _was_reset(self) -> None:
        self.resets += 1
        self.reply, self.reply_at_s, self.state = None, -math.inf, None
        self._order.forget()
        self._controlword = int(DriveCommand.DISABLE_VOLTAGE)
        self._problems.append(
            BoardReset(
                f"{self.where}: restarted by itself; it is off, and its gains, limits and count are lost: "
                "check its supply, then connect again"
            )
        )

    def _violation(self, what: str, received: bytes) -> None:
        self._problems.append(ProtocolViolation(f"{self.where}: {what}", received))


# Assigns each REPLY to its COMMAND by the 5-bit echoed sequence.
_LATEST_LAG = 16  # half of the 5-bit sequence: an older reply is ambiguous


class ReplyOrder:
    """Distinguishes new replies from late, duplicated and foreign ones, and counts missing ones."""

    def __init__(self) -> None:
        self.lost = 0
        self.stale = 0
        self.doubled = 0
        """Duplicate replies since the last COMMAND that was answered exactly once."""
        self._last: int | None = None
        self._was_doubled = False

    def forget(self) -> None:
        """Reset after a restart of the board."""
        self._last = None

    def is_newer(self, echoed: int, last_sent: int, commands_sent: int) -> bool:
        """Whether a reply answers a newer COMMAND than the latest one answered."""
        lag = (last_sent - echoed) & SEQUENCE_MASK
        if lag >= commands_sent or lag >= _LATEST_LAG:
            self.stale += 1  # to a previous host, or from before a pause
            return False
        step = 1 if self._last is None else (echoed - self._last) & SEQUENCE_MASK
        if step == 0:
            self.stale += 1
            self.doubled += 1
            self._was_doubled = True
            return False
        if step >= _LATEST_LAG:
            self.stale += 1
            return False
        if not self._was_doubled:
            self.doubled = 0
        self._was_doubled = False
        self._last = echoed
        self.lost += step - 1
        return True


class DigitalPins:
    """Asks for levels and sets outputs; the bus delivers the replies. `reply` is the last one, None before the first."""

    def __init__(self, bus: MotorBus, board: MotorBoard) -> None:
        self.board = board
        self.reply: DigitalReply | None = None
        self.reply_at_s = -math.inf
        self._bus = bus
        self._sequence = 0
        bus.add_digital(board.node, self._take)

    def require(self, count: int) -> None:
        """WrongIdentity unless the board has at least `count` pins; BoardSilent if it does not answer."""
        try:
            pins = self.board.read(MotorParameter.DIGITAL_PINS)
        except BoardRefused:
            raise WrongIdentity(
                f"{self.board.where}: has no digital pins, or a firmware that does not know them (parameter 48): remove its"
                " [[digital]] from arm.toml, or update it"
            ) from None
        if pins < count:
            raise WrongIdentity(
                f"{self.board.where}: has {pins} digital pins, 0 to {pins - 1}, but arm.toml names pin {count - 1}"
            )

    def configure(self, outputs: int, safe_levels: int, safe_keep: int) -> None:
        """Write which pins are outputs, and what they do while the drive is not enabled; not while it is enabled."""
        self.board.write(MotorParameter.DIGITAL_SAFE_LEVELS, safe_levels)
        self.board.write(MotorParameter.DIGITAL_SAFE_KEEP, safe_keep)
        self.board.write(MotorParameter.DIGITAL_OUTPUTS, outputs)

    def command(self, mask: int, levels: int) -> None:
        """Set the outputs of `mask` and ask for all pins; does not wait. LinkLost."""
        self._sequence = (self._sequence + 1) & 0xFF
        payload = DigitalCommand(self._sequence, mask, levels).pack()
        self._bus.link.send(wire.DIGITAL_COMMAND_ID + self.board.node, payload)

    def _take(self, payload: bytes, now_s: float) -> None:
        if len(payload) != 8:
            problem = f"{self.board.where}: sent a DIGITAL_REPLY that is not 8 bytes long"
            self._bus.problems.append(ProtocolViolation(problem, payload))
            return
        reply = DigitalReply.unpack(payload)
        if reply.sequence == self._sequence:  # an older one says less than what is under way
            self.reply, self.reply_at_s = reply, now_s
