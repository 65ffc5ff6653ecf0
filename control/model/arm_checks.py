"""Consistency checks between the values of an arm.toml; each error names the key."""

import math
import re
from collections.abc import Hashable, Iterable, Sequence

from control.model.arm import ENCODER_CHANNELS, Arm, Board, Drive, Effect, Home, Table
from control.model.board_kinds import KINDS, BoardKind, bus_conflict
from control.model.drive import OWN_INPUT, SERVOS, JointMap
from control.model.effects import EFFECTS, EffectKind, parameter_names
from control.model.end_effector import CameraStream, Gripper
from control.model.maps import check_map
from control.model.plausible import check_plausible
from control.model.reader import Rejected
from control.model.tolerances import check_tolerances, spreads

LONGEST_JOG_SILENCE_S = 0.5
DIGITAL_MOST = 32
Named = tuple[tuple[str | int, ...], Hashable]


def check_arm(arm: Arm) -> None:
    """Raise Rejected for the first inconsistency."""
    if not arm.links:
        raise Rejected(("link",), "at least one [[link]]", "none")
    if arm.joint_count == 0:
        raise Rejected(("link",), 'at least one link with joint = "revolute"', "only fixed ones")
    _check_names(arm)
    _check_masses(arm)
    for index, drive in enumerate(arm.drives):
        _check_drive(arm, drive, index)
    _check_wiring(arm)
    _check_boards(arm)
    _check_end(arm)
    _check_limit_switches(arm)
    _check_rest(arm)
    _check_recording(arm)
    if arm.limits.jog_silence_s > LONGEST_JOG_SILENCE_S:
        expected = f"at most {LONGEST_JOG_SILENCE_S} s (a dead man's switch)"
        raise Rejected(("limits", "jog_silence_s"), expected, str(arm.limits.jog_silence_s))
    if arm.table is not None:
        _check_table(arm.table)
    if arm.camera is not None and arm.camera.stream is not None:
        _check_stream(arm.camera.stream)
    _check_effects(arm)
    _check_maps(arm)
    _check_tolerances(arm)
    check_plausible(arm)


def _check_stream(stream: CameraStream) -> None:
    path = ("camera", "stream")
    if not stream.body:
        raise Rejected((*path, "body"), "the name of a body", "an empty one")
    if stream.body == stream.base_body:
        raise Rejected((*path, "base_body"), "another body than `body`", f'"{stream.base_body}"')
    if stream.system != "vicon" and not stream.host:
        raise Rejected((*path, "host"), f"the computer that {stream.system} streams from: name or address", "none")


def _check_names(arm: Arm) -> None:
    """Other programs address joints and links by name."""
    for key in ("joint_name", "link_name"):
        seen: set[str] = set()
        for index, link in enumerate(arm.links):
            name = getattr(link, key)
            if key == "joint_name" and name and link.joint == "fixed":
                raise Rejected(("link", index, key), 'a name only where joint = "revolute"', f'"{name}"')
            if name in seen:
                raise Rejected(("link", index, key), "another name for every row", f'"{name}" again')
            seen |= {name} - {""}


def _check_masses(arm: Arm) -> None:
    for index, link in enumerate(arm.links):
        moments = link.inertia_kg_m2
        if moments is not None and 2 * max(moments) > sum(moments) * (1 + 1e-9):
            raise Rejected(
                ("link", index, "inertia_kg_m2"),
                "principal moments of which none exceeds the sum of the others",
                str(list(moments)),
                "these are physically impossible",
            )


def _check_drive(arm: Arm, drive: Drive, index: int) -> None:
    path = ("drive", index)
    if drive.joint > arm.joint_count:
        raise Rejected((*path, "joint"), f"a revolute joint from 1 to {arm.joint_count}", str(drive.joint))
    if not drive.joint_lower_rad < drive.joint_upper_rad:
        got = f"{drive.joint_upper_rad} (joint_lower_rad is {drive.joint_lower_rad})"
        raise Rejected((*path, "joint_upper_rad"), "more than joint_lower_rad", got)
    if drive.home is not None and drive.home.switch == "own":  # a limit switch is at the end of the range, or beyond
        for key, angle in (("switch_rad", drive.home.switch_rad), ("index_rad", drive.home.index_rad)):
            if not drive.joint_lower_rad <= angle <= drive.joint_upper_rad:
                expected = f"an angle within the joint's limits, {drive.joint_lower_rad} to {drive.joint_upper_rad} rad"
                raise Rejected((*path, "home", key), expected, str(angle))
    if drive.home is not None:
        _check_home_count(drive, drive.home, path)
    if drive.motor_counts_per_rev is not None and (drive.encoder_on == "motor" or drive.board):
        expected = 'none: it is of a second encoder at a reference motor board, beside encoder_on = "joint"'
        raise Rejected((*path, "motor_counts_per_rev"), expected, str(drive.motor_counts_per_rev))
    if drive.pid.mode == "position" and not drive.board and drive.at_motor.encoder_on == "joint":
        expected = "motor_counts_per_rev: in position mode the motor board closes its loop on an encoder on the motor"
        raise Rejected((*path, "pid", "mode"), expected, 'encoder_on = "joint" alone')
    if drive.encoder_channel >= ENCODER_CHANNELS:
        raise Rejected((*path, "encoder_channel"), "0, 1 or 2", str(drive.encoder_channel))


def _check_home_count(drive: Drive, home: Home, path: tuple[str | int, ...]) -> None:
    """Homing sets the counter to what it is at the index pulse, and takes the counter at its word from there on."""
    count, half = JointMap(drive).count(home.index_rad), 1 << (drive.encoder_bits - 1)
    settled = 2 * drive.encoder_counts_per_rev  # the joint comes to rest within two turns of the encoder
    if abs(count) + settled > half:
        expected = f"a counter that holds {count} +- {settled} counts, of the index pulse at index_rad"
        remedy = "set zero_count so that the joint's count at index_rad is small"
        raise Rejected((*path, "encoder_bits"), expected, f"{drive.encoder_bits} (+-{half})", remedy)


def _check_wiring(arm: Arm) -> None:
    drives = list(enumerate(arm.drives))
    _check_unique(((("drive", i, "joint"), drive.joint) for i, drive in drives), "one [[drive]] per joint")
    _check_unique(
        ((("drive", i, "motor_node"), drive.motor_node) for i, drive in drives if not drive.board), "one joint per motor node"
    )
    _check_unique(
        (
            (("drive", i, "encoder_channel"), (drive.encoder_board, drive.encoder_channel))
            for i, drive in drives
            if drive.encoder_board >= 0
        ),
        "one joint per encoder channel (board, channel)",
    )
    boards = len(arm.encoder_boards)
    _check_unique(
        ((("encoder_board", i, "name"), board.name) for i, board in enumerate(arm.encoder_boards)),
        "a unique name for every encoder board",
    )
    for i, drive in drives:
        if boards and drive.encoder_board >= boards:
            expected = f"an encoder board below {boards}, the number of [[encoder_board]] here"
            raise Rejected(("drive", i, "encoder_board"), expected, str(drive.encoder_board))


def _check_boards(arm: Arm) -> None:
    """The [[board]]s, and what drives say of them."""
    boards = list(enumerate(arm.boards))
    _check_unique(((("board", i, "name"), board.name) for i, board in boards), "a unique name for every board")
    for i, board in boards:
        kind = KINDS[board.kind]
        if board.address not in kind.addresses:
            expected = f"{kind.addresses.start} to {kind.addresses.stop - 1} for kind {board.kind}"
            raise Rejected(("board", i, "address"), expected, str(board.address))
        if board.absolute and not (kind.may_be_absolute or kind.is_absolute):
            kinds = ", ".join(name for name, one in KINDS.items() if one.may_be_absolute)
            raise Rejected(("board", i, "absolute"), f"true only for {kinds}", f"true for a {board.kind}")
        if board.absolute_turns is not None and not board.absolute:
            expected = "absolute = true beside it: it says over how many turns the encoder is"
            raise Rejected(("board", i, "absolute_turns"), expected, f"{board.absolute_turns:g} alone")
    _check_lines(boards)
    drives = [(i, drive) for i, drive in enumerate(arm.drives) if drive.board]
    for i, drive in drives:
        _check_drive_board(arm, drive, ("drive", i))
    _check_unique(
        ((("drive", i, "board_channel"), (drive.board, drive.board_channel)) for i, drive in drives),
        "one joint per motor of a board (board, channel)",
    )
    on_arm = {board.kind for board in arm.boards} | ({""} if len(drives) < len(arm.drives) else set())
    conflict = bus_conflict(on_arm)
    if conflict is not None:
        raise Rejected(("board",), conflict, "both")
    _check_in_use(arm, boards)


def _check_in_use(arm: Arm, boards: Sequence[tuple[int, Board]]) -> None:
    """A board that nothing names is one whose joint was forgotten, or whose name was mistyped."""
    used = {drive.board for drive in arm.drives} | {arm.gripper.board if arm.gripper else ""}
    for i, board in boards:
        if board.name not in used:
            expected = "a board that a [[drive]] or the gripper names by `board`"
            raise Rejected(("board", i, "name"), expected, f"{board.name}, which none names")


def _check_lines(boards: Sequence[tuple[int, Board]]) -> None:
    """A board is where its kind is; the boards on a port speak alike."""
    first_on: dict[str, Board] = {}
    addressed: dict[tuple[str, str, int], Board] = {}
    for i, board in boards:
        same = addressed.setdefault((board.kind, board.port, board.address), board)
        if same is not board:
            expected = f"another one than that of {same.name} on the same line"
            raise Rejected(("board", i, "address"), expected, str(board.address))
        if KINDS[board.kind].line == "can":
            if board.port:
                raise Rejected(("board", i, "port"), f"none: a {board.kind} is on the bus of [can]", board.port)
            continue
        if not board.port:
            raise Rejected(("board", i, "port"), f"the serial port of a {board.kind}", "nothing")
        first = first_on.setdefault(board.port, board)
        if first.kind != board.kind:
            expected = f"a port of its own: {first.name} on this one is a {first.kind}, which speaks otherwise"
            raise Rejected(("board", i, "port"), expected, board.port)
        if first.baud != board.baud:
            expected = f"{first.baud}, as {first.name} on the same port"
            raise Rejected(("board", i, "baud"), expected, str(board.baud))


def _check_drive_board(arm: Arm, drive: Drive, path: tuple[str | int, ...]) -> None:
    if arm.board(drive) is None:
        names = ", ".join(board.name for board in arm.boards) or "none"
        raise Rejected((*path, "board"), f"the name of a [[board]] of this file ({names})", drive.board)
    kind = arm.kind_of(drive)
    if drive.board_channel > kind.motors:
        expected = "1, its only motor" if kind.motors == 1 else f"1 to {kind.motors}"
        raise Rejected((*path, "board_channel"), expected, str(drive.board_channel))
    if drive.pid.mode not in kind.modes:
        expected = f"what its board can do: {' or '.join(kind.modes)}"
        raise Rejected((*path, "pid", "mode"), expected, drive.pid.mode)
    if drive.servo and KINDS[SERVOS[drive.servo].kind] is not kind:
        expected = f'the servo of a board of kind "{SERVOS[drive.servo].kind}", as a {drive.servo} is'
        raise Rejected((*path, "board"), expected, drive.board)
    if drive.encoder_board < 0 and kind.counts_per_turn not in (0, drive.encoder_counts_per_rev):
        expected = f"{kind.counts_per_turn}: what the board sends a turn of its encoder, whatever the encoder"
        raise Rejected((*path, "encoder_counts_per_rev"), expected, str(drive.encoder_counts_per_rev))
    if drive.encoder_board >= 0 and (not kind.uses_other_encoder or drive.pid.mode == "position"):
        expected = "none: such a drive closes its own loop, on its own encoder"
        raise Rejected((*path, "encoder_board"), expected, str(drive.encoder_board))
    if drive.home is not None and not kind.has_switch and drive.encoder_board < 0:
        expected = "none: its board reads no home switch"
        remedy = "set `absolute` of its [[board]], or let an encoder board count"
        raise Rejected((*path, "home"), expected, "[drive.home]", remedy)
    _check_unique_turn(arm, drive, kind, path)
    if drive.encoder_board < 0 and not kind.has_encoder:
        expected = "an encoder board, because the drive's board has no encoder of its own"
        raise Rejected((*path, "encoder_board"), expected, "nothing")


def _check_unique_turn(arm: Arm, drive: Drive, kind: BoardKind, path: tuple[str | int, ...]) -> None:
    """An absolute encoder says the same again after a turn: the joint's range must lie within one."""
    turn_rad = arm.unique_rad(drive)
    if turn_rad == math.inf:
        return
    lower, upper, mapped = drive.joint_lower_rad, drive.joint_upper_rad, JointMap(drive)
    step_rad = abs(mapped.radians_per_count)
    if not upper - lower <= turn_rad - step_rad:
        expected = f"a range below {turn_rad:.4g} rad: the encoder knows its place within one turn, {turn_rad:.4g} rad here"
        got = f"{lower:g} to {upper:g} rad"
        remedy = "narrow joint_lower_rad and joint_upper_rad"
        key, ratio = ("gear_ratio", drive.gear_ratio) if drive.encoder_on == "motor" else ("encoder_ratio", drive.encoder_ratio)
        if ratio != 1.0:
            remedy += f"; {key} = {ratio:g} is of gears between that encoder and the joint"
            if kind.is_absolute:
                remedy += ", and a servo reads no switch that tells its turn: take a board that does, such as a moteus"
        raise Rejected((*path, "joint_upper_rad"), expected, got, remedy)
    if kind.first_count is None:
        return
    first, last = kind.first_count, kind.first_count + kind.counts_per_turn - 1
    counts = sorted((mapped.count(lower), mapped.count(upper)))
    if counts[0] < first or counts[1] > last:
        ends = sorted((mapped.radians(first), mapped.radians(last)))
        expected = f"a range within the servo's counts {first} to {last}, here {ends[0]:.4g} to {ends[1]:.4g} rad"
        got = f"{lower:g} to {upper:g} rad, counts {counts[0]} to {counts[1]}"
        middle = drive.zero_count + round((first + last - sum(counts)) / 2)
        remedy = f"narrow the range, or fit the servo's horn so that zero_count is about {middle}"
        raise Rejected((*path, "zero_count"), expected, got, remedy)


def _check_end(arm: Arm) -> None:
    nodes = {drive.motor_node: f"joint {drive.joint}" for drive in arm.drives if not drive.board}
    is_on_node = arm.gripper is not None and not arm.gripper.board
    if arm.drives and not nodes and (is_on_node or arm.digital):
        key = "gripper" if is_on_node else "digital"
        expected = "a reference motor board among the drives: their bus carries gripper and pins"
        remedy = "a gripper may have a [[board]] instead: board" if is_on_node else ""
        raise Rejected((key,), expected, "only drives with a [[board]]", remedy)
    if arm.gripper is not None:
        _check_gripper(arm, arm.gripper, nodes)
    for i, pin in enumerate(arm.digital):
        if pin.board not in nodes:
            known = ", ".join(str(node) for node in sorted(nodes)) or "none"
            raise Rejected(("digital", i, "board"), f"the motor_node of a drive or the gripper: {known}", str(pin.board))
        if pin.direction == "input" and pin.safe != "low":
            raise Rejected(("digital", i, "safe"), "no safe level: an input has none", pin.safe)
    _check_unique(
        ((("digital", i, "name"), pin.name) for i, pin in enumerate(arm.digital)), "a unique name for every [[digital]]"
    )
    _check_unique(
        ((("digital", i, "pin"), (pin.board, pin.pin)) for i, pin in enumerate(arm.digital)),
        "one [[digital]] per pin (board, pin)",
    )
    if len(arm.digital) > DIGITAL_MOST:
        raise Rejected(("digital",), f"at most {DIGITAL_MOST} pins (a recording holds them in 32 bits)", str(len(arm.digital)))


def _check_limit_switches(arm: Arm) -> None:
    inputs = [pin.name for pin in arm.digital if pin.direction == "input"]
    named: list[Named] = []
    for i, drive in enumerate(arm.drives):
        switches, home = drive.limit_switches, drive.home
        for end in ("lower", "upper"):
            path, name = ("drive", i, "limit_switches", end), getattr(switches, end, "")
            is_own = name == OWN_INPUT
            has_own = bool(drive.board) and drive.encoder_board < 0 and arm.kind_of(drive).has_limit_inputs
            if name and name not in inputs and not (is_own and has_own):
                known = ", ".join(inputs) or "none"
                kinds = ", ".join(kind for kind, offers in KINDS.items() if offers.has_limit_inputs)
                expected = (
                    f'the name of a [[digital]] that is an input ({known}); "{OWN_INPUT}" is for: {kinds}; other boards:'
                    " let the switch open the emergency stop, also where the joint's encoder is at an encoder board"
                )
                raise Rejected(path, expected, f'"{name}"')
            named += [(path, name)] if name and not is_own else []
            if home is not None and home.switch == end and not name:
                expected = f"a limit switch for homing: `{end}` of [drive.limit_switches]"
                raise Rejected(("drive", i, "home", "switch"), expected, "none")
            side = -1.0 if end == "lower" else 1.0
            if home is not None and home.switch == end and (home.index_rad - home.switch_rad) * side < 0.0:
                expected = f"an index beyond switch_rad = {home.switch_rad:g}, where the {end} limit switch is active"
                raise Rejected(("drive", i, "home", "index_rad"), expected, f"{home.index_rad:g}")
        _check_own_inputs(arm, i, drive)
    _check_unique(named, "a switch of its own for every end")


def _check_own_inputs(arm: Arm, i: int, drive: Drive) -> None:
    """A board has so many inputs for the switches of a motor."""
    if (switches := drive.limit_switches) is None:
        return
    ends = [end for end in ("lower", "upper") if getattr(switches, end) == OWN_INPUT]
    has_home = drive.home is not None and drive.home.switch == "own"
    kind = arm.kind_of(drive)
    if ends and switches.active != "high" and not kind.limits_are_levels:
        expected = f'"high": the board of joint {drive.joint} says itself whether a switch is met (Motion Studio\'s "invert")'
        raise Rejected(("drive", i, "limit_switches", "active"), expected, f'"{switches.active}"')
    if ends and len(ends) + has_home > kind.switch_inputs:
        raise Rejected(
            ("drive", i, "limit_switches", ends[-1]),
            f"one switch of joint {drive.joint} at its board, which has one input for it: give the other end to a [[digital]]"
            f' or the emergency stop, and home on the limit switch (`switch = "{ends[0]}"` in [drive.home])',
            " and ".join([*(f"the {end} end" for end in ends), *(["a home switch"] if has_home else [])]),
        )


def _check_gripper(arm: Arm, gripper: Gripper, nodes: dict[int, str]) -> None:
    """Whose motor board it has; adds its own to `nodes`."""
    if gripper.usual_force_N > gripper.force_limit_N:
        expected = f"at most {gripper.force_limit_N:.1f} N, the force at current_limit_A"
        raise Rejected(("gripper", "force_N"), expected, str(gripper.force_N))
    if gripper.board:
        _check_gripper_board(arm, gripper)
    elif gripper.motor_node < 0:
        raise Rejected(("gripper", "motor_node"), "the node of its motor board, or board", "neither")
    elif gripper.motor_node in nodes:
        got = f"{gripper.motor_node}, that of {nodes[gripper.motor_node]}"
        raise Rejected(("gripper", "motor_node"), "a motor board of its own", got)
    else:
        nodes[gripper.motor_node] = "the gripper"


def _check_gripper_board(arm: Arm, gripper: Gripper) -> None:
    if gripper.motor_node >= 0:
        raise Rejected(("gripper", "motor_node"), "motor_node or board", "both")
    board = next((board for board in arm.boards if board.name == gripper.board), None)
    if board is None:
        names = ", ".join(board.name for board in arm.boards) or "none"
        raise Rejected(("gripper", "board"), f"the name of a [[board]] of this file ({names})", gripper.board)
    kind = KINDS[board.kind]
    if "voltage" not in kind.modes and not kind.limits_force:
        able = ", ".join(name for name, one in KINDS.items() if "voltage" in one.modes or one.limits_force)
        expected = f"a board that takes voltages, or limits its force ({able})"
        raise Rejected(("gripper", "board"), expected, f"a {board.kind}")
    if gripper.board_channel > kind.motors:
        raise Rejected(("gripper", "board_channel"), f"1 to {kind.motors}", str(gripper.board_channel))
    for drive in arm.drives:
        if (drive.board, drive.board_channel) == (gripper.board, gripper.board_channel):
            got = f"motor {drive.board_channel} of {drive.board}, that of joint {drive.joint}"
            raise Rejected(("gripper", "board_channel"), "a motor output of its own", got)
    if (board.kind == "vesc" or kind.limits_force) and not gripper.encoder_counts_per_rev:
        expected = f"the counts a turn that a {board.kind} sends (docs/{board.kind}.md)"
        raise Rejected(("gripper", "encoder_counts_per_rev"), expected, "0")
    if gripper.on_fault == "release" and not kind.can_free:
        raise Rejected(("gripper", "on_fault"), f'"hold": a {board.kind} cannot open a motor\'s circuit', "release")


def _check_unique(items: Iterable[Named], expected: str) -> None:
    seen: set[Hashable] = set()
    for path, value in items:
        if value in seen:
            raise Rejected(path, expected, f"{value} a second time")
        seen.add(value)


def _check_recording(arm: Arm) -> None:
    recording = arm.recording
    if 0 < recording.keep_bytes < 2 * recording.rotate_bytes:
        expected = f"0 (keep everything) or at least twice rotate_bytes, {2 * recording.rotate_bytes}"
        raise Rejected(("recording", "keep_bytes"), expected, str(recording.keep_bytes))


def _check_rest(arm: Arm) -> None:
    if arm.rest is None:
        return
    path = ("rest", "q_rad")
    if len(arm.rest.q_rad) != arm.joint_count:
        raise Rejected(path, f"{arm.joint_count} joint angles", f"{len(arm.rest.q_rad)} of them")
    for joint, (angle, (lower, upper)) in enumerate(zip(arm.rest.q_rad, arm.limits_rad, strict=True), start=1):
        if not lower <= angle <= upper:
            expected = f"joint {joint} within its limits, {lower} to {upper} rad"
            raise Rejected(path, expected, str(angle))


def _check_table(table: Table) -> None:
    if table.known_pose and table.origin_m is None:
        raise Rejected(("table", "origin_m"), "the board's position", "nothing", "or set known_pose = false")
    if table.circle_points and table.circle_radius_m is None:
        raise Rejected(("table", "circle_radius_m"), "the circle's radius", "nothing")
    if table.line_points > 1 and table.line_pitch_m is None:
        raise Rejected(("table", "line_pitch_m"), "the line's pitch", "nothing")


def _check_effects(arm: Arm) -> None:
    for index, effect in enumerate(arm.effects):
        _check_effect(arm, effect, ("effect", index))
    _check_unique(
        ((("effect", i, "effect"), (effect.effect, effect.joint)) for i, effect in enumerate(arm.effects)),
        "each effect once per joint",
    )


def _check_effect(arm: Arm, effect: Effect, path: tuple[str | int, ...]) -> None:
    kind = EFFECTS.get(effect.effect)
    if kind is None:
        raise Rejected((*path, "effect"), "one of " + ", ".join(EFFECTS), f'"{effect.effect}"')
    _check_place(arm, effect, kind, (*path, "joint"))
    of_effect = (*path, "parameters")
    for parameter in kind.required:
        if parameter not in effect.parameters:
            raise Rejected(of_effect, f"{parameter} of the effect {effect.effect}", "none")
    for parameter, value in effect.parameters.items():
        place = (*of_effect, parameter)
        matched = re.fullmatch(kind.pattern, parameter) if kind.pattern else None
        if matched is None and parameter not in (*kind.required, *kind.optional, *kind.one_of):
            names = ", ".join(parameter_names(kind))
            raise Rejected(place, f"one of the parameters {names} of {effect.effect}", "an unknown parameter")
        if matched is not None and int(matched[1]) > len(arm.links):
            raise Rejected(place, f"a link from 1 to {len(arm.links)}", matched[1])
        if parameter in kind.positive and value <= 0:
            raise Rejected(place, "a positive number", str(value))
        if parameter in kind.not_negative and value < 0:
            raise Rejected(place, "a number not below 0", str(value))
    chosen = [parameter for parameter in kind.one_of if parameter in effect.parameters]
    if kind.one_of and len(chosen) != 1:
        raise Rejected(of_effect, "exactly one of " + ", ".join(kind.one_of), f"{len(chosen)} of them")


def _check_place(arm: Arm, effect: Effect, kind: EffectKind, path: tuple[str | int, ...]) -> None:
    joint = effect.joint
    if kind.place == "none":
        if joint is not None:
            raise Rejected(path, f"no joint for the effect {effect.effect}", str(joint))
    elif joint is None:
        if kind.place != "joint or none":
            raise Rejected(path, f"the {kind.place} of the effect {effect.effect}", "nothing")
    else:
        count = arm.joint_count if kind.place == "joint" else len(arm.links)
        if not 1 <= joint <= count:
            raise Rejected(path, f"a {kind.place.removesuffix(' or none')} from 1 to {count}", str(joint))


def _check_maps(arm: Arm) -> None:
    driven = frozenset(drive.joint for drive in arm.drives)
    for index, entry in enumerate(arm.maps):

        def fault(path: tuple[str, ...], expected: str, got: str, index: int = index) -> Rejected:
            return Rejected(("map", index, *path), expected, got)

        check_map(entry, arm.joint_count, driven, fault)
    _check_unique(
        ((("map", i, "over"), (one.joint, one.corrects, one.over)) for i, one in enumerate(arm.maps)), "each map once per joint"
    )


def _check_tolerances(arm: Arm) -> None:
    def fault(path: tuple[str | int, ...], expected: str, got: str) -> Rejected:
        return Rejected(("tolerances", *path), expected, got)

    made = arm.tolerances
    if made is None:
        return
    if made.about and len(made.about) != len(arm.links):
        raise fault(("about",), f"a row for each of the {len(arm.links)} links", f"{len(made.about)} of them")
    check_tolerances(made, len(arm.links), arm.joint_count, fault)
    tables = [("every_link", spreads(made.of_link(number + 1))) for number in range(len(arm.links))]
    tables += [("every_joint", spreads(made.of_joint(number + 1))) for number in range(arm.joint_count)]
    for name, stated in tables:
        for key, spread in stated:
            if spread.sd_about == 0.0:
                raise fault((name, key), "a deviation above 0; without the key it is unknown", "0")
