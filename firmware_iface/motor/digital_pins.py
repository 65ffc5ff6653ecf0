"""The digital pins of one motor board, seen from the host. docs/motor_board.md defines the frames."""

import math

from firmware_iface.errors import BoardRefused, ProtocolViolation, WrongIdentity
from firmware_iface.motor import wire
from firmware_iface.motor.board import MotorBoard
from firmware_iface.motor.bus import MotorBus
from firmware_iface.motor.wire import DigitalCommand, DigitalReply, MotorParameter


class DigitalPins:
    """Asks for levels and sets outputs; the bus delivers the replies. `reply` is the last one, None before the first."""

    def __init__(self, bus: MotorBus, board: MotorBoard) -> None:
        self.board = board
        self.reply: DigitalReply | None = None
        self.reply_at_s = -math.inf
        self._bus = bus
        self._sequence = 0
        bus.add_digital(board.node, self._take)

    def require(self, count: int) -> None:
        """WrongIdentity unless the board has at least `count` pins; BoardSilent if it does not answer."""
        try:
            found = self.board.read(MotorParameter.DIGITAL_PINS)
        except BoardRefused:
            raise WrongIdentity(
                f"{self.board.where}: has no digital pins, or a firmware that does not know them (parameter 48): remove its"
                " [[digital]] from arm.toml, or update it"
            ) from None
        if found < count:
            raise WrongIdentity(
                f"{self.board.where}: has {found} digital pins, 0 to {found - 1}, but arm.toml names pin {count - 1}"
            )

    def configure(self, outputs: int, safe_levels: int, safe_keep: int) -> None:
        """Write which pins are outputs, and what they do while the drive is not enabled; not while it is enabled."""
        self.board.write(MotorParameter.DIGITAL_SAFE_LEVELS, safe_levels)
        self.board.write(MotorParameter.DIGITAL_SAFE_KEEP, safe_keep)
        self.board.write(MotorParameter.DIGITAL_OUTPUTS, outputs)

    def command(self, mask: int, levels: int) -> None:
        """Set the outputs of `mask` and ask for all pins; does not wait. LinkLost."""
        self._sequence = (self._sequence + 1) & 0xFF
        payload = DigitalCommand(self._sequence, mask, levels).pack()
        self._bus.link.send(wire.DIGITAL_COMMAND_ID + self.board.node, payload)

    def _take(self, payload: bytes, now_s: float) -> None:
        if len(payload) != 8:
            problem = f"{self.board.where}: sent a DIGITAL_REPLY that is not 8 bytes long"
            self._bus.problems.append(ProtocolViolation(problem, payload))
            return
        reply = DigitalReply.unpack(payload)
        if reply.sequence == self._sequence:  # an older one says less than what is under way
            self.reply, self.reply_at_s = reply, now_s
