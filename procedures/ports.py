"""Adapters of runtime, mock hand and camera to the interfaces of a session (calib.session.moves)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from calib.session.moves import RestSample, SeenTip, Vector
from calib.session.plan import Target
from control.errors import ArmError
from control.hardware.measurement import Average
from control.server.channel import RuntimeGone
from control.server.client import ArmClient, ArmFaulted, fault_text

if TYPE_CHECKING:
    from hil_mocks.rig import MockHand  # imports the physics

SEATED_m = 2e-4  # a tip this close to the hand is seated
CAMERA_PATIENCE_S = 2.0  # a marker may be hidden for a moment, a host may pause
SEAT_PATIENCE = 3.0  # times the duration that the hand predicts
ARRIVAL_MARGIN_S = 5.0
CREEP = 0.1  # of the speed of other moves


class RuntimePort:
    """`ArmPort` and `Camera` over the runtime's client."""

    def __init__(self, client: ArmClient, speed: float = 1.0, as_encoders: bool = False, in_own_frame: bool = False) -> None:
        """`as_encoders`: moves are to encoder angles, without the runtime's gear corrections (docs/corrections.md).

        in_own_frame: tips may be in a camera's frame of unknown place.
        """
        self._client = client
        self._speed = speed
        self._as_encoders, self._in_own_frame = as_encoders, in_own_frame

    def now_s(self) -> float:
        """The runtime's time."""
        return float(self._client.status()["t_s"])

    def move_to_q(self, q_rad: Sequence[float]) -> None:
        """Joint move; returns when the arm holds there."""
        self._client.move_joints(q_rad, self._speed, as_encoders=self._as_encoders)

    def creep_to_q(self, q_rad: Sequence[float]) -> None:
        """A slow joint move, for jogging."""
        self._client.move_joints(q_rad, CREEP * self._speed, as_encoders=self._as_encoders)

    def release(self) -> None:
        """Open the motor circuits for hand guiding."""
        self._client.guide()

    def hold(self) -> None:
        """Hold the present pose."""
        status = self._client.status()
        if status["mode"] == "FAULT":
            raise ArmFaulted(fault_text(status))
        if status["mode"] != "HOLDING":
            self._client.hold()

    def average(self, duration_s: float) -> RestSample:
        """Mean of encoders and currents, and the drives' temperature now."""
        mean = self._client.average(duration_s)
        warmth = tuple(math.nan if t is None else float(t) for t in self._client.status()["temperature_C"])
        return RestSample(mean.q_rad, mean.q_std_rad, mean.current_A, mean.direction, warmth, self._seen(mean), mean.count_rad)

    def measure(self, duration_s: float) -> SeenTip:
        """Mean of the camera's tips. ArmError, with the camera's reason, if there are none."""
        for _ in range(1 + int(CAMERA_PATIENCE_S / duration_s)):
            if (seen := self._seen(self._client.average(duration_s))) is not None:
                return seen
        raise ArmError(
            f"no camera frame within {CAMERA_PATIENCE_S:g} s{camera_said(self._client)}: check that the camera is on and"
            " sees the tip"
        )

    def _seen(self, mean: Average) -> SeenTip | None:
        """None where no frame came, or one in a frame that nobody has placed."""
        seen = mean.target
        if seen is None or (mean.tip_m is None and not self._in_own_frame):
            return None
        return SeenTip(seen.position_m, seen.std_m, seen.orientation)


def camera_said(client: ArmClient) -> str:
    """Why the camera measures no tip now, in brackets; empty if it says nothing."""
    said = client.status()["camera_problem"]
    return f" ({said})" if said else ""


class MockHandSeat:
    """`calib.session.conduct.AutomaticHand` by the mock arm's hand, which knows the true cavities."""

    def __init__(self, hand: HandPort, place_of: Callable[[Target], Vector]) -> None:
        self._hand, self._place_of = hand, place_of

    def grip(self) -> None:
        """Grip the tip."""
        self._hand.grip()

    def seat(self, target: Target) -> None:
        """Drag the tip to the cavity; returns when it is seated."""
        self._hand.seat(self._place_of(target))

    def let_go(self) -> None:
        """Release the tip."""
        self._hand.let_go()


class HandPort:
    """`TipSeat` by the mock arm's hand."""

    def __init__(self, hand: MockHand, wait: Callable[[float], None]) -> None:
        self._hand = hand
        self._wait = wait

    def grip(self) -> None:
        """Nothing to do: the mock hand is faster than gravity."""

    def seat(self, point_m: Vector) -> None:
        """Drag the tip to the cavity; returns when it is seated. ArmError if that fails."""
        duration_s = self._hand.seat(point_m)
        self._wait(duration_s)
        for _ in range(int(SEAT_PATIENCE / 0.1)):
            if self._hand.state == "holding" and self._hand.residual_m() < SEATED_m:
                return
            self._wait(0.1)
        raise ArmError(
            f"the mock hand did not seat the tip at {point_m}: {self._hand.state}, {1e3 * self._hand.residual_m():.2f} mm away"
        )

    def let_go(self) -> None:
        """Release the tip."""
        self._hand.let_go()


def move_together(clients: Mapping[str, ArmClient], moves: Mapping[str, Any]) -> None:
    """Motions of several arms that begin and end together (docs/socket.md); returns when all have arrived.

    ArmFaulted if one of them is in FAULT.
    """
    first = next(iter(moves))
    try:
        duration_s = clients[first].ask("move_together", moves=moves)["duration_s"]
        for name in moves:
            clients[name].arrive(duration_s + ARRIVAL_MARGIN_S)
    except (ArmFaulted, RuntimeGone):
        raise
    except ArmError:  # it may be the other arm's fault that stops this one
        for name in moves:
            if (status := clients[name].status())["mode"] == "FAULT":
                raise ArmFaulted(f"{name}: {fault_text(status)}") from None
        raise
