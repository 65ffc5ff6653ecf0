"""Jogging by keys and buttons: selection, speed, and the end of a jog that is not renewed."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from console.screen.drawing import Row, row
from console.screen.operator import JogTarget, ScreenOperator
from control.model.arm import Arm
from control.motion.joint_limits import JogLimits, TURN_SPEED_rad_s

SPEEDS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # of a jog's limit
STEPS_rad = (0.0005, 0.001, 0.005, 0.02, 0.1)
STEPS_m = (0.0001, 0.0005, 0.001, 0.005, 0.02)
RENEW_S = 0.05
UNSEEN_S = 2.0  # a held button without mouse events for this long: the terminal may be lost


class Jogger:
    """Converts key presses and held buttons to jogs and steps."""

    def __init__(self, arm: Arm, operator: ScreenOperator, say: Callable[[str, bool], None]) -> None:
        self.targets = [*(JogTarget(j + 1, None) for j in range(arm.joint_count)), *(JogTarget(None, axis) for axis in "xyz")]
        self.turns = [JogTarget(None, f"r{axis}") for axis in "xyz"]  # by keys alone: 80 columns have no room for more buttons
        self.of_tip = False
        self.selected = self.targets[0]
        self.speed = 0.2
        self.is_stepping = False
        self.run: int | None = None  # of a jog whose end was not seen yet: an older status says nothing of it
        self.unseen_s = UNSEEN_S
        self._step_at = 2
        self._joint_count, self._limits = arm.joint_count, JogLimits.of(arm)
        self._operator, self._say = operator, say
        self._key = HeldKey()
        self._held: tuple[JogTarget, int] | None = None
        self._seen_s = 0.0

    def describe(self) -> Row:
        """Describe what the arrow keys do."""
        size = f"{STEPS_rad[self._step_at]:g} rad" if self.selected.is_angle else f"{1e3 * STEPS_m[self._step_at]:g} mm"
        how = f" step {size}" if self.is_stepping else " hold the key"
        of_tip = " of the tip" if self.of_tip and self.selected.joint is None else ""
        return row((self.selected.name, "chosen"), f"{of_tip}{how}, {100 * self.speed:g} %")

    def toggle_frame(self) -> None:
        """Jog along and about the axes of the tip, or of the base again."""
        self.of_tip = not self.of_tip
        self._key.forget()

    def _of_frame(self, target: JogTarget) -> JogTarget:
        return replace(target, of_tip=self.of_tip and target.joint is None)

    def select(self, name: str) -> None:
        """Select what the arrow keys jog; an unknown name changes nothing."""
        for target in (*self.targets, *self.turns):
            if target.name == name:
                self.selected = target
                self._key.forget()

    async def press(self, sign: int) -> None:
        """Process a press or repeat of an arrow key."""
        press = self._key.press(f"{self.selected.name}{sign}", time.monotonic())
        if self.is_stepping:
            self._step(self.selected, sign)
        elif press.is_due:
            await self._jog(self.selected, sign)

    async def hold(self, target: JogTarget, sign: int) -> None:
        """Process a button press."""
        self.selected = target
        if self.is_stepping:
            self._step(target, sign)
        else:
            self._held = (target, sign)
            self.see()
            await self._jog(target, sign)

    def see(self) -> None:
        """Note a mouse event: the terminal is alive."""
        self._seen_s = time.monotonic()

    async def renew(self) -> bool:
        """Renew the jog of the held button; False if there was no mouse event for too long."""
        if self._held is None:
            return True
        if time.monotonic() - self._seen_s > self.unseen_s:
            self._say(f"jog button released: no mouse event for {self.unseen_s:g} s", True)
            return False
        await self._jog(*self._held)
        return True

    async def let_go(self) -> None:
        """Release everything: mouse up, focus lost."""
        held, self._held = self._held, None
        self._key.forget()
        if held is not None or self.run is not None:
            await self._operator.let_go(self.selected, self._joint_count)

    def change_step(self, by: int) -> None:
        """Make steps smaller or larger."""
        self._step_at = min(max(self._step_at + by, 0), len(STEPS_rad) - 1)

    def change_speed(self, by: int) -> None:
        """Jog slower or faster."""
        self.speed = neighbour(SPEEDS, self.speed, by)

    def _step(self, target: JogTarget, sign: int) -> None:
        sizes = STEPS_rad if target.is_angle else STEPS_m
        target = self._of_frame(target)
        self._operator.step(target, sign * sizes[self._step_at], round(self._fastest(target) * self.speed, 6))

    async def _jog(self, target: JogTarget, sign: int) -> None:
        speed = sign * self.speed * self._fastest(target)
        run = await self._operator.jog(self._of_frame(target), speed, self._joint_count)
        self.run = self.run if run is None else run

    def _fastest(self, target: JogTarget) -> float:
        """Largest speed of a jog, rad/s or m/s."""
        if target.joint is None:
            return TURN_SPEED_rad_s if target.is_angle else self._limits.tip_speed_m_s
        return self._limits.joints.speed_rad_s[target.joint - 1]


def neighbour(values: tuple[float, ...], now: float, by: int) -> float:
    """The value `by` places after the one nearest to `now`."""
    at = min(range(len(values)), key=lambda i: abs(values[i] - now))
    return values[min(max(at + by, 0), len(values) - 1)]


# Detects whether a key is still held; terminals report presses but not releases.
#
# A held key repeats after a delay of a quarter to half a second, then 10 to 40 times a second. So each press that
# arrives renews the jog, and nothing else does: the first press moves the arm a little (until the runtime's dead man's
# switch ends it), repeats keep it moving, and when they stop, for whatever reason, the arm stops.
REPEAT_s = 0.2  # closer presses of a key count as holding it
RENEWAL_least_s = 0.04  # closer renewals are skipped


@dataclass(frozen=True, slots=True)
class Press:
    """Meaning of a key press: whether it starts a jog, and whether to notify the runtime."""

    is_new: bool
    is_due: bool


class HeldKey:
    """Follows the presses of jog keys."""

    def __init__(self) -> None:
        self._key = ""
        self._pressed_s = self._sent_s = -1e9

    def press(self, key: str, now_s: float) -> Press:
        """Process a press of `key` at a time of any monotonic clock."""
        is_new = key != self._key or now_s - self._pressed_s > REPEAT_s
        is_due = is_new or now_s - self._sent_s >= RENEWAL_least_s
        self._key, self._pressed_s = key, now_s
        if is_due:
            self._sent_s = now_s
        return Press(is_new, is_due)

    def forget(self) -> None:
        """Treat the next press as a new one."""
        self._key = ""
