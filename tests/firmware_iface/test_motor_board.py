"""The motor board's driver in scripted dialogues: commands, states, parameters, and boards that misbehave."""

import pytest

from firmware_iface.errors import (
    BoardFaulted,
    BoardRefused,
    BoardReset,
    BoardSilent,
    LinkLost,
    MisuseError,
    ProtocolViolation,
    WrongIdentity,
)
from firmware_iface.motor.board import MotorBoard, MotorIdentity
from firmware_iface.motor.bus import MotorBus
from firmware_iface.motor.cia402 import DriveCommand, DriveState
from firmware_iface.motor.wire import (
    MotorFault,
    MotorParameter,
    ParameterAnswer,
    ParameterRequest,
    ParameterResult,
    Reply,
    SetpointMode,
)
from tests.firmware_iface.motor_command import MotorCommand
from tests.firmware_iface.scripted import RX, TX, FakeClock, FrameScript, ScriptedFrames

STATUSWORD = {
    DriveState.NOT_READY_TO_SWITCH_ON: 0x00,
    DriveState.SWITCH_ON_DISABLED: 0x50,
    DriveState.READY_TO_SWITCH_ON: 0x31,
    DriveState.SWITCHED_ON: 0x33,
    DriveState.OPERATION_ENABLED: 0x37,
    DriveState.QUICK_STOP_ACTIVE: 0x17,
    DriveState.FAULT_REACTION_ACTIVE: 0x1F,
    DriveState.FAULT: 0x18,
}
DISABLED, ENABLED, FAULT = DriveState.SWITCH_ON_DISABLED, DriveState.OPERATION_ENABLED, DriveState.FAULT


def sent(controlword: int, sequence: int, mode: int = SetpointMode.VOLTAGE, setpoint: int = 0) -> tuple[str, int, bytes]:
    return TX, 0x101, MotorCommand(controlword, mode, sequence & 0x1F, setpoint).pack()


def reply(state: DriveState, sequence: int, faults: int = 0, mode: int = SetpointMode.VOLTAGE) -> bytes:
    return Reply(STATUSWORD[state], mode, sequence & 0x1F, 0.0, 24.0, 30, faults).pack()


def replied(state: DriveState, sequence: int, faults: int = 0) -> tuple[str, int, bytes]:
    return RX, 0x181, reply(state, sequence, faults)


def asked(operation: int, index: int, sequence: int, value: int = 0) -> tuple[str, int, bytes]:
    return TX, 0x201, ParameterRequest(operation, index, sequence, value).pack()


def answered(index: int, sequence: int, value: int, result: int = 0) -> tuple[str, int, bytes]:
    return RX, 0x281, ParameterAnswer(result, index, sequence, value).pack()


def make(script: FrameScript | None = None) -> tuple[MotorBoard, MotorBus, ScriptedFrames, FakeClock]:
    link, clock = ScriptedFrames(script or []), FakeClock()
    bus = MotorBus(link, clock)
    return MotorBoard(bus, 1, "m1"), bus, link, clock


WALK_UP: FrameScript = [
    sent(0x00, 1),
    replied(DISABLED, 1),
    sent(0x06, 2),
    replied(DriveState.READY_TO_SWITCH_ON, 2),
    sent(0x07, 3),
    replied(DriveState.SWITCHED_ON, 3),
    sent(0x0F, 4),
    replied(ENABLED, 4),
]


IDENTIFY: FrameScript = [
    asked(0, MotorParameter.PROTOCOL_VERSION, 1),
    answered(MotorParameter.PROTOCOL_VERSION, 1, 1),
    asked(0, MotorParameter.BOARD_SERIAL_NUMBER, 2),
    answered(MotorParameter.BOARD_SERIAL_NUMBER, 2, 0xF0A1B2C3 - 2**32),
]


class TestSetPoints:
    def test_each_command_is_one_frame_with_the_next_sequence(self) -> None:
        numbers = [number % 32 for number in range(1, 70)]
        board, _, link, _ = make([sent(0x00, number, SetpointMode.VOLTAGE, -1500) for number in numbers])
        for _ in numbers:
            board.command_voltage(-1.5)
        assert link.script == []

    def test_quantities_are_sent_in_the_units_of_the_wire(self) -> None:
        position = MotorCommand(0x00, SetpointMode.POSITION, 4, -100_000, 250).pack()
        script: FrameScript = [sent(0, 1, SetpointMode.VOLTAGE, 12_346), sent(0, 2, SetpointMode.CURRENT, -500)]
        board, _, link, _ = make([*script, sent(0, 3, SetpointMode.OFF), (TX, 0x101, position)])
        board.command_voltage(12.3456)
        board.command_current(-0.5)
        board.command_off()
        board.command_position(-100_000, 0.25)
        assert link.script == []

    @pytest.mark.parametrize("setpoint", [float("nan"), float("inf"), 3e6, -3e6])
    def test_a_set_point_that_cannot_be_sent_is_our_misuse_and_changes_nothing(self, setpoint: float) -> None:
        board, _, _, _ = make([sent(0x00, 1)])
        with pytest.raises(MisuseError, match='motor board "m1" \\(node 1\\) on test:can0'):
            board.command_voltage(setpoint)
        with pytest.raises(MisuseError, match="feed-forward 40000 mV"):
            board.command_position(0, 40.0)
        board.command_voltage(0.0)  # the sequence was not used up

    @pytest.mark.parametrize("node", [0, 16, -1])
    def test_a_node_out_of_range_is_our_misuse(self, node: int) -> None:
        _, bus, _, _ = make()
        with pytest.raises(MisuseError, match="1 to 15"):
            MotorBoard(bus, node)

    def test_a_node_given_twice_is_our_misuse(self) -> None:
        _, bus, _, _ = make()
        with pytest.raises(MisuseError, match="node 1 is assigned to two"):
            MotorBoard(bus, 1)


class TestStates:
    def test_the_way_up_takes_one_step_a_reply_and_ends_with_the_brake_on(self) -> None:
        board, _, link, _ = make(WALK_UP)
        board.go_to(ENABLED)
        assert board.state is ENABLED
        assert link.script == []

    def test_the_controlword_of_the_state_is_kept_by_the_commands_that_follow(self) -> None:
        board, _, link, _ = make([*WALK_UP, sent(0x0F, 5, SetpointMode.CURRENT, 1000)])
        board.go_to(ENABLED)
        board.command_current(1.0)
        assert link.script == []

    def test_down_is_one_step(self) -> None:
        board, _, _, _ = make([*WALK_UP, sent(0x00, 5), replied(DISABLED, 5)])
        board.go_to(ENABLED)
        board.go_to(DISABLED)
        assert board.state is DISABLED
        assert board.resets == 0

    def test_a_lost_reply_is_made_good_by_sending_again(self) -> None:
        script: FrameScript = [*WALK_UP[:3], sent(0x06, 3), replied(DriveState.READY_TO_SWITCH_ON, 3)]
        board, _, _, _ = make(script)
        board.go_to(DriveState.READY_TO_SWITCH_ON)

    def test_a_board_that_is_not_ready_yet_is_waited_for(self) -> None:
        script: FrameScript = [sent(0, 1), replied(DriveState.NOT_READY_TO_SWITCH_ON, 1), sent(0, 2), replied(DISABLED, 2)]
        board, _, _, _ = make([*script, sent(0x06, 3), replied(DriveState.READY_TO_SWITCH_ON, 3)])
        board.go_to(DriveState.READY_TO_SWITCH_ON)

    def test_silence_is_said_after_the_time_out(self) -> None:
        board, _, _, clock = make([sent(0, number) for number in range(1, 30)])
        with pytest.raises(BoardSilent, match=r"does not reach SWITCHED ON, stays in an unknown state.*check its supply, wiring"):
            board.go_to(DriveState.SWITCHED_ON)
        assert clock.now_s() == pytest.approx(100.5, abs=0.01)

    def test_a_fault_is_never_acknowledged_in_passing(self) -> None:
        board, _, link, _ = make([sent(0, 1), replied(FAULT, 1, MotorFault.WATCHDOG | MotorFault.OVER_CURRENT)])
        with pytest.raises(BoardFaulted, match=r"FAULT \(over current, watchdog\).*acknowledge"):
            board.go_to(ENABLED)
        assert link.script == []

    @pytest.mark.parametrize("state", [DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE, DriveState.NOT_READY_TO_SWITCH_ON])
    def test_no_command_leads_to_states_of_the_boards_own(self, state: DriveState) -> None:
        board, _, _, _ = make([])
        with pytest.raises(MisuseError, match="no command leads to"):
            board.go_to(state)

    def test_no_way_leads_through_operation_enabled(self) -> None:
        board, _, _, _ = make([sent(0, 1), replied(DISABLED, 1)])
        with pytest.raises(MisuseError, match="no transition from SWITCH ON DISABLED to QUICK STOP ACTIVE"):
            board.go_to(DriveState.QUICK_STOP_ACTIVE)


class TestFaults:
    def test_an_acknowledgement_is_an_edge_and_enables_nothing(self) -> None:
        script: FrameScript = [sent(0, 1), replied(FAULT, 1, MotorFault.EMERGENCY_STOP), sent(0x80, 2)]
        board, _, link, _ = make([*script, replied(DISABLED, 2), sent(0, 3), replied(DISABLED, 3)])
        board.acknowledge_fault()
        assert board.state is DISABLED
        assert link.script == []
        assert board.resets == 0

    def test_without_a_fault_nothing_is_reset(self) -> None:
        board, _, link, _ = make([sent(0, 1), replied(DISABLED, 1)])
        board.acknowledge_fault()
        assert link.script == []

    @pytest.mark.parametrize("unanswered", range(0, 33, 4))
    def test_a_board_that_fell_silent_is_not_acknowledged(self, unanswered: int) -> None:
        """32 COMMANDs after its last answer, the 5-bit sequence is that of this answer again."""
        board, bus, link, clock = make([sent(0, 1), replied(DISABLED, 1)])
        board.command(SetpointMode.VOLTAGE)
        bus.update()
        assert board.state is DISABLED
        link.script = [sent(0, 2 + k) for k in range(60)]
        for _ in range(unanswered):
            board.command(SetpointMode.VOLTAGE)
        begun_s = clock.time_s
        with pytest.raises(BoardSilent, match="does not reply to COMMAND"):
            board.acknowledge_fault()
        assert clock.time_s - begun_s < 0.3

    def test_a_cause_that_lasts_is_named(self) -> None:
        script: FrameScript = []
        for number in range(1, 400, 2):
            script += [sent(0, number), replied(FAULT, number, MotorFault.OVER_TEMPERATURE)]
            script += [sent(0x80, number + 1), replied(FAULT, number + 1, MotorFault.OVER_TEMPERATURE)]
        board, _, _, _ = make(script)
        with pytest.raises(BoardFaulted, match=r"over temperature.*the cause persists"):
            board.acknowledge_fault()

    def test_emergency_stop_is_said_three_times_and_again_when_asked_again(self) -> None:
        _, bus, link, _ = make([(TX, 0, b"\x01")] * 6)
        bus.emergency_stop(reason=1)
        bus.emergency_stop(reason=1)
        assert link.script == []

    def test_emergency_stop_tries_all_three_times_before_it_says_that_the_bus_is_lost(self) -> None:
        _, bus, link, _ = make()
        tries = []

        def fail(can_id: int, payload: bytes) -> None:
            tries.append(can_id)
            raise LinkLost("CAN bus test:can0: lost")

        link.send = fail  # type: ignore[method-assign]
        with pytest.raises(LinkLost):
            bus.emergency_stop()
        assert tries == [0, 0, 0]

    def test_an_emergency_stop_of_somebody_else_is_counted(self) -> None:
        _, bus, link, _ = make()
        link.push(0, b"\x00")
        bus.update()
        assert bus.foreign_emergency_stops == 1


def enabled() -> tuple[MotorBoard, MotorBus, ScriptedFrames, FakeClock]:
    """A board in OPERATION ENABLED, last sequence 4, and 20 more commands in the script."""
    board, bus, link, clock = make([*WALK_UP, *(sent(0x0F, number) for number in range(5, 70))])
    board.go_to(ENABLED)
    return board, bus, link, clock


class TestReplies:
    def test_the_latest_reply_and_its_time_are_kept(self) -> None:
        board, bus, link, clock = enabled()
        board.command_voltage(0.0)
        clock.time_s = 200.0
        link.push(0x181, Reply(0x37, 1, 5, -1.25, 23.5, 35, 0).pack())
        bus.update()
        assert board.reply == pytest.approx((0x37, 1, 5, -1.25, 23.5, 35, 0))
        assert board.reply_at_s == 200.0
        assert board.reply_lag == 0
        board.require_fresh(200.019, 0.02)
        with pytest.raises(BoardSilent, match=r"no reply for 0.050 s \(limit 0.020 s\)"):
            board.require_fresh(200.05, 0.02)

    def test_lost_replies_are_counted_across_the_wrap(self) -> None:
        board, bus, link, _ = enabled()
        for number in range(5, 40):
            board.command_voltage(0.0)
            if number not in (10, 31, 32):
                link.push(0x181, reply(ENABLED, number))
            bus.update()
        assert (board.lost, board.stale) == (3, 0)

    def test_a_reply_that_comes_a_cycle_late_is_told_by_its_echo(self) -> None:
        board, bus, link, _ = enabled()
        board.command_voltage(0.0)
        board.command_voltage(0.0)
        link.push(0x181, reply(ENABLED, 5))
        bus.update()
        assert board.reply_lag == 1

    def test_replies_to_a_host_before_us_are_dropped(self) -> None:
        board, bus, link, _ = make([sent(0, 1), sent(0, 2)])
        link.push(0x181, reply(ENABLED, 17))
        bus.update()
        board.command_voltage(0.0)
        link.push(0x181, reply(ENABLED, 17))
        bus.update()
        assert board.reply is None
        assert board.stale == 2

    def test_a_reply_too_late_to_be_placed_is_dropped(self) -> None:
        board, bus, link, _ = make([sent(0, number) for number in range(1, 26)])
        for _ in range(25):
            board.command_voltage(0.0)
        link.push(0x181, reply(DISABLED, 25 - 16))
        bus.update()
        assert (board.reply, board.stale) == (None, 1)
        link.push(0x181, reply(DISABLED, 25 - 15))
        bus.update()
        assert board.reply_lag == 15

    def test_an_older_reply_never_replaces_a_newer_one(self) -> None:
        board, bus, link, _ = enabled()
        board.command_voltage(0.0)
        board.command_voltage(0.0)
        link.push(0x181, reply(ENABLED, 6))
        link.push(0x181, reply(FAULT, 5))
        bus.update()
        assert board.state is ENABLED
        assert board.stale == 1

    def test_one_doubled_reply_is_noise_and_three_are_a_second_board(self) -> None:
        board, bus, link, _ = enabled()
        for number in range(5, 8):
            board.command_voltage(0.0)
            link.push(0x181, reply(ENABLED, number))
            link.push(0x181, reply(ENABLED, number))
            if number < 7:
                bus.update()
        with pytest.raises(ProtocolViolation, match="check for two boards with this node id"):
            bus.update()

    def test_doubled_replies_far_apart_are_noise(self) -> None:
        board, bus, link, _ = enabled()
        for number in range(5, 40):
            board.command_voltage(0.0)
            link.push(0x181, reply(ENABLED, number))
            if number % 5 == 0:
                link.push(0x181, reply(ENABLED, number))
            bus.update()
        assert board.stale == 7

    @pytest.mark.parametrize("length", [0, 7])
    def test_a_reply_of_wrong_length_is_a_violation_with_its_bytes(self, length: int) -> None:
        _, bus, link, _ = enabled()
        link.push(0x181, b"\x37\x29\x3c\xf6\xc0\x5d\x29\x00"[:length])
        with pytest.raises(ProtocolViolation, match="not 8 bytes"):
            bus.update()

    def test_a_statusword_that_is_no_state_is_a_violation(self) -> None:
        board, bus, link, _ = enabled()
        board.command_voltage(0.0)
        link.push(0x181, Reply(0x11, 1, 5, 0.0, 24.0, 30, 0).pack())
        with pytest.raises(ProtocolViolation, match=r"an unknown state \(0x11\) \(received: 11 29"):
            bus.update()

    @pytest.mark.parametrize("can_id", [0x101, 0x201])
    def test_somebody_else_who_commands_our_boards_is_a_violation(self, can_id: int) -> None:
        _, bus, link, _ = make()
        link.push(can_id, bytes(8))
        with pytest.raises(ProtocolViolation, match="another program commands node 1"):
            bus.update()

    def test_frames_of_nodes_that_are_not_ours_are_let_be(self) -> None:
        _, bus, link, _ = make()
        for can_id in (0x105, 0x185, 0x7FF, 0x080):
            link.push(can_id, bytes(8))
        bus.update()
        assert bus.strangers == 4

    def test_one_problem_hides_neither_the_next_nor_the_frames_behind_it(self) -> None:
        board, bus, link, _ = enabled()
        board.command_voltage(0.0)
        link.push(0x181, b"")
        link.push(0x101, bytes(8))
        link.push(0x181, reply(ENABLED, 5))
        with pytest.raises(ProtocolViolation, match="not 8 bytes"):
            bus.update()
        with pytest.raises(ProtocolViolation, match="another program"):
            bus.update()
        bus.update()
        assert board.reply_lag == 0


class TestReset:
    """A board that restarts is told from lost replies, once, and is not switched on again by itself."""

    def expect_reset(self, board: MotorBoard, bus: MotorBus) -> None:
        with pytest.raises(BoardReset, match=r"restarted by itself; it is off"):
            bus.update()
        bus.update()
        assert (board.resets, board.lost) == (1, 0)

    def test_by_its_hello(self) -> None:
        board, bus, link, _ = enabled()
        link.push(0x281, bytes.fromhex("00 00 00 00 01 00 00 00"))
        self.expect_reset(board, bus)
        assert board.reply is None

    def test_by_a_state_that_nobody_sent_it_to(self) -> None:
        board, bus, link, _ = enabled()
        board.command_voltage(0.0)
        link.push(0x181, reply(DISABLED, 5))
        self.expect_reset(board, bus)

    def test_by_both_signs_once(self) -> None:
        board, bus, link, _ = enabled()
        board.command_voltage(0.0)
        link.push(0x281, bytes.fromhex("00 00 00 00 01 00 00 00"))
        link.push(0x181, reply(DISABLED, 5))
        self.expect_reset(board, bus)

    def test_commands_after_it_ask_for_no_voltage(self) -> None:
        board, bus, link, _ = enabled()
        link.push(0x281, bytes.fromhex("00 00 00 00 01 00 00 00"))
        self.expect_reset(board, bus)
        link.script = [sent(DriveCommand.DISABLE_VOLTAGE, 5, SetpointMode.VOLTAGE, 3000)]
        board.command_voltage(3.0)

    def test_commands_that_it_slept_through_are_no_lost_replies(self) -> None:
        board, bus, link, _ = enabled()
        link.push(0x281, bytes.fromhex("00 00 00 00 01 00 00 00"))
        self.expect_reset(board, bus)
        link.script = [sent(0, number) for number in range(5, 12)]
        for _ in range(5, 12):
            board.command_voltage(0.0)
        link.push(0x181, reply(DISABLED, 11))
        bus.update()
        assert (board.state, board.lost) == (DISABLED, 0)

    def test_a_hello_before_the_first_contact_is_none(self) -> None:
        board, bus, link, _ = make()
        link.push(0x281, bytes.fromhex("00 00 00 00 01 00 00 00"))
        bus.update()
        assert board.resets == 0

    def test_a_fault_is_no_reset(self) -> None:
        board, bus, link, _ = enabled()
        board.command_voltage(0.0)
        link.push(0x181, reply(FAULT, 5, MotorFault.WATCHDOG))
        bus.update()
        assert (board.state, board.resets) == (FAULT, 0)


class TestParameters:
    def test_identify_reads_who_it_is_with_the_serial_number_unsigned(self) -> None:
        script: FrameScript = [asked(0, 2, 3), answered(2, 3, 0x0203), asked(0, 3, 4), answered(3, 4, 2048)]
        board, _, _, _ = make([*IDENTIFY, *script])
        assert board.identify(serial_number=0xF0A1B2C3) == MotorIdentity(1, 0xF0A1B2C3, 0x0203, 2048)

    def test_a_wrong_serial_number_is_one_message_with_both(self) -> None:
        board, _, _, _ = make(IDENTIFY)
        with pytest.raises(WrongIdentity, match="serial number 5, found 4037128899"):
            board.identify(serial_number=5)

    def test_another_protocol_version_is_a_wrong_identity(self) -> None:
        board, _, _, _ = make([asked(0, 0, 1), answered(0, 1, 2)])
        with pytest.raises(WrongIdentity, match="protocol version 2, expected 1"):
            board.identify()

    def test_two_boards_with_one_node_id_are_found_when_identified(self) -> None:
        board, _, link, clock = make(IDENTIFY)
        twin = ParameterAnswer(0, MotorParameter.BOARD_SERIAL_NUMBER, 2, 99).pack()
        waits = []

        def second_answer(now_s: float) -> None:
            waits.append(now_s)
            if not link.script and len(waits) == 3:  # behind the first answer
                link.push(0x281, twin)

        clock.on_wait = second_answer
        with pytest.raises(ProtocolViolation, match="two boards answer, the second with serial number 99"):
            board.identify()

    def test_a_write_that_is_lost_is_said_again_with_the_same_bytes(self) -> None:
        kp = MotorParameter.KP_uV_count
        board, _, link, _ = make([asked(1, kp, 1, 6135), asked(1, kp, 1, 6135), answered(kp, 1, 6135)])
        board.write(kp, 6135)
        assert link.script == []

    def test_request_sequences_run_from_1_to_255_and_leave_out_0(self) -> None:
        script: FrameScript = []
        for number in range(300):
            sequence = number % 255 + 1
            script += [asked(0, 4, sequence), answered(4, sequence, number)]
        board, _, _, _ = make(script)
        assert [board.read(4) for _ in range(300)] == list(range(300))

    def test_silence_is_said_after_three_times(self) -> None:
        board, _, _, _ = make([asked(0, 4, 1)] * 3)
        with pytest.raises(BoardSilent, match=r"parameter 4 \(POSITION_COUNT\) within 0.050 s, asked 3 times"):
            board.read(MotorParameter.POSITION_COUNT)

    def test_an_answer_to_an_older_request_is_not_taken(self) -> None:
        board, _, link, _ = make([asked(0, 4, 1)] * 3)
        link.push(0x281, ParameterAnswer(0, 4, 200, 77).pack())
        with pytest.raises(BoardSilent):
            board.read(MotorParameter.POSITION_COUNT)

    @pytest.mark.parametrize("result", list(ParameterResult)[1:])
    def test_a_refusal_names_parameter_value_and_reason(self, result: ParameterResult) -> None:
        board, _, _, _ = make([asked(1, 32, 1, 0), answered(32, 1, 200, result)])
        reason = result.name.lower().replace("_", " ")
        with pytest.raises(BoardRefused, match=rf"write parameter 32 \(WATCHDOG_ms\) to 0: {reason}"):
            board.write(MotorParameter.WATCHDOG_ms, 0)

    def test_a_value_that_was_changed_on_the_way_is_a_violation(self) -> None:
        board, _, _, _ = make([asked(1, 16, 1, 6135), answered(16, 1, 6000)])
        with pytest.raises(ProtocolViolation, match="is 6000 after 6135 was written"):
            board.write(MotorParameter.KP_uV_count, 6135)

    @pytest.mark.parametrize(("index", "value"), [(16, 2**31), (256, 0), (-1, 0)])
    def test_what_does_not_fit_is_our_misuse(self, index: int, value: int) -> None:
        board, _, _, _ = make([])
        with pytest.raises(MisuseError, match="cannot ask for"):
            board.write(index, value)

    def test_an_answer_of_wrong_length_is_a_violation(self) -> None:
        _, bus, link, _ = make()
        link.push(0x281, b"\x00\x10")
        with pytest.raises(ProtocolViolation, match=r"not 8 bytes long \(received: 00 10\)"):
            bus.update()
