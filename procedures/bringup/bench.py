"""The boards of an unknown arm: one motor is driven at a time, all encoders are read, and every cycle is monitored.

The limits of current and voltage are written to the motor board before it is enabled, so they hold whatever this program
does; the board's watchdog brakes when this program stops sending. All other motors stay off, with shorted windings.
"""

import argparse
import contextlib
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from control.errors import ArmError
from control.hardware.connect import link_options, with_links
from control.hardware.interface import HOME_SWITCH, NamedPins
from control.hardware.reference_boards import start_stream
from control.model.arm import Arm
from control.model.description import load_arm
from control.model.drive import Unwrapper
from firmware_iface.can_link import open_can
from firmware_iface.clock import Clock, MonotonicClock
from firmware_iface.encoder.board import EncoderBoard
from firmware_iface.errors import LinkError, MisuseError, connect_all
from firmware_iface.link import Closing
from firmware_iface.motor.board import DigitalPins, MotorBoard
from firmware_iface.motor.bus import MotorBus
from firmware_iface.motor.cia402 import DriveState
from firmware_iface.motor.wire import IdleOutput, MotorParameter
from firmware_iface.serial_link import open_serial
from procedures.bringup import workbench

if TYPE_CHECKING:
    from hil_mocks.rig import SteppedRig


PERIOD_S = 0.004
ASKED_EVERY_S = 0.02  # levels of limit switches
CURRENT_MARGIN = 1.3  # of the limit that the board enforces; more means that it does not
CURRENT_MARGIN_A = 0.2  # noise of the current measurement
SETTLING_CYCLES = 3  # until the speeds have settled
SPEED_FILTER_S = 0.004
JUMP_SHARE = 0.6  # of the allowed speed: a slower joint cannot exceed the limit within one cycle


class ReferenceBench(Closing):
    """The open reference boards; meets `procedures.bringup.workbench.Workbench`.

    `driving` enables one motor; within it, `cycle` sends a voltage and waits for the replies.
    """

    look_s = 0.0
    has_index = True
    has_volts = limits_current = True

    def __init__(self, arm: Arm, clock: Clock, operator: workbench.BringupOperator) -> None:
        self.clock = clock
        self.operator = operator
        self.latest: workbench.Sample | None = None
        self.before: workbench.Sample | None = None
        self._arm = arm
        self._closers: list[Callable[[], None]] = []
        try:
            self.encoders, self.motors, self._bus = self._opened(arm)
        except BaseException:
            self.close()
            raise
        self._pins = self._switch_pins(arm)
        self._asked_at_s = -math.inf
        self._driven: MotorBoard | None = None
        self._limits = workbench.DriveLimits(0.0, 0.0)
        self._origin: dict[workbench.Channel, int] = {}
        self._unwrappers: dict[workbench.Channel, Unwrapper] = {}
        self._speeds: dict[workbench.Channel, float] = {}
        self._last_t_s: dict[int, float] = {}
        self._deadline_s = clock.now_s()

    def _opened(self, arm: Arm) -> tuple[tuple[EncoderBoard, ...], dict[int, MotorBoard], MotorBus]:
        can = arm.can
        if can is None or not arm.encoder_boards:
            raise ArmError(
                f"arm {arm.name}: its ports are not set: add [[encoder_board]] and [can], or give --encoder and --can-..."
            )
        link = open_can(can.interface, can.channel, can.bitrate, **can.options)
        self._closers.append(link.close)
        bus = MotorBus(link, self.clock)
        nodes = sorted({drive.motor_node for drive in arm.drives})
        motors = {node: MotorBoard(bus, node) for node in nodes}
        steps: list[Callable[[], object]] = [motor.identify for motor in motors.values()]
        encoders: list[EncoderBoard] = []
        for port in arm.encoder_boards:
            serial = open_serial(port.port, port.baud)
            self._closers.append(serial.close)
            encoders.append(EncoderBoard(serial, self.clock, port.name))
            steps.append(encoders[-1].identify)
        connect_all(steps)
        for encoder in encoders:
            start_stream(encoder, PERIOD_S)
        return tuple(encoders), motors, bus

    def _switch_pins(self, arm: Arm) -> NamedPins | None:
        """The inputs of limit switches; None where there are none."""
        switches = [drive.limit_switches for drive in arm.drives if drive.limit_switches]
        named = {name for switch in switches for name in (switch.lower, switch.upper)}
        inputs = [pin for pin in arm.digital if pin.name in named and pin.board in self.motors]
        boards = {pin.board: DigitalPins(self._bus, self.motors[pin.board]) for pin in inputs}
        for node, pins in boards.items():
            pins.require(1 + max(pin.pin for pin in inputs if pin.board == node))
        return NamedPins(inputs, boards) if inputs else None

    def _levels(self) -> dict[str, bool | None]:
        """Levels of the limit switches, which are asked for now and then."""
        if self._pins is None:
            return {}
        now_s = self.clock.now_s()
        if now_s - self._asked_at_s >= ASKED_EVERY_S:
            self._asked_at_s = now_s
            self._pins.command({})
        return self._pins.levels(now_s)

    def prepare(self) -> None:
        """Nothing: boards that do not drive short their windings."""

    def channels(self) -> list[workbench.Channel]:
        """All channels of all encoder boards."""
        return [
            (board, channel)
            for board, encoder in enumerate(self.encoders)
            for channel in range(encoder.identity.channels if encoder.identity else 0)
        ]

    @contextlib.contextmanager
    def driving(self, node: int, limits: workbench.DriveLimits) -> Iterator[None]:
        """Enable one motor board at 0 V under these limits; on every exit, it is braked and switched off."""
        motor = self.motors[node]
        self._set_up(motor, limits)
        try:
            motor.go_to(DriveState.OPERATION_ENABLED)
            self._driven, self._limits, self._origin = motor, limits, {}
            self._deadline_s = self.clock.now_s()
            for _ in range(SETTLING_CYCLES):
                self.cycle(0.0)
            self._origin = dict(self._newest().counts)
            yield
        finally:
            self._driven = None
            self._switch_off(motor)

    def _set_up(self, motor: MotorBoard, limits: workbench.DriveLimits) -> None:
        motor.acknowledge_fault()  # the operator has just allowed the motion
        motor.go_to(DriveState.SWITCH_ON_DISABLED)
        for index, value in (
            (MotorParameter.WATCHDOG_ms, round(self._arm.limits.watchdog_s * 1e3)),
            (MotorParameter.WATCHDOG_ACTION, IdleOutput.BRAKE),
            (MotorParameter.STOP_AFTER_ms, 0),  # a PID on an encoder whose sign is not known yet would run away
            (MotorParameter.DISABLED_OUTPUT, IdleOutput.BRAKE),
            (MotorParameter.VOLTAGE_LIMIT_mV, round(limits.voltage_V * 1e3)),
            (MotorParameter.CURRENT_LIMIT_mA, max(1, round(limits.current_A * 1e3))),
        ):
            motor.write(index, value)

    def _switch_off(self, motor: MotorBoard) -> None:
        """0 V at once, then off; if the bus fails, all drives are stopped."""
        try:
            motor.command_voltage(0.0)
            with contextlib.suppress(LinkError):
                self._bus.update()
            if motor.state is not DriveState.FAULT:
                motor.go_to(DriveState.SWITCH_ON_DISABLED)
        except LinkError:
            with contextlib.suppress(LinkError):
                self._bus.emergency_stop(1)
            raise

    def cycle(self, volts: float) -> workbench.Sample:
        """Send a voltage (board's sign), wait for the next cycle, read all boards. Raises SafetyTrip or Stopped."""
        motor, limits = self._driven, self._limits
        if motor is None:
            raise MisuseError("bring-up: a voltage was commanded while no motor is driven")
        volts = min(max(volts, -limits.voltage_V), limits.voltage_V)
        motor.command_voltage(volts)
        self._deadline_s = max(self._deadline_s + PERIOD_S, self.clock.now_s())
        self.clock.wait_until_s(self._deadline_s)
        for encoder in self.encoders:
            encoder.update()
        self._bus.update()
        sample = self._sampled(motor, volts)
        self._watch(motor, sample)
        if self.operator.wants_stop():
            raise workbench.Stopped("stopped by the operator")
        return sample

    def observe(self, duration_s: float) -> workbench.Sample:
        """Read all boards for a while with all drives off."""
        end_s = self.clock.now_s() + duration_s
        while self.clock.now_s() < end_s:
            self.clock.wait_until_s(self.clock.now_s() + PERIOD_S)
            for encoder in self.encoders:
                encoder.update()
            self._bus.update()
            if all(encoder.latest for encoder in self.encoders):
                self._sampled(None, 0.0)
        return self._newest()

    def _newest(self) -> workbench.Sample:
        if self.latest is None:
            raise workbench.SafetyTrip("encoder boards: no report received; run `armwright doctor`")
        return self.latest

    def _sampled(self, motor: MotorBoard | None, volts: float) -> workbench.Sample:
        counts: dict[workbench.Channel, int] = {}
        flags: dict[workbench.Channel, int] = {}
        for board, encoder in enumerate(self.encoders):
            report = encoder.latest
            if report is None or encoder.identity is None:
                raise workbench.SafetyTrip(f"{encoder.where}: no report received; run `armwright doctor`")
            span_s = encoder.board_time_s - self._last_t_s.get(board, -math.inf)
            for channel in range(encoder.identity.channels):
                at = (board, channel)
                if at not in self._unwrappers:
                    self._unwrappers[at] = Unwrapper(encoder.identity.encoder_bits, report.counts[channel])
                before = self._unwrappers[at].unwrapped_count
                counts[at] = self._unwrappers[at].update(report.counts[channel])
                flags[at] = report.flags[channel]
                self._follow_speed(at, counts[at] - before, span_s)
            self._last_t_s[board] = encoder.board_time_s
        current_A = motor.reply.current_A if motor is not None and motor.reply is not None else 0.0
        is_limited = motor is not None and motor.reply is not None and motor.reply.is_limited
        time_s = self.encoders[0].board_time_s
        self.before = self.latest
        levels = self._levels()
        limits = {drive.joint: workbench.limits_of(drive, levels) for drive in self._arm.drives}
        for drive in self._arm.drives:
            if drive.home is not None and limits[drive.joint] & workbench.HOMED_ON.get(drive.home.switch, 0):
                flags[workbench.channel_of(drive)] |= HOME_SWITCH
        self.latest = workbench.Sample(time_s, counts, flags, dict(self._speeds), volts, current_A, is_limited, limits)
        return self.latest

    def _follow_speed(self, at: workbench.Channel, step: int, span_s: float) -> None:
        if span_s == 0.0:
            return
        speed = self._speeds.get(at, 0.0)
        wanted = step / span_s if math.isfinite(span_s) else 0.0
        self._speeds[at] = speed + span_s / (span_s + SPEED_FILTER_S) * (wanted - speed) if span_s < 1.0 else wanted

    def _watch(self, motor: MotorBoard, sample: workbench.Sample) -> None:
        now_s, limits = self.clock.now_s(), self._limits
        stale_s = self._arm.limits.stale_s
        for encoder in self.encoders:
            encoder.require_fresh(now_s, stale_s)
        motor.require_fresh(now_s, stale_s)
        if motor.state is not DriveState.OPERATION_ENABLED or motor.reply is None:
            raise workbench.SafetyTrip(
                f"{motor.where}: left the state OPERATION ENABLED without a command ({_fault_names(motor)}); run"
                " `armwright doctor`"
            )
        if abs(sample.current_A) > CURRENT_MARGIN * limits.current_A + CURRENT_MARGIN_A:
            raise workbench.SafetyTrip(
                f"{motor.where}: {sample.current_A:+.2f} A measured, limit {limits.current_A:.2f} A: the board does"
                " not enforce its current limit; do not use it"
            )
        for at, origin in self._origin.items():
            speed, travel = abs(sample.speed_count_s[at]), abs(sample.counts[at] - origin)
            if speed > limits.speed_count_s:
                raise workbench.SafetyTrip(self._too_fast(at, sample, limits))
            if travel > limits.travel_count:
                raise workbench.SafetyTrip(
                    f"encoder channel {at[1]} of board {at[0]} moved {travel} counts, limit"
                    f" {limits.travel_count:.0f}: the drive was switched off; check for an obstacle, and that the"
                    " other joints are supported"
                )

    def _too_fast(self, at: workbench.Channel, sample: workbench.Sample, limits: workbench.DriveLimits) -> str:
        """A motor accelerates gradually; a count that jumps within one cycle is not motion."""
        before = self.before
        channel = f"encoder channel {at[1]} of board {at[0]}"
        if before is not None and abs(before.speed_count_s[at]) < JUMP_SHARE * limits.speed_count_s:
            return (
                f"LOOSE ENCODER: {channel} jumped by {sample.counts[at] - before.counts[at]:+d} counts within"
                f" {1e3 * PERIOD_S:.0f} ms, faster than the motor can turn: tighten the encoder on its shaft, then"
                " check its cable"
            )
        return (
            f"{channel} RAN AWAY at {abs(sample.speed_count_s[at]):.0f} counts/s, limit {limits.speed_count_s:.0f}:"
            " the drive was switched off; check gear and encoder against the draft, and the load"
        )

    def index_latch(self, at: workbench.Channel) -> int | None:
        """The unwrapped count that the index latched since `arm_index`, or None."""
        latch = self.encoders[at[0]].index_latch(at[1])
        if latch is None:
            return None
        present = self._unwrappers[at].unwrapped_count
        identity = self.encoders[at[0]].identity
        half = 1 << (identity.encoder_bits - 1 if identity else 31)
        return present + ((latch - present + half & 2 * half - 1) - half)

    def arm_index(self, at: workbench.Channel) -> None:
        """Arm the index latch."""
        self.encoders[at[0]].arm_index(at[1])
        self._deadline_s = self.clock.now_s()

    def motor_count(self, node: int) -> int:
        """The motor board's own count of its encoder; counts up with positive voltage if both are wired correctly."""
        return self.motors[node].read(MotorParameter.POSITION_COUNT)

    def counts_per_turn(self, at: workbench.Channel) -> int | None:
        """What the encoder's board says of it."""
        identity = self.encoders[at[0]].identity
        return identity.counts_per_turn[at[1]] if identity else None

    def serials(self) -> dict[int, int]:
        """Serial numbers of the motor boards, by node."""
        return {node: motor.identity.serial_number for node, motor in self.motors.items() if motor.identity}

    def close(self) -> None:
        """Stop the streams and close all links."""
        for encoder in getattr(self, "encoders", ()):
            with contextlib.suppress(LinkError):
                encoder.stream(0.0)
        for close in self._closers:
            close()


def _fault_names(motor: MotorBoard) -> str:
    flags = motor.reply.fault_flags if motor.reply else ()
    return ", ".join(str(flag.name).lower().replace("_", " ") for flag in flags) or "no fault bit"


@dataclass(frozen=True, slots=True)
class Setting:
    """An arm with its ports, the clock, and the mock behind the ports (None with real boards)."""

    draft: Arm
    """The arm as in its file."""
    arm: Arm
    """The arm with the links of the command line or the mock."""
    clock: Clock
    rig: "SteppedRig | None" = None


@contextmanager
def open_bench(
    arm: Arm, clock: Clock, operator: workbench.BringupOperator, currents_A: Mapping[int, float]
) -> Iterator[workbench.Workbench]:
    """The boards of an arm, whose drives get at most `currents_A` by joint. ArmError where not all are of one sort."""
    bought = [drive.board for drive in arm.drives if drive.board]
    if bought and len(bought) < len(arm.drives):
        raise ArmError(
            f"arm {arm.name}: bring-up takes reference motor boards or [[board]]s, not both: bring up two drafts, each with the"
            " joints of one sort"
        )
    if bought:
        from procedures.bringup.bought_bench import BoughtBench

        with BoughtBench(arm, clock, operator, currents_A) as boards:
            yield boards
        return
    with ReferenceBench(arm, clock, operator) as bench:
        yield bench


@contextmanager
def opened(args: argparse.Namespace) -> Iterator[Setting]:
    """Open the arm of the command line. ArmError if options contradict each other."""
    draft = load_arm(args.arm)
    if not args.mock:
        for name in ("scenario", "mock_arm"):
            if getattr(args, name) is not None:
                raise ArmError(f"--{name.replace('_', '-')} needs --mock")
        yield Setting(draft, with_links(draft, link_options(args)), MonotonicClock())
        return
    if args.encoder or args.can_interface or args.can_channel:
        raise ArmError("--mock brings its own links: omit --encoder and --can-...")
    from hil_mocks.rig import SteppedRig
    from procedures.mock import wired_to

    built = load_arm(args.mock_arm) if args.mock_arm else draft
    with SteppedRig(built, args.scenario or "demo") as rig:
        yield Setting(draft, wired_to(draft, rig), rig.clock, rig)
