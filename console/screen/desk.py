"""One arm at the console: its link to the runtime, its operator, its jogs and its screen."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from console.lines import Grammar
from console.screen.dashboard import Dashboard
from console.screen.files import Files
from console.screen.jogging import Jogger
from console.screen.link import Message, RuntimeLink
from console.screen.operating import OperatingScreen
from console.screen.operator import MOVING, ScreenOperator
from console.specs.table import COMMANDS
from control.model.arm import Arm


@dataclass(frozen=True, slots=True)
class ArmAtDesk:
    """An arm to operate; `shared`: options for every subcommand, such as --arm and --socket."""

    arm: Arm
    socket: Path
    files: Files
    shared: Mapping[str, str]


class Desk:
    """Reports of lines and statuses go to its own screen."""

    def __init__(self, station: ArmAtDesk, open_session: Callable[[str], None], others: int) -> None:
        """`open_session` gets the options of a calibration session; `others`: how many arms there are beside it."""
        arm, files, self.shared = station.arm, station.files, dict(station.shared)
        self.arm_name = self.shared.get("--arm", arm.name)
        self.link = RuntimeLink(station.socket, arm, self._on_status)
        grammar = Grammar(COMMANDS, {flag.lstrip("-"): value for flag, value in self.shared.items()})
        words = [word for pair in self.shared.items() for word in pair]
        self.operator = ScreenOperator(self.link, grammar, words, self.say, files.lines)
        self.jogger = Jogger(arm, self.operator, self.say)
        dashboard = Dashboard(arm, self.operator, self.jogger)
        self.operating = OperatingScreen(
            dashboard, self.operator, self.jogger, files, open_session, has_others=others > 0
        )

    def say(self, text: str, is_error: bool = False) -> None:
        """Write a line to the log."""
        if self.operating.is_mounted:
            self.operating.say(text, is_error)

    @property
    def is_resting(self) -> bool:
        """Whether the arm does not move, as far as is known."""
        return self.link.status is not None and self.link.status["mode"] not in MOVING

    async def _on_status(self, status: Message | None) -> None:
        if status is None:
            await self.operating.let_go()
        elif self.jogger.has_jogged and status["mode"] not in ("JOGGING", "STOPPING"):
            self.jogger.has_jogged = False
            if status["is_homed"] and status["mode"] == "HOLDING":
                angles = " ".join(f"{q:.5f}" for q in status["joint_rad"])
                self.operator.record(f"move --joints {angles} --speed 0.2")
        if self.operating.is_mounted:
            self.operating.show(status)
