"""The named pins of an arm's motor boards, for the loop."""

from collections.abc import Mapping, Sequence

from control.model.end_effector import Digital
from firmware_iface.motor.digital_pins import DigitalPins

STALE_s = 0.2  # ten questions; older levels are unknown


class NamedPins:
    """Sets outputs and reads levels by name."""

    def __init__(self, described: Sequence[Digital], boards: Mapping[int, DigitalPins]) -> None:
        self._described = tuple(described)
        self._boards = boards
        self._resets = dict.fromkeys(boards, -1)

    def configure(self) -> None:
        """Tell each board, where it does not know it, which pins are outputs and what is safe. Waits; not while it is enabled."""
        for node, pins in self._boards.items():
            if self._resets[node] == pins.board.resets:
                continue
            of_board = [pin for pin in self._described if pin.board == node and pin.direction == "output"]
            pins.configure(
                sum(1 << pin.pin for pin in of_board),
                sum(1 << pin.pin for pin in of_board if pin.safe == "high"),
                sum(1 << pin.pin for pin in of_board if pin.safe == "keep"),
            )
            self._resets[node] = pins.board.resets

    def command(self, wanted: Mapping[str, bool]) -> None:
        """Set the outputs that are in `wanted`, and ask for all levels; does not wait. LinkLost."""
        for node, pins in self._boards.items():
            of_board = [pin for pin in self._described if pin.board == node and pin.name in wanted]
            mask = sum(1 << pin.pin for pin in of_board)
            pins.command(mask, sum(1 << pin.pin for pin in of_board if wanted[pin.name]))

    def levels(self, now_s: float) -> dict[str, bool | None]:
        """Levels at the pins; None while a board does not say."""
        found: dict[str, bool | None] = {}
        for pin in self._described:
            board = self._boards[pin.board]
            reply = board.reply if now_s - board.reply_at_s <= STALE_s else None
            found[pin.name] = None if reply is None else bool(reply.levels >> pin.pin & 1)
        return found
