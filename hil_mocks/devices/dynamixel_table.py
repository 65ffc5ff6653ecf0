"""The control table of XM430 servos, from the ROBOTIS e-Manual: what may be written, its range, and its value at delivery."""

from __future__ import annotations

from typing import NamedTuple

RANGE_ERROR, LENGTH_ERROR, LIMIT_ERROR, ACCESS_ERROR = 0x04, 0x05, 0x06, 0x07
STORED_END, TABLE_BYTES = 64, 147  # what is below is kept without supply
RETURN_DELAY, MODE, MAX_VOLTAGE, MIN_VOLTAGE, CURRENT_LIMIT = 9, 11, 32, 34, 38
MAX_POSITION, MIN_POSITION, STARTUP, SHUTDOWN = 48, 52, 60, 63
TORQUE, RETURN_LEVEL, REGISTERED, ERROR_STATUS, WATCHDOG = 64, 68, 69, 70, 98
GOALS, GOAL_CURRENT, GOAL, VALUES = (100, 102, 104, 116), 102, 116, 126
GOAL_PWM, FULL_PWM = 100, 885
POSITION, EXTENDED, CURRENT_BASED = 3, 4, 5  # operating modes
WATCHDOG_EXPIRED = 0xFF
_TURNS_RANGE = 1_048_575  # of a goal position, but in the mode of one turn


class Item(NamedTuple):
    """What may be written at an address: bytes, lowest and highest value, value at delivery or power-up."""

    size: int
    lowest: int
    highest: int
    initial: int = 0


_GAIN = Item(2, 0, 16_383)
ITEMS = {
    7: Item(1, 0, 252, 1), 8: Item(1, 0, 7, 1), RETURN_DELAY: Item(1, 0, 254, 250), 10: Item(1, 0, 13),
    MODE: Item(1, 0, 16, POSITION), 12: Item(1, 0, 255, 255), 13: Item(1, 1, 2, 2), 20: Item(4, -1_044_479, 1_044_479),
    24: Item(4, 0, 1023, 10), 31: Item(1, 0, 100, 80), MAX_VOLTAGE: Item(2, 95, 160, 160), MIN_VOLTAGE: Item(2, 95, 160, 95),
    36: Item(2, 0, 885, 885), CURRENT_LIMIT: Item(2, 0, 1193, 1193), 44: Item(4, 0, 1023, 350),
    MAX_POSITION: Item(4, 0, 4095, 4095), MIN_POSITION: Item(4, 0, 4095), STARTUP: Item(1, 0, 3), SHUTDOWN: Item(1, 0, 255, 52),
    TORQUE: Item(1, 0, 1), 65: Item(1, 0, 1), RETURN_LEVEL: Item(1, 0, 2, 2),
    76: _GAIN._replace(initial=1920), 78: _GAIN._replace(initial=100), 80: _GAIN, 82: _GAIN,
    84: _GAIN._replace(initial=800), 88: _GAIN, 90: _GAIN, WATCHDOG: Item(1, 0, 127),
    GOAL_PWM: Item(2, -FULL_PWM, FULL_PWM, FULL_PWM), GOAL_CURRENT: Item(2, -1193, 1193, 1193), 104: Item(4, -1023, 1023),
    108: Item(4, 0, 32_767), 112: Item(4, 0, 32_767), GOAL: Item(4, -_TURNS_RANGE, _TURNS_RANGE),
}  # fmt: skip


def initial(begin: int) -> bytes:
    """The table from `begin` on, at delivery or power-up."""
    table = bytearray(TABLE_BYTES)
    for address, item in ITEMS.items():
        table[address : address + item.size] = item.initial.to_bytes(
            item.size, "little", signed=item.lowest < 0
        )
    return bytes(table[begin:])


def value(table: bytearray, address: int) -> int:
    """What stands at an address."""
    item = ITEMS[address]
    return int.from_bytes(table[address : address + item.size], "little", signed=item.lowest < 0)


def refusal(table: bytearray, address: int, data: bytes) -> int:
    """The number of the error with which a servo refuses to write `data`, 0 if it takes them."""
    at, end = address, address + len(data)
    if not data:
        return LENGTH_ERROR
    while at < end:
        item = ITEMS.get(at)
        if item is None or (at < STORED_END and table[TORQUE]):
            return ACCESS_ERROR
        if at + item.size > end:
            return LENGTH_ERROR
        written = int.from_bytes(
            data[at - address : at - address + item.size], "little", signed=item.lowest < 0
        )
        if error := _out_of_range(table, at, item, written):
            return error
        at += item.size
    return 0


def _out_of_range(table: bytearray, address: int, item: Item, written: int) -> int:
    lowest, highest = item.lowest, item.highest
    if address == GOAL and table[MODE] == POSITION:
        lowest, highest = value(table, MIN_POSITION), value(table, MAX_POSITION)
    if not lowest <= written <= highest or (address in GOALS and table[WATCHDOG] == WATCHDOG_EXPIRED):
        return RANGE_ERROR
    if address == GOAL_CURRENT and abs(written) > value(table, CURRENT_LIMIT):
        return LIMIT_ERROR
    return 0
