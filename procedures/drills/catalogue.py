"""All drills by name, and what can be done to an arm on the stage: the mock's faults, a man in the middle on its wires, a
host that is away.
"""

import math
import random
import struct
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from difflib import get_close_matches
from typing import Any, NamedTuple
from unittest.mock import patch

import msgspec

from control.errors import ArmError
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm, LimitSwitches
from control.model.end_effector import Digital
from control.motion.plan import plan_path
from control.server.messages import asked
from firmware_iface.link import FrameLink
from firmware_iface.motor.wire import COMMAND_ID, SetpointMode
from hil_mocks.assembly import build_motor_board
from hil_mocks.wiring import wiring_of
from procedures.drills.boards import BoardsDrill
from procedures.drills.drill import GOES_ON, HOME, MOVE, PERIOD_S, REST, SESSION, Drill, Promise, Stage
from procedures.drills.files import GONE, DiskDrill, EmptiedDrill, FileDrill, LookedAtDrill, RealTimeDrill
from procedures.drills.pair import PairDrill
from procedures.drills.session import SessionDrill

Inject = Callable[[Stage], None]
MOTORS = ("motor1", "motor2", "motor3")
HOST_MOST_ID = 0x27F  # COMMAND 0x100, PARAMETER_REQUEST 0x200, emergency stop 0: docs/motor_board.md
ENABLE_OPERATION = 0x0F
PASSIVE_AFTER_S = 0.01  # of errors: a controller leaves the bus soon
SEED = 1
JOINT_COUNTS, SLIP_rad_s = 1 << 18, 0.1
GUEST = 1  # another connection than the drill's own
NAN = float("nan")
_VALUES: tuple[Any, ...] = (None, NAN, 1e308, -1e308, "0.1", True, [], {}, [[0.0]], 10**30)
NONSENSE: tuple[dict[str, Any], ...] = (
    *({"do": "move_joints", "q_rad": [value, 0.0, 0.0]} for value in _VALUES if value is not True),
    *({"do": "jog", "joint": value, "speed": 0.1} for value in _VALUES if value is not True),
    *({"do": "override", "fraction": value} for value in _VALUES),
    *({"do": "payload", "mass_kg": value} for value in _VALUES),
    {"do": "move_joints", "q_rad": [0.0, 0.0]},
    {"do": "move_joints", "q_rad": [9.0, 0.0, 0.0]},
    {"do": "run_path", "path": {"spline": 1}},
    {"do": "run_joints", "path": {}},
    {"do": "explode"},
)
COMMANDS: tuple[dict[str, Any], ...] = (
    {"do": "move_joints", "q_rad": [0.5, -0.3, 0.4]},
    {"do": "jog", "joint": 1, "speed": 0.1},
    {"do": "home", "again": True},
    {"do": "guide"},
    {"do": "override", "fraction": 0.5},
    {"do": "payload", "mass_kg": 1.0},
    {"do": "enable"},
    {"do": "resume"},
    {"do": "control", "take": True},
)
CONTRADICTING: tuple[dict[str, Any], ...] = (*COMMANDS[:4], {"do": "hold"})
MEETING: tuple[dict[str, Any], ...] = (
    {"do": "move_joints", "q_rad": [0.0, -1.9, -0.6]},  # the tip through the table
    {"do": "move_joints", "q_rad": [-0.8, -1.8, 0.2]},  # beside it, through the floor
    {"do": "move_joints", "q_rad": [2.5, -1.9, -1.1]},  # on the far side of the base
)
UNREACHABLE = ((2.0, 0.0, 0.5), (0.0, 0.0, 0.5), (0.0, 0.0, -0.5), (0.05, 0.0, 0.1))


def fault(kind: str, *boards: str, **keys: float) -> Inject:
    """A fault of docs/mock_robot.md on some boards."""

    def inject(played: Stage) -> None:
        for board in boards:
            played.inject(kind, board, **keys)

    return inject


def both(*injects: Inject) -> Inject:
    """Several at once."""

    def inject(played: Stage) -> None:
        for one in injects:
            one(played)

    return inject


def away(duration_s: float) -> Inject:
    """The loop is paused, or dead and another one looks later."""
    return lambda played: played.away(duration_s)


def stop_at(delay_s: float) -> Inject:
    """Somebody presses stop."""

    def inject(played: Stage) -> None:
        played.run(delay_s)
        played.client.ask("stop")

    return inject


def brake(played: Stage) -> None:
    """Somebody has the arm braked."""
    played.client.ask("brake")


def payload(mass_kg: float) -> Inject:
    """A mass at the tip that the runtime is not told of."""

    def inject(played: Stage) -> None:
        played.rig.set_payload(mass_kg)
        played.undo.callback(played.rig.set_payload, 0.0)

    return inject


def let_go(mass_kg: float) -> Inject:
    """The drives carry the arm for a hand that guides it, but not this mass at its tip."""

    def inject(played: Stage) -> None:
        payload(mass_kg)(played)
        played.client.guide(weightless=True)

    return inject


def serial_gone(played: Stage) -> None:
    """The serial port vanishes."""
    played.rig.wires.serial[0].vanish()


def bus_off(played: Stage) -> None:
    """The host's CAN controller leaves the bus."""
    for board in MOTORS:
        played.inject("silent", board)
    played.rig.wires.bus_off()


def serial_noise(most_bytes: int) -> Inject:
    """Bursts of noise between the frames of the encoder board."""

    def inject(played: Stage) -> None:
        source = random.Random(SEED)
        wire = played.rig.wires.serial[0]
        played.each_cycle.append(lambda: wire.write(source.randbytes(source.randrange(most_bytes))))

    return inject


def can_flood(frames_a_cycle: int) -> Inject:
    """Frames of other devices on the bus: any id that no board of ours listens to or sends."""

    def inject(played: Stage) -> None:
        source, guest = random.Random(SEED), _guest(played)

        def send() -> None:
            for _ in range(frames_a_cycle):
                guest.send(source.randrange(0x400, 0x800), source.randbytes(8))  # above those of digital pins

        played.each_cycle.append(send)

    return inject


def can_full(played: Stage) -> None:
    """No frame of the host gets onto the bus."""
    played.undo.enter_context(played.rig.wires.full_bus())


def wrong_bit_rate(played: Stage) -> None:
    """A device at another bit rate is plugged in: nothing but errors, until the controllers leave the bus."""
    for board in MOTORS:
        played.inject("silent", board)
    wires, begun_s = played.rig.wires, played.now_s

    def errors() -> None:
        if played.now_s - begun_s < PASSIVE_AFTER_S:
            wires.bit_error()
        else:
            wires.bus_off()

    played.each_cycle.append(errors)


def second_board(joint: int) -> Inject:
    """A board fresh from its box, with the node id of another one, is plugged in."""

    def inject(played: Stage) -> None:
        guest, wired = _guest(played), wiring_of(played.arm, played.rig.scenario)[joint]
        board = build_motor_board(wired, played.rig.scenario, lambda: 0)

        def answer() -> None:
            board.tick(played.now_s, 0.0, 24.0, False)
            for can_id, payload in guest.receive():
                if can_id & 0xF == wired.motor_node and can_id <= HOST_MOST_ID:
                    for reply_id, reply in board.receive(can_id, payload, played.now_s):
                        guest.send(reply_id, reply)

        played.each_cycle.append(answer)

    return inject


def another_host(node: int, volts: float) -> Inject:
    """Another program commands a board, cycle after cycle."""
    command = struct.pack("<BBih", ENABLE_OPERATION, SetpointMode.VOLTAGE, round(volts * 1e3), 0)

    def inject(played: Stage) -> None:
        guest = _guest(played)
        played.each_cycle.append(lambda: guest.send(COMMAND_ID + node, command))

    return inject


def clock_stepped(step_s: float) -> Inject:
    """The time of day is set, by hand or by the network."""

    def inject(played: Stage) -> None:
        was_s = time.time
        played.undo.enter_context(patch.object(time, "time", lambda: was_s() + step_s))

    return inject


def refused(requests: Sequence[dict[str, Any]], client: int | None = None) -> Inject:
    """Requests that must all be refused; one that is served is a fault of its own."""

    def inject(played: Stage) -> None:
        for request in requests:
            if client is None:
                answer = played.request(request)
            else:
                answer = played.assembly.requests.handle(asked(msgspec.json.encode(request)), client)
            if answer["ok"]:
                played.found = (*played.found, f"served: {request}")
            played.run(PERIOD_S)

    return inject


def unplanned(goals: Sequence[Sequence[float]]) -> Inject:
    """Tip goals, by a straight line, that no plan may reach."""

    def inject(played: Stage) -> None:
        q_rad = played.client.status()["joint_rad"]
        start = ForwardKinematics(played.arm).tip(*q_rad)
        for goal in goals:
            with suppress(ArmError):
                plan_path(played.arm, [start, goal], 0.2, q_near_rad=q_rad)
                played.found = (*played.found, f"planned: {goal}")

    return inject


def _guest(played: Stage) -> FrameLink:
    """Another device on the bus."""
    guest = played.rig.wires.guest()
    played.undo.callback(guest.close)
    return guest


# All drills, by name. docs/drills.md has what each measured, docs/safety.md what is promised.


SUFFIX = {REST: "rest", MOVE: "motion", HOME: "homing", SESSION: "session"}


class Most(NamedTuple):
    """The largest distance from the asked path, at rest, in motion and in a session."""

    rest_mm: float
    move_mm: float
    session_mm: float


# 20 ms on old counts at full speed, and the boards' stop. In a session the fault comes shortly before the end of a motion: the
# boards do not know that end.
HOLDS = Most(5.0, 8.0, 15.0)
BRAKES = Most(80.0, 80.0, 80.0)  # shorted windings let a stretched arm sink by as much in the two seconds
YIELDS = Most(60.0, 60.0, 60.0)  # a motion that is held back: what the other joints have done by then
FALLS = Most(900.0, 900.0, 900.0)  # an open circuit holds nothing: docs/motor_board.md, faults
RELEASED_mm = 120.0  # while it measures, a hand holds the tip of an arm whose drives are off; let go, it sinks
LYING = "encoder_contradicted"
ALSO_MEASURING = frozenset({"serial-gone", "motor-silent", "encoder-reset", "jump-5000", "pause-100", "killed"})
RESISTED = "unexplained_torque following_error"


def _each(
    name: str,
    says: str,
    inject: Inject,
    codes: str,
    most: Most = HOLDS,
    during: tuple[str, ...] = (REST, MOVE, SESSION),
    **promised: Any,
) -> Iterator[Promise]:
    """The same fault at rest, in motion and in a session; `promised`: what else the drills are told."""
    expected = frozenset(codes.split())
    promised |= {"says": says, "codes": expected, "inject": inject}
    for moment in during:
        most_mm = {REST: most.rest_mm, SESSION: most.session_mm}.get(moment, most.move_mm)
        full = f"{name}-{SUFFIX[moment]}"
        if moment != SESSION:
            yield Drill(full, during=moment, most_mm=most_mm, **promised)
            continue
        yield SessionDrill(full, during=moment, most_mm=most_mm, **promised)
        if name in ALSO_MEASURING:
            most_mm = max(most_mm, RELEASED_mm) if expected else most_mm
            yield SessionDrill(f"{name}-measuring", during="measuring", most_mm=most_mm, while_measuring=True, **promised)


def _frames() -> Iterator[Promise]:
    for board, name, of in (("encoder", "serial", "the encoder board"), ("motor2", "can", "motor board 2")):
        for kind, word, share, value in (
            ("drop_frames", "lost", 0.3, {}),
            ("corrupt_frames", "corrupted", 0.3, {}),
            ("duplicate_frames", "doubled", 0.05, {}),
            ("delay_frames", "reordered", 0.1, {"value": 0.003}),  # later than the next ones
            ("replay_frames", "replayed", 0.05, {"value": 0.1}),
        ):
            if (board, kind) == ("motor2", "corrupt_frames"):
                continue  # CAN's own CRC: a board does not see them
            says = f"{share * 100:.0f} % of the frames of {of} {word}"
            yield from _each(f"{name}-{word}", says, fault(kind, board, probability=share, **value), "")
    yield from _each("serial-late", "encoder reports 30 ms late", fault("delay_frames", "encoder", value=0.03), "encoder_stale")
    yield from _each("can-late", "replies 30 ms late", fault("delay_frames", "motor2", value=0.03), "drive_silent")
    yield from _each("serial-noise", "noise between the encoder's frames", serial_noise(40), "")
    yield from _each("can-flood", "20 foreign frames a cycle", can_flood(20), "")


def _buses() -> Iterator[Promise]:
    yield from _each("serial-gone", "serial port vanishes", serial_gone, "link")
    yield from _each("bus-off", "CAN bus off", bus_off, "link")
    yield from _each("bus-full", "CAN transmit buffer full", can_full, "link")
    yield from _each("bit-rate", "a device at a wrong bit rate on the bus", wrong_bit_rate, "link")
    yield from _each("same-id", "another board with the id of motor board 2", second_board(1), "link", BRAKES)
    says = "another program commands 6 V to motor board 2"
    yield from _each("another-host", says, another_host(2, 6.0), "link", BRAKES, (REST, MOVE))


def _boards() -> Iterator[Promise]:
    every = (REST, MOVE, HOME, SESSION)
    yield from _each("encoder-reset", "encoder board restarts", fault("board_reset", "encoder"), "link", during=every)
    yield from _each("motor-reset", "motor board 2 restarts", fault("board_reset", "motor2"), "drive_left", most=BRAKES)
    yield from _each("encoder-silent", "encoder board unplugged", fault("silent", "encoder"), "encoder_stale", during=every)
    yield from _each("motor-silent", "motor board 2 unplugged", fault("silent", "motor2"), "drive_silent", during=every)
    for board, most in (("encoder", HOLDS), ("motor2", BRAKES)):
        swapped = both(fault("board_reset", board), fault("wrong_identity", board, value=4711))
        name, says = f"{board.rstrip('2')}-swapped", f"another {board.rstrip('2')} board is plugged in"
        yield from _each(name, says, swapped, "link", most, (REST, MOVE), is_refused=True)
    wire = fault("lost_wire", "encoder", channel=1)
    yield from _each("encoder-wire", "encoder wire broken", wire, "encoder_signal", most=BRAKES)
    skipped = fault("quadrature_error", "encoder", channel=1)
    yield from _each("miscount", "an illegal step of encoder 2", skipped, "encoder_miscount", most=BRAKES)


def _gripper() -> Iterator[Promise]:
    """With an object in the gripper."""
    for name, says, kind, code in (
        ("silent", "gripper's board unplugged", "silent", "gripper_silent"),
        ("reset", "gripper's board restarts", "board_reset", "gripper_link"),
        ("over-current", "gripper's board trips", "over_current", "gripper_drive"),
    ):
        yield from _each(f"gripper-{name}", says, fault(kind, "motor4"), code, during=(REST, MOVE), has_gripper=True)


def _encoders() -> Iterator[Promise]:
    yield from _each("clock-frozen", "time stamps stand", fault("frozen_clock", "encoder"), "encoder_stale")
    for rate in (2_000.0, 20_000.0):
        name, says = f"drift-{rate:.0f}", f"counts of joint 1 drift by {rate:,.0f} a second"
        inject = fault("drifting_encoder", "encoder", channel=0, value=rate)
        yield from _each(name, says, inject, "encoder_contradicted encoders_differ index_off", BRAKES, within_s=1.0)
    for counts, code in ((400.0, "overspeed"), (5_000.0, "encoder_leap")):
        inject = fault("jumping_encoder", "encoder", channel=0, value=counts)
        yield from _each(f"jump-{counts:.0f}", f"{counts:,.0f} counts gained at once", inject, code, most=BRAKES)
    moving = (MOVE, SESSION)
    inject = fault("slipped_encoder", "encoder", channel=0, value=5_000.0)
    says = "encoder 1 slips on its shaft by 5,000 counts, with its index"
    yield from _each("slip-5000", says, inject, "encoder_leap", most=BRAKES, during=(REST, MOVE))
    inject = fault("stuck_encoder", "encoder", channel=0)
    # at the slow beginning of a move the boards' counts part first
    says, either = "counts of joint 1 stand", f"{LYING} encoders_differ"
    yield from _each("counts-stuck", says, inject, either, most=BRAKES, during=moving)
    inject = fault("backwards_encoder", "encoder", channel=0)
    yield from _each("backwards", "joint 1 counts backwards", inject, LYING, most=BRAKES, during=moving)
    yield Drill("wrap-motion", "the counter of joint 1 wraps in its travel (16 bits)", MOVE, GOES_ON, most_mm=3.0, arm=_narrow)
    says, inject = "encoder board with 16-bit counters unplugged for 2 s", fault("silent", "encoder")
    yield from _each("unseen", says, inject, "encoder_stale", during=(MOVE,), arm=_narrow)


def _two_encoders() -> Iterator[Promise]:
    """Joint 1 has an encoder on the joint and one on its motor."""
    slips = fault("drifting_encoder", "encoder", channel=0, value=SLIP_rad_s * JOINT_COUNTS / math.tau)
    stands = fault("stuck_encoder", "motor1")
    says = f"the encoder on joint 1 slips by {SLIP_rad_s:g} rad/s, too slowly for other checks"
    yield from _each(
        "joint-encoder-slips", says, slips, "encoders_differ", BRAKES, (REST, MOVE), within_s=0.8, arm=_on_both_sides
    )
    says = "counts of motor 1 stand, those on the joint do not"
    yield from _each("motor-encoder-stuck", says, stands, "encoders_differ", BRAKES, (MOVE,), arm=_on_both_sides)


def _on_both_sides(arm: Arm) -> Arm:
    """The arm with an encoder of 18 bits on joint 1, beside the one of its motor."""
    first = arm.drives[0]
    both_sides = replace(
        first, encoder_on="joint", encoder_counts_per_rev=JOINT_COUNTS, motor_counts_per_rev=first.encoder_counts_per_rev
    )
    return replace(arm, drives=(both_sides, *arm.drives[1:]))


def _limit_switches() -> Iterator[Promise]:
    """Joint 1 has a limit switch at each end; one that is met in the middle of its range is seen best."""
    for name, says, pin in (
        ("limit-switch", "the limit switch ahead of joint 1 is met, or its wire breaks", "high"),
        ("limit-switch-crossed", "the same, wired to the other end", "low"),
    ):
        most = Most(2.0, 2.0, 2.0)
        yield from _each(name, says, _pressed(pin), "limit_switch", most, (MOVE,), arm=_with_limit_switches)


def _with_limit_switches(arm: Arm) -> Arm:
    pins = (Digital("low", 1, 2, "input"), Digital("high", 1, 3, "input"))
    switched = replace(arm.drives[0], limit_switches=LimitSwitches(lower="low", upper="high"))
    return replace(arm, digital=pins, drives=(switched, *arm.drives[1:]))


def _pressed(pin: str) -> Inject:
    def inject(played: Stage) -> None:
        played.rig.set_pin(pin, True)
        played.undo.callback(played.rig.set_pin, pin, False)

    return inject


def _narrow(arm: Arm) -> Arm:
    """The arm with counters of 16 bits; that of joint 1 wraps at 0.08 rad."""
    narrow = [replace(drive, encoder_bits=16) for drive in arm.drives]
    return replace(arm, drives=(replace(narrow[0], zero_count=30_000), *narrow[1:]))


def _motors() -> Iterator[Promise]:
    yield from _each("stalled", "motor 1 without current", fault("dead_motor", "motor1"), LYING, BRAKES, (MOVE, SESSION))
    yield from _each("runaway", "polarity of motor 2 swapped", fault("swapped_polarity", "motor2"), LYING, most=BRAKES)
    says, jammed = "the gear of joint 1 jams", fault("stuck_joint", "motor1")
    yield from _each("jammed", says, jammed, RESISTED, most=YIELDS, during=(MOVE, HOME, SESSION))
    says = "3 kg of unstated payload at the tip"
    yield from _each("payload", says, payload(3.0), "unexplained_torque", most=YIELDS)
    inject = fault("over_current", "motor2")
    # Not in a session: the mock has no table, through which the arm would fall.
    yield from _each("over-current", "motor board 2 trips: over-current", inject, "drive_fault", most=FALLS, during=(REST, MOVE))
    inject = fault("over_temperature", "motor2")
    every = (REST, MOVE, HOME, SESSION)
    yield from _each("over-temperature", "motor board 2 trips: over-temperature", inject, "drive_fault", BRAKES, every)
    inject = fault("supply", *MOTORS, value=5.0)
    yield from _each("supply-drop", "supply falls to 5 V", inject, "drive_fault supply", most=BRAKES)
    for kind, value, code in (
        ("says_supply", 0.0, "supply"),
        ("says_current", 32.7, LYING),
        ("says_temperature", 127.0, "over_temperature"),
    ):
        says = f"motor board 2 {kind.replace('_', ' ')} {value:g}"
        inject = fault(kind, "motor2", value=value)
        yield from _each(kind.replace("_", "-"), says, inject, code, most=BRAKES)


def _host() -> Iterator[Promise]:
    for pause_s in (0.02, 0.05, 0.1, 0.17, 0.19):
        says = f"loop paused {pause_s * 1e3:.0f} ms"
        codes = "loop_late" if pause_s > 0.18 else ""
        yield from _each(f"pause-{pause_s * 1e3:.0f}", says, away(pause_s), codes)
    killed = away(1.9)
    yield from _each("killed", "loop killed, another 1.9 s later", killed, "drive_fault", within_s=2.0)
    for step_s in (-3600.0, 3600.0):
        name = "clock-back" if step_s < 0.0 else "clock-ahead"
        says = f"time of day stepped by {step_s / 3600.0:+.0f} h"
        yield from _each(name, says, clock_stepped(step_s), "")
    for delay_s in (0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7):
        name, says = f"stop-{delay_s * 1e3:.0f}-motion", f"stop pressed {delay_s * 1e3:.0f} ms later"
        yield Drill(name, says, MOVE, GOES_ON, most_mm=2.0, inject=stop_at(delay_s))
    yield from _each("brake", "brake pressed", brake, "brake", most=BRAKES, during=(MOVE, HOME))
    says = "guided by hand with gravity compensation and 1.5 kg of unstated payload, and let go"
    yield from _each("guided-payload", says, let_go(1.5), "guided_too_fast", FALLS, (REST,), within_s=0.5)
    yield Drill("stop-homing", "stop pressed while homing", HOME, GOES_ON, most_mm=2.0, inject=stop_at(0.2))


def _requests() -> Iterator[Promise]:
    every = (REST, MOVE, HOME)
    yield from _each("nonsense", "40 requests with wrong types, NaN, values out of range", refused(NONSENSE), "", during=every)
    yield from _each("contradiction", "requests that do not fit what goes on", refused(CONTRADICTING), "", during=(MOVE, HOME))
    yield from _each("two-clients", "a second client commands", refused(COMMANDS, GUEST), "", during=(MOVE, HOME))
    says = "moves that would meet the table, the floor or the base"
    yield from _each("table-in-the-way", says, refused(MEETING), "", during=(REST,))
    yield from _each("singularity", "lines out of reach, and through a singularity", unplanned(UNREACHABLE), "", during=(REST,))


def _in_real_time() -> Iterator[Promise]:
    gone = frozenset({GONE})
    yield RealTimeDrill("killed-realtime", "the loop's process killed", MOVE, gone, 1.0, 30.0)
    yield RealTimeDrill("paused-realtime", "the loop's process paused 100 ms", MOVE, GOES_ON, 1.0, 30.0, 0.1)
    says = "another program opens its ports and its bus"
    yield LookedAtDrill("looked-at-realtime", says, MOVE, GOES_ON, 1.0, 30.0, 0.0)
    says = "another program empties the recording"
    yield EmptiedDrill("emptied-realtime", says, MOVE, GOES_ON, 1.0, 30.0, 0.0)
    yield DiskDrill("disk-full-realtime", "no room for the recording", MOVE, GOES_ON, 1.0, 30.0, speed=0.3)


def drills() -> dict[str, Promise]:
    """Every drill, in the order of the table."""
    groups: tuple[Iterator[Promise], ...] = (
        _frames(),
        _buses(),
        _boards(),
        _gripper(),
        _encoders(),
        _two_encoders(),
        _limit_switches(),
        _motors(),
        _host(),
        _requests(),
        _in_real_time(),
        BoardsDrill.all(),
        PairDrill.all(),
        iter(FileDrill.all()),
    )
    return {drill.name: drill for group in groups for drill in group}


def drills_named(name: str) -> list[Promise]:
    """The drill of this name, or all whose names begin with it, as `encoder-silent` of `encoder-silent-rest`.

    ArmError gives the nearest names, and the command that lists all.
    """
    known = drills()
    named = [drill for full, drill in known.items() if f"{full}-".startswith(f"{name}-")]
    if not named:
        near = get_close_matches(name, known, n=5, cutoff=0.4)
        meant = f": did you mean {' or '.join(near)}?" if near else ";"
        raise ArmError(f"no drill {name!r}{meant} `armwright drill --list` lists all {len(known)}")
    return named
