"""Who may command the arm: one client at a time. Everybody may watch, and everybody may stop.

A client is in control as long as something goes on that it began (a motion, a jog, homing, hand guiding), or from `control`
with `take` until it releases it. Both end with its connection. Connections that gave the same key are one client: the console
and the commands that it starts.

A client that hangs keeps control as long as its connection stands: it may be a session whose operator thinks. So nothing ends
it by the clock; somebody else may revoke it, which stops the arm, and the client then commands no more until it connects again.
"""

from control.errors import ArmError
from control.safety.table import TRAVELLING_MODES, Mode
from control.server.messages import STOPPING, WATCHING

_GOING_ON = TRAVELLING_MODES | {Mode.GUIDING}
_IN_WORDS = {
    Mode.JOGGING: "another client jogs the arm (client {client}): wait until it ends, or stop it (`armwright stop`)",
    Mode.GUIDING: "client {client} has the arm guided by hand: `armwright hold` or `armwright stop` ends that",
}
_MOVES = "client {client} has control, and the arm is {mode}: wait until it has ended, or stop it (`armwright stop`)"
_TAKEN = (
    "client {client} has taken control of the arm: wait until it releases it or ends; `armwright stop` stops the arm,"
    " `armwright stop --take` also ends that client's control"
)
_REVOKED = "somebody has taken control from this client (`armwright stop --take`): start it again when the arm is yours"


class ControlRight:
    """The owner of what goes on, the client that has taken control, and keys of connections that belong together."""

    def __init__(self) -> None:
        self._keys: dict[int, str] = {}
        self._owner: int | None = None
        self._taker: int | None = None
        self._revoked: set[int] = set()

    def join(self, client: int, key: str) -> None:
        """Count the connection with those of the same key."""
        self._keys[client] = key

    def own(self, client: int | None) -> None:
        """What begins now belongs to this connection; None: to nobody (detached)."""
        self._owner = client

    def owns(self, client: int, mode: Mode) -> bool:
        """Whether something goes on that this very connection began, which ends with it."""
        return client == self._owner and mode in _GOING_ON

    def take(self, client: int, mode: Mode) -> None:
        """Keep control until `release` or the end of the connection. ArmError if somebody else has it."""
        self.require(client, "control", mode, is_command=True)
        self._taker = client

    def release(self, client: int) -> None:
        """Give up what `take` took."""
        if self._taker is not None and self._are_one(client, self._taker):
            self._taker = None

    def revoke(self, client: int, mode: Mode) -> None:
        """End the control of another client, and of those that share its key, until they connect again."""
        holder = self.holder(mode)
        if holder is None or self._are_one(client, holder):
            return
        self._revoked |= {holder} | {other for other in self._keys if self._are_one(other, holder)}
        self._owner = self._taker = None

    def holder(self, mode: Mode) -> int | None:
        """The connection in control; None: the next command takes it."""
        if self._taker is not None:
            return self._taker
        return self._owner if mode in _GOING_ON else None

    def require(self, client: int, do: str, mode: Mode, is_command: bool = False) -> None:
        """ArmError if `do` is a command and another client is in control."""
        if not is_command and (do in WATCHING or do in STOPPING or (do == "hold" and mode is Mode.GUIDING)):
            return
        if client in self._revoked:
            raise ArmError(_REVOKED)
        holder = self.holder(mode)
        if holder is None or self._are_one(client, holder):
            return
        text = _TAKEN if self._taker is not None else _IN_WORDS.get(mode, _MOVES)
        raise ArmError(text.format(client=holder, mode=mode.name))

    def gone(self, client: int) -> None:
        """The connection has ended."""
        self._keys.pop(client, None)
        self._revoked.discard(client)
        if client == self._taker:
            self._taker = None
        if client == self._owner:
            self._owner = None

    def _are_one(self, client: int, other: int) -> bool:
        return client == other or (client in self._keys and self._keys[client] == self._keys.get(other))
