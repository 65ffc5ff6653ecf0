"""ODrives on a CAN bus, seen from the host: they send what they measure unasked; commands are not answered."""

import math
import struct
from typing import Final

from firmware_iface.errors import BoardFaulted, BoardRefused, BoardReset, BoardSilent, ProtocolViolation, WrongIdentity
from firmware_iface.node_bus import NodeBus, UnaskedBoard
from firmware_iface.odrive import wire
from firmware_iface.odrive.wire import AxisState, Error, Frame, OdriveCommand, OdriveControlMode

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

    make, numbered, numbers = "ODrive", "node id", wire.NODES

    def __init__(self, bus: OdriveBus, node: int, name: str, counts_per_turn: int) -> None:
        """`counts_per_turn`: the position comes as turns, and is made counts of so many a turn."""
        super().__init__(bus, node, name, _SETTINGS)
        self.node, self.counts_per_turn = node, counts_per_turn
        self.errors: Error | None = None
        self.state = 0
        self._is_old = False
        self._wanted: AxisState | None = None
        self._control: OdriveControlMode | None = None  # as the axis has it
        self._input: tuple[OdriveControlMode, Frame] = (OdriveControlMode.TORQUE, wire.torque(node, 0.0))
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
        self._input = (OdriveControlMode.TORQUE, wire.torque(self.node, torque_Nm))

    def want_count(self, count: int, speed_count_s: float = 0.0) -> None:
        """Be at a count that moves at a speed, or hold it."""
        self._wanted = AxisState.CLOSED_LOOP_CONTROL
        turns, turns_s = count / self.counts_per_turn, speed_count_s / self.counts_per_turn
        self._input = (OdriveControlMode.POSITION, wire.position(self.node, turns, turns_s))

    def want_idle(self) -> None:
        """Drive nothing: the motor is free."""
        self._wanted = AxisState.IDLE
        self._input = (OdriveControlMode.TORQUE, wire.torque(self.node, 0.0))

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
            frames.append(wire.controller_mode(self.node, control))
            self._control = control
        if asks:
            frames.append(wire.axis_state(self.node, self._wanted))
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
        self._bus.send(wire.ask_sensorless_error(self.node))
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
        self._bus.send(wire.clear_errors(self.node))
        self._bus.send(wire.torque(self.node, 0.0))  # for its watchdog
        self.await_status()
        return not self.errors

    def limit(self, speed_turns_s: float, current_A: float) -> None:
        """Limit the motor's speed and current; nothing is stored. Raises LinkLost."""
        self._bus.send(wire.limits(self.node, speed_turns_s, current_A))

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
                self._follow(wire.heartbeat(payload), now_s)
            case OdriveCommand.ENCODER:
                self._count(wire.pair(payload)[0], now_s)
            case OdriveCommand.IQ:
                self.current_A = wire.pair(payload)[1]
            case OdriveCommand.TEMPERATURE:
                self.temperature_degC = max(wire.pair(payload))  # without a motor's thermistor, NaN is the second
            case OdriveCommand.SENSORLESS_ERROR:
                self._is_old |= wire.is_sensorless_error(payload)
            case OdriveCommand.BUS:
                self.supply_V = wire.pair(payload)[0]
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

    def _follow(self, heartbeat: wire.Heartbeat, now_s: float) -> None:
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
