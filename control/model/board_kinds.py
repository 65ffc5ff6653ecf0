"""Kinds of boards that drive joints, as data: what each offers, and what the loop may expect of it.

A `[[drive]]` without `board` is on a reference motor board (docs/motor_board.md): REFERENCE. `control.hardware.connect` opens the
others; each has a page in docs. Imports nothing of the model: the command line's help reads it.
"""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, Literal


@dataclass(frozen=True, slots=True)
class BoardKind:
    """What a board offers. `modes` are those of [drive.pid], the usual one first."""

    line: Literal["serial", "can"]
    addresses: range  # on its line
    modes: tuple[Literal["voltage", "current", "position"], ...]
    can_free: bool  # opens the motor's circuit; else a hand moves the joint against shorted windings
    can_hold: bool  # brings its joint to rest and holds it without the host
    usual_rate_Hz: float  # of the loop
    motors: int = 1  # on one board
    has_encoder: bool = True  # its own, which the loop can use
    is_absolute: bool = False  # that encoder knows its place within one turn at power-up: there is nothing to home
    stops_early: bool = False  # begins its own stop some cycles after the last command, not only at its watchdog
    limits_force: bool = False  # in position mode, to what the host says: it can drive a gripper
    limits_current: bool = False  # it takes `current_limit_A` from the host; else its own settings alone limit the current
    needs_fd: bool = False  # it speaks CAN FD alone
    needs_own_bus: bool = False  # takes reference boards' frames for its own, and they take its
    uses_other_encoder: bool = True  # in modes other than position; else it closes its loop on its own in every mode
    may_be_absolute: bool = False  # as is_absolute, where its settings make it so: `absolute` of [[board]]
    frees_in: tuple[str, ...] = ()  # modes in which it frees its motor without the host: nothing stops the joint
    moves_on: bool = False  # in position mode at the speed of the last command; else it stays at its position
    current_step_A: float = 0.0  # to which it rounds the current, where that is much
    current_is_newest: bool = True  # measured after the last command; else before the one that it answers
    counts_per_turn: int = 0  # that it sends, whatever the encoder; 0: its encoder's
    first_count: int | None = None  # of the turn that an absolute encoder knows; None: its settings say
    highest_supply_V: float = math.inf  # of its usual types
    cycle_bits: int = 0  # of a CAN bus with worst stuffing, in each cycle of the loop: its command, and what answers it
    shared_bits: int = 0  # the same, once for all boards of a bus
    sent_bits_s: float = 0.0  # of what it sends unasked, at the rates that its page asks for
    has_switch: bool = True  # reads a home switch, where it does not know the joint's angle
    has_limit_inputs: bool = False  # says of limit switches at its own inputs
    limits_are_levels: bool = True  # it says their levels; else whether a switch is met, by its own settings
    switch_inputs: int = 1  # of each motor, for home and limit switches


REFERENCE: Final = BoardKind(
    line="can",
    addresses=range(1, 16),
    modes=("voltage", "current", "position"),
    has_encoder=False,  # what the loop uses is the encoder board's
    can_free=True,
    can_hold=True,
    usual_rate_Hz=500.0,
    stops_early=True,
    limits_current=True,
    current_is_newest=False,
    cycle_bits=2 * 135,  # 8 bytes each
)

KINDS: Final[Mapping[str, BoardKind]] = MappingProxyType(
    {
        "roboclaw": BoardKind(
            line="serial",
            motors=2,
            addresses=range(0x80, 0x88),
            modes=("voltage",),
            can_free=False,
            can_hold=False,
            usual_rate_Hz=100.0,
            limits_current=True,
            highest_supply_V=34.0,
            has_limit_inputs=True,
            limits_are_levels=False,
        ),
        "cia402": BoardKind(
            line="can",
            addresses=range(1, 127),
            modes=("position", "current"),
            can_free=True,
            can_hold=True,
            usual_rate_Hz=250.0,
            limits_force=True,
            needs_own_bus=True,
            uses_other_encoder=False,
            cycle_bits=125 + 75 + 2 * 135,  # its PDOs of 7, 2, 8 and 8 bytes
            shared_bits=55,  # SYNC
            has_limit_inputs=True,
            switch_inputs=3,
        ),
        "dynamixel": BoardKind(
            line="serial",
            addresses=range(253),
            modes=("position",),
            is_absolute=True,
            can_free=True,
            can_hold=True,
            usual_rate_Hz=100.0,
            limits_force=True,
            counts_per_turn=4096,
        ),
        "feetech": BoardKind(
            line="serial",
            addresses=range(253),
            modes=("position",),
            is_absolute=True,
            can_free=True,
            can_hold=True,
            usual_rate_Hz=100.0,
            limits_force=True,
            counts_per_turn=4096,
            first_count=0,
        ),
        "moteus": BoardKind(
            line="can",
            addresses=range(1, 128),
            modes=("position", "current"),
            can_free=True,
            can_hold=True,
            usual_rate_Hz=250.0,
            limits_force=True,
            limits_current=True,
            needs_fd=True,
            highest_supply_V=44.0,
            may_be_absolute=True,
            moves_on=True,
            cycle_bits=355,  # as long at 1 Mbit/s; what is sent at 5 Mbit/s counts a fifth
        ),
        "odrive": BoardKind(
            line="can",
            addresses=range(63),
            modes=("position", "current"),
            can_free=True,
            can_hold=True,
            usual_rate_Hz=250.0,
            limits_force=True,
            limits_current=True,
            needs_own_bus=True,
            may_be_absolute=True,
            moves_on=True,
            frees_in=("current",),
            has_switch=False,
            cycle_bits=135,
            sent_bits_s=135 * (2 * 250 + 2 * 100 + 10),  # encoder, IQ; heartbeat, bus; temperature
        ),
        "vesc": BoardKind(
            line="can",
            addresses=range(254),
            modes=("voltage", "current", "position"),
            can_free=True,
            can_hold=False,
            usual_rate_Hz=200.0,
            limits_current=True,
            counts_per_turn=18_000,
            current_step_A=0.1,
            cycle_bits=120,  # 4 bytes, with a 29-bit id
            shared_bits=150 + 160,  # the question for a fault code, and its answer
            sent_bits_s=160 * (4 * 200 + 2 * 5),  # status 1, 4, 5, 6; 2, 3
        ),
    }
)


def bus_conflict(kinds: Collection[str]) -> str | None:
    """Why boards of these kinds cannot share a CAN bus, "" for the reference boards; None if they can."""
    alone = sorted(kind for kind in set(kinds) if kind and KINDS[kind].needs_own_bus)
    others = [*alone[1:], *(["reference motor boards"] if alone and "" in kinds else [])]
    if not others:
        return None
    return f"no {alone[0]} beside {others[0]} on one CAN bus: each takes the other's frames for its own"
