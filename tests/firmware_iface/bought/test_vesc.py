"""VESC on CAN: golden frames of the firmware's own code, and a controller that is silent, incomplete, restarted or broken."""

from dataclasses import replace
from pathlib import Path

import pytest

from firmware_iface import vesc
from firmware_iface.errors import BoardReset, BoardSilent, MisuseError, ProtocolViolation
from firmware_iface.vesc import COUNTS_PER_TURN, Packet, Vesc, VescBus
from hil_mocks.devices.vesc import TURN, VescMock, VescSetup
from tests.firmware_iface.bought.test_canopen import Wire

GOLDEN = Path(__file__).parents[2] / "golden" / "vesc.txt"
SETUP = VescSetup(5, 0.2, 8.0)


def golden(name: str) -> tuple[int, bytes]:
    rows = (line.split(" | ") for line in GOLDEN.read_text().splitlines() if not line.startswith("#"))
    found = {name_: (int(can_id, 16), bytes.fromhex(payload)) for name_, can_id, payload in rows}
    return found[name]


class Cell:
    """A mock VESC on a wire: its control period passes whenever the host waits."""

    def __init__(self, setup: VescSetup = SETUP) -> None:
        self.turns = 0.0
        self.mock = VescMock(setup, lambda: self.turns)
        self.is_cut = False
        self.wired = Wire(self._answer)
        self.bus = VescBus(self.wired, self.wired)
        self.board = Vesc(self.bus, 5, "elbow")
        wait = self.wired.wait_until_s

        def wait_until_s(t: float) -> None:
            wait(t)
            self.mock.tick(t, 0.5, 24.0)
            for frame in self._sent():
                self.wired.put(*frame)

        self.wired.wait_until_s = wait_until_s  # type: ignore[method-assign]

    def _sent(self) -> list[tuple[int, bytes]]:
        frames, self.mock.outgoing = self.mock.outgoing, []
        return [] if self.is_cut else frames

    def _answer(self, can_id: int, payload: bytes) -> list[tuple[int, bytes]]:
        self.mock.receive(can_id, payload, self.wired.now_s())
        return self._sent()

    def run(self, duration_s: float) -> None:
        for _ in range(round(duration_s * 1e3)):
            self.wired.wait_until_s(self.wired.now_s() + 1e-3)
            self.bus.update()


@pytest.mark.parametrize(
    ("name", "made"),
    [
        ("SET_DUTY 0.5", vesc.duty(5, 0.5)),
        ("SET_DUTY -1", vesc.duty(5, -1.0)),
        ("SET_CURRENT -2.5 A", vesc.current(5, -2.5)),
        ("SET_POS 90 deg", vesc.position(5, COUNTS_PER_TURN * 9 // 4)),
        ("CONF_CURRENT_LIMITS 8 A", vesc.current_limits(5, 8.0)),
        ("PING", vesc.ping(5)),
        ("ask fault", vesc.ask_fault(5)),
        ("ask settings", vesc.ask_settings(5)),
    ],
)
def test_what_is_sent_is_what_the_firmware_reads(name: str, made: vesc.Frame) -> None:
    assert made == golden(name)


def test_what_the_firmware_sends_is_read() -> None:
    assert vesc.status(golden("STATUS -3000 erpm, 1.2 A, -0.25")[1]) == (-3000, 1.2, -0.25)
    assert vesc.counters(golden("STATUS_2 1 Ah, 0.5 Ah")[1]) == (10_000, 5_000)
    assert vesc.status_4(golden("STATUS_4 35 degC, 30 degC, 0.6 A, 359.98 deg")[1]) == (35.0, 30.0, 0.6, 17_999)
    assert vesc.status_5(golden("STATUS_5 -7, 24.1 V")[1]) == (-7, 24.1)
    assert vesc.adc_1_V(golden("STATUS_6 3.3 V")[1]) == 3.3
    assert vesc.fault_in(golden("fault 2")[1]) == (5, 2)
    assert vesc.fault_in(golden("PONG")[1]) is None


def test_what_is_stored_comes_in_pieces_and_a_damaged_answer_is_asked_for_again(monkeypatch: pytest.MonkeyPatch) -> None:
    cell = Cell(replace(SETUP, timeout_s=0.3, application=4))
    cell.board.identify()
    assert cell.board.settings == (0.3, 20.0, 4)
    send, sent = cell.mock._send_buffer, []

    def damaged_once(asker: int, data: bytes) -> None:
        sent.append(data)
        send(asker, data)
        if len(sent) == 1:
            at = next(i for i, (can_id, _) in enumerate(cell.mock.outgoing) if can_id >> 8 == 5)
            can_id, piece = cell.mock.outgoing[at]
            cell.mock.outgoing[at] = can_id, piece[:-1] + bytes((piece[-1] ^ 1,))

    monkeypatch.setattr(cell.mock, "_send_buffer", damaged_once)
    cell.board.identify()
    assert (len(sent), cell.board.settings) == (2, (0.3, 20.0, 4))


def test_firmware_that_does_not_say_what_is_stored_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    cell = Cell()
    cell.mock._send_buffer = lambda asker, data: None  # type: ignore[method-assign]
    cell.board.identify()
    assert cell.board.settings is None


def test_the_mock_obeys_and_answers_the_golden_frames() -> None:
    mock = VescMock(SETUP, lambda: 0.0)
    for asked, answer in (("PING", "PONG"), ("ask fault", "fault 2")):
        mock.fault = 2
        mock.receive(*golden(asked), now_s=0.0)
        assert mock.outgoing.pop() == golden(answer)
    mock.fault = 0
    mock.receive(*golden("SET_DUTY 0.5"), now_s=0.0)
    mock.tick(0.001, 0.0, 24.0)
    assert mock.output == ("voltage", 12.0)
    mock.receive(*golden("CONF_CURRENT_LIMITS 8 A"), now_s=0.0)
    mock.receive(*golden("SET_CURRENT -2.5 A"), now_s=0.0)
    mock.tick(0.002, 0.0, 24.0)
    assert (mock.output, mock.limit_A) == (("current", -2.5), 8.0)
    mock.power_up(0.01)
    mock.tick(0.5, 0.0, 24.0)
    assert mock.outgoing[-7:][0] == golden("NOTIFY_BOOT")


def test_turns_are_counted_across_the_end_of_the_angle() -> None:
    cell = Cell()
    cell.board.identify()
    for step in range(40):
        cell.turns = -0.1 * step
        cell.run(0.01)
    assert cell.board.count == pytest.approx(-3.9 * TURN, abs=1)


@pytest.mark.parametrize(("turns_s", "unseen_s", "is_lost"), [(30.0, 0.011, False), (30.0, 0.016, True), (0.0, 0.2, True)])
def test_turns_that_may_have_passed_unseen_cost_the_count(turns_s: float, unseen_s: float, is_lost: bool) -> None:
    cell = Cell()
    cell.board.identify()

    def run(duration_s: float) -> None:
        for _ in range(round(duration_s * 1e3)):
            cell.turns += 1e-3 * turns_s
            cell.run(1e-3)

    run(0.2)
    cell.is_cut = True
    run(unseen_s)
    cell.is_cut = False
    if is_lost:
        with pytest.raises(BoardReset, match=r"half a turn: its count is lost.*home again"):
            run(0.02)
    else:
        run(0.02)
    assert cell.board.resets == is_lost


def test_the_current_has_the_sign_of_the_duty() -> None:
    cell = Cell()
    for share, sign in ((0.5, 1.0), (-0.5, -1.0)):
        cell.board.take(Packet.STATUS, wire_status(share, 2.0), 0.0)
        assert cell.board.current_A == sign * 2.0


def wire_status(share: float, amperes: float) -> bytes:
    return bytes(4) + round(amperes * 10).to_bytes(2, "big", signed=True) + round(share * 1000).to_bytes(2, "big", signed=True)


def test_a_silent_controller_and_one_without_status_say_what_to_do() -> None:
    cell = Cell()
    cell.is_cut = True
    with pytest.raises(
        BoardSilent, match=r'"elbow" \(id 5\) on memory: no STATUS, STATUS 4, STATUS 5 .*: check its supply, id 5'
    ):
        cell.board.identify()
    quiet = Cell(VescSetup(5, 0.2, 8.0, rate_1_Hz=0.5))
    quiet.run(0.1)
    with pytest.raises(BoardSilent, match=r"no STATUS, STATUS 4, STATUS 5 within .* status messages 1, 4 and 5 in VESC Tool"):
        quiet.board.identify()
    with pytest.raises(MisuseError, match="0 to 253, got 254"):
        Vesc(cell.bus, 254, "elbow")


def test_a_board_that_only_sends_its_status_is_taken_and_told() -> None:
    cell = Cell(replace(SETUP, answers=False))
    assert cell.board.identify() == (
        "; it does not answer PING; it does not answer the question for its fault code: a fault shows by its effect alone"
    )
    before = len(cell.wired.sent)
    cell.board.wanted = vesc.duty(5, 0.2)
    cell.bus.flush()
    assert cell.wired.sent[before:] == [vesc.duty(5, 0.2)]  # and no question
    cell.board.await_status()
    assert (cell.board.is_known, cell.board.supply_V, cell.board.settings) == (True, 24.0, None)


@pytest.mark.parametrize("says_so", [True, False], ids=["NOTIFY_BOOT", "counters alone"])
def test_a_restart_is_noticed(says_so: bool) -> None:
    cell = Cell()
    cell.board.take(Packet.STATUS_2, golden("STATUS_2 1 Ah, 0.5 Ah")[1], 0.0)
    cell.wired.put(*(golden("NOTIFY_BOOT") if says_so else (0xE05, bytes(8))))
    with pytest.raises(BoardReset, match="restarted by itself"):
        cell.bus.update()
    assert cell.board.resets == 1


def test_a_frame_of_another_length_is_a_violation_and_changes_nothing() -> None:
    cell = Cell()
    cell.board.identify()
    before = cell.board.supply_V
    cell.wired.put(0x1B05, b"\x00\x01")
    with pytest.raises(ProtocolViolation, match="packet 27 with 2 bytes"):
        cell.bus.update()
    assert cell.board.supply_V == before


def test_without_commands_a_vesc_brakes_and_after_a_fault_it_obeys_again() -> None:
    cell = Cell()
    cell.bus.send(vesc.duty(5, 0.2))
    cell.run(0.05)
    assert cell.mock.output == ("voltage", pytest.approx(4.8))
    cell.run(SETUP.timeout_s)
    assert cell.mock.output == ("voltage", 0.0)
    cell.mock.forced_error = 5
    cell.run(0.01)
    cell.mock.forced_error = 0
    assert not cell.board.is_well_within(0.0)
    assert cell.board.is_well_within(0.6)
