"""All drills, by name. What each promises is what docs/safety.md says."""

from collections.abc import Callable, Iterator
from dataclasses import replace

from control.errors import ArmError
from procedures.drills.drill import Drill
from procedures.drills.promise import GOES_ON, Promise
from procedures.drills.realtime import GONE, RealTimeDrill
from procedures.drills.stage import MOVE, REST, Stage

SUFFIX = {REST: "rest", MOVE: "motion"}
MOTORS = ("motor1", "motor2", "motor3")
BRAKES = {
    "rest_mm": 80.0,
    "move_mm": 80.0,
}  # shorted windings let a stretched arm sink by as much in the two seconds
FALLS = {"rest_mm": 900.0, "move_mm": 900.0}  # an open circuit holds nothing: docs/motor_board.md, faults
LYING = frozenset({"encoder_contradicted", "encoders_differ"})
Inject = Callable[[Stage], None]


def _fault(kind: str, *boards: str, **keys: float) -> Inject:
    """An injector of one fault of the mock on some boards."""

    def inject(played: Stage) -> None:
        for board in boards:
            played.inject(kind, board, **keys)

    return inject


def _away(duration_s: float) -> Inject:
    return lambda played: played.away(duration_s)


def _stop(played: Stage) -> None:
    played.client.ask("stop")


def _serial_gone(played: Stage) -> None:
    played.rig.wires.serial[0].vanish()


def _bus_off(played: Stage) -> None:
    for board in MOTORS:
        played.inject("silent", board)
    played.rig.wires.bus_off()


def _stop_at(delay_s: float) -> Inject:
    def inject(played: Stage) -> None:
        played.run(delay_s)
        played.client.ask("stop")

    return inject


def _both(
    name: str,
    says: str,
    inject: Inject,
    codes: str,
    within_s: float = 0.3,
    rest_mm: float = 5.0,
    move_mm: float = 8.0,  # 20 ms on old counts at full speed, and the boards' stop
) -> Iterator[Drill]:
    """The same fault at rest and in motion."""
    found = frozenset(codes.split())
    for during, most_mm in ((REST, rest_mm), (MOVE, move_mm)):
        yield Drill(f"{name}-{SUFFIX[during]}", says, during, found, within_s, most_mm, inject)


def _frames() -> Iterator[Drill]:
    for board, name, of in (("encoder", "serial", "the encoder board"), ("motor2", "can", "motor board 2")):
        for kind, word, share in (
            ("drop_frames", "lost", 0.3),
            ("corrupt_frames", "corrupted", 0.3),
            ("duplicate_frames", "doubled", 0.05),
        ):
            if (board, kind) == ("motor2", "corrupt_frames"):
                continue  # CAN's own CRC: a board does not see them
            says = f"{share * 100:.0f} % of the frames of {of} {word}"
            yield from _both(f"{name}-{word}", says, _fault(kind, board, probability=share), "")
    yield from _both(
        "serial-late",
        "encoder reports 30 ms late",
        _fault("delay_frames", "encoder", value=0.03),
        "encoder_stale",
    )
    yield from _both(
        "can-late", "replies 30 ms late", _fault("delay_frames", "motor2", value=0.03), "drive_silent"
    )


def _boards() -> Iterator[Drill]:
    yield from _both(
        "encoder-reset", "encoder board restarts", _fault("board_reset", "encoder"), "link zero_lost"
    )
    yield from _both(
        "motor-reset", "motor board 2 restarts", _fault("board_reset", "motor2"), "link drive_left", **BRAKES
    )
    yield from _both(
        "encoder-silent", "encoder board unplugged", _fault("silent", "encoder"), "encoder_stale"
    )
    yield from _both("motor-silent", "motor board 2 unplugged", _fault("silent", "motor2"), "drive_silent")
    yield from _both("serial-gone", "serial port vanishes", _serial_gone, "link encoder_stale")
    yield from _both("bus-off", "CAN bus off", _bus_off, "link drive_silent")
    yield from _both(
        "encoder-wire",
        "encoder wire broken",
        _fault("lost_wire", "encoder", channel=1),
        "encoder_signal",
        **BRAKES,
    )


def _gripper() -> Iterator[Drill]:
    """With an object in the gripper."""
    gone, reset = _fault("silent", "motor4"), _fault("board_reset", "motor4")
    for drill in (
        *_both("gripper-silent", "gripper's board unplugged", gone, "gripper_silent"),
        *_both("gripper-reset", "gripper's board restarts", reset, "gripper_link"),
    ):
        yield replace(drill, has_gripper=True)


def _encoders() -> Iterator[Drill]:
    yield from _both("clock-frozen", "time stamps stand", _fault("frozen_clock", "encoder"), "encoder_stale")
    for rate in (2_000.0, 20_000.0):
        name, says = f"drift-{rate:.0f}", f"counts of joint 1 drift by {rate:,.0f} a second"
        inject = _fault("drifting_encoder", "encoder", channel=0, value=rate)
        yield from _both(name, says, inject, "encoder_contradicted encoders_differ index_off", 1.0, **BRAKES)
    inject = _fault("jumping_encoder", "encoder", channel=0, value=5_000.0)
    yield from _both("jump-5000", "5,000 counts gained at once", inject, "encoder_leap", **BRAKES)
    yield Drill("counts-stuck-motion", "counts of joint 1 stand", MOVE, LYING,
                0.3, BRAKES["move_mm"], _fault("stuck_encoder", "encoder", channel=0))  # fmt: skip
    yield Drill("backwards-motion", "joint 1 counts backwards", MOVE, LYING,
                0.3, BRAKES["move_mm"], _fault("backwards_encoder", "encoder", channel=0))  # fmt: skip


def _motors() -> Iterator[Drill]:
    yield Drill("stalled-motion", "motor 1 without current", MOVE, frozenset({"encoder_contradicted", "following_error"}),
                0.3, BRAKES["move_mm"], _fault("dead_motor", "motor1"))  # fmt: skip
    yield from _both("runaway", "polarity of motor 2 swapped", _fault("swapped_polarity", "motor2"),
                     "encoder_contradicted following_error", **BRAKES)  # fmt: skip
    trip = "motor board 2 trips"
    yield from _both(
        "over-current", f"{trip}: over-current", _fault("over_current", "motor2"), "drive_fault", **FALLS
    )
    inject = _fault("over_temperature", "motor2")
    yield from _both("over-temperature", f"{trip}: over-temperature", inject, "drive_fault", **BRAKES)
    yield from _both(
        "supply-drop",
        "supply falls to 5 V",
        _fault("supply", *MOTORS, value=5.0),
        "drive_fault supply",
        **BRAKES,
    )
    for kind, value, code in (
        ("says_supply", 0.0, "supply"), ("says_current", 32.7, "over_current"), ("says_temperature", 127.0, "over_temperature"),
    ):  # fmt: skip
        inject = _fault(kind, "motor2", value=value)
        says = f"motor board 2 {kind.replace('_', ' ')} {value:g}"
        yield from _both(kind.replace("_", "-"), says, inject, f"{code} encoder_contradicted", **BRAKES)


def _host() -> Iterator[Drill]:
    for pause_s in (0.05, 0.1, 0.17):
        yield from _both(
            f"pause-{pause_s * 1e3:.0f}", f"loop paused {pause_s * 1e3:.0f} ms", _away(pause_s), ""
        )
    yield from _both("killed", "loop killed, another 1.9 s later", _away(1.9), "drive_fault", 2.0)
    for delay_s in (0.0, 0.1, 0.3, 0.6):
        inject = _stop_at(delay_s)
        name, says = f"stop-{delay_s * 1e3:.0f}-motion", f"stop pressed {delay_s * 1e3:.0f} ms later"
        yield Drill(name, says, MOVE, GOES_ON, most_mm=2.0, inject=inject)


def _in_real_time() -> Iterator[RealTimeDrill]:
    gone = frozenset({GONE})
    yield RealTimeDrill("killed-realtime", "the loop's process killed", MOVE, gone, 1.0, 30.0)
    yield RealTimeDrill("paused-realtime", "the loop's process paused 100 ms", MOVE, GOES_ON, 1.0, 30.0, 0.1)


def drills() -> dict[str, Promise]:
    """Every drill, in the order of the table."""
    groups: tuple[Iterator[Promise], ...] = (
        _frames(), _boards(), _gripper(), _encoders(), _motors(), _host(), _in_real_time()
    )  # fmt: skip
    return {drill.name: drill for group in groups for drill in group}


def drill_named(name: str) -> Promise:
    """A drill by its name. ArmError lists the names."""
    known = drills()
    if name not in known:
        raise ArmError(f"no drill {name!r}: expected one of {', '.join(known)}")
    return known[name]
