"""The whole transition table of CiA 402 (IEC 61800-7-201), written out, against the host's and the document's."""

from itertools import product

import pytest

from firmware_iface.motor.cia402 import STATE_OF_STATUSWORD, TRANSITIONS, DriveCommand, DriveState, after, next_command
from tests.places import ROOT

# Rows: states. Columns: shutdown, switch on, enable operation, disable voltage, quick stop, fault reset.
# "." stays. NR, SD, RS, SO, OE, QS, FR, FT are the states in the order of State.
COLUMNS = ("SHUTDOWN", "SWITCH_ON", "ENABLE_OPERATION", "DISABLE_VOLTAGE", "QUICK_STOP", "FAULT_RESET")
TABLE = """
NR  .  .  .  .  .  .
SD  RS .  .  .  .  .
RS  .  SO SO SD SD .
SO  RS .  OE SD SD .
OE  RS SO .  SD QS .
QS  .  .  .  SD .  .
FR  .  .  .  .  .  .
FT  .  .  .  .  .  SD
"""
SHORT = dict(zip(("NR", "SD", "RS", "SO", "OE", "QS", "FR", "FT"), DriveState, strict=True))
ROWS = {cells[0]: cells[1:] for cells in (line.split() for line in TABLE.strip().splitlines())}


@pytest.mark.parametrize(("short", "column"), [*product(SHORT, range(6))])
def test_every_command_in_every_state_does_what_the_table_says(short: str, column: int) -> None:
    target = ROWS[short][column]
    expected = SHORT[short if target == "." else target]
    assert after(SHORT[short], DriveCommand[COLUMNS[column]]) is expected


def test_the_document_has_the_same_table() -> None:
    document = (ROOT / "docs/motor_board.md").read_text()
    table = document.split("| from \\ command |")[1].split("\n\n")[0].splitlines()[2:]
    found = {}
    for line in table:
        origins, *targets = (cell.strip() for cell in line.strip("|").split("|"))
        for origin in origins.split(", "):
            for column, target in zip(COLUMNS, targets, strict=True):
                if target:
                    found[DriveState(origin), DriveCommand[column]] = DriveState(target.split(" (")[0])
    assert found == dict(TRANSITIONS)


@pytest.mark.parametrize("state", DriveState)
def test_free_bits_of_the_statusword_do_not_change_the_state(state: DriveState) -> None:
    words = [word for word in range(256) if STATE_OF_STATUSWORD[word] is state]
    for word in words:
        assert STATE_OF_STATUSWORD[word ^ 0x10] is state  # voltage enabled
        assert STATE_OF_STATUSWORD[word ^ 0x80] is state  # warning
    assert words


@pytest.mark.parametrize(
    ("statusword", "state"),
    [
        (0x00, DriveState.NOT_READY_TO_SWITCH_ON),
        (0x20, DriveState.NOT_READY_TO_SWITCH_ON),
        (0x40, DriveState.SWITCH_ON_DISABLED),
        (0x60, DriveState.SWITCH_ON_DISABLED),
        (0x21, DriveState.READY_TO_SWITCH_ON),
        (0x23, DriveState.SWITCHED_ON),
        (0x27, DriveState.OPERATION_ENABLED),
        (0x07, DriveState.QUICK_STOP_ACTIVE),
        (0x0F, DriveState.FAULT_REACTION_ACTIVE),
        (0x2F, DriveState.FAULT_REACTION_ACTIVE),
        (0x08, DriveState.FAULT),
        (0x28, DriveState.FAULT),
        (0x01, None),
        (0x03, None),
        (0x41, None),
        (0x0A, None),
        (0x48, None),
    ],
)
def test_statuswords_are_those_of_the_standard(statusword: int, state: DriveState | None) -> None:
    assert STATE_OF_STATUSWORD[statusword] is state


@pytest.mark.parametrize(("origin", "target"), [*product(DriveState, DriveState)])
def test_a_way_is_followed_to_its_end_and_never_through_enabled_or_a_fault(origin: DriveState, target: DriveState) -> None:
    at, visited = origin, [origin]
    while at is not target and (command := next_command(at, target)) is not None:
        assert command is not DriveCommand.FAULT_RESET
        at = after(at, command)
        visited.append(at)
        assert len(visited) < 6
    between = visited[1:-1]
    assert DriveState.OPERATION_ENABLED not in between
    reachable = {
        DriveState.SWITCH_ON_DISABLED,
        DriveState.READY_TO_SWITCH_ON,
        DriveState.SWITCHED_ON,
        DriveState.OPERATION_ENABLED,
    }
    if origin in reachable | {DriveState.QUICK_STOP_ACTIVE} and target in reachable:
        assert at is target
    if target is DriveState.QUICK_STOP_ACTIVE and origin is not target:
        assert (at is target) == (origin is DriveState.OPERATION_ENABLED)


def test_nothing_leads_out_of_a_fault_but_a_reset() -> None:
    for target in set(DriveState) - {DriveState.FAULT}:
        assert next_command(DriveState.FAULT, target) is None
