"""What a session asks of its operator in words: at a board, or of two arms in contact."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from calib.points.writer import DISTANCE, Record
from calib.session.dialogue import Ask, Question
from calib.session.moves import Vector
from calib.session.plan import SessionPlan, Target
from control.model.arm import Table


class Words(Protocol):
    """Of one kind of session. `cavities_m`: of its board, for a drawing."""

    cavities_m: Mapping[str, Vector]

    def question(self, ask: Ask, target: Target) -> str:
        """The request to the operator."""

    def check(self, record: Record) -> str:
        """What to look at when a record departs from the others."""


class BoardWords:
    """At the cavities of a board, and at free poses."""

    def __init__(self, plan: SessionPlan, cavities_m: Mapping[str, Vector], table: Table | None) -> None:
        self._plan, self.cavities_m, self._table = plan, cavities_m, table

    def question(self, ask: Ask, target: Target) -> str:
        """The request to the operator."""
        if ask.question is Question.BOARD:
            return f"set the board to {self._tilt(target.setup)}; Enter when it is in place"
        if ask.question is Question.NEXT:
            side = f" from side {target.approach}" if self._plan.approaches > 1 and not target.is_free else ""
            where = "the pose" if target.is_free else f"above the cavity{side}"
            return f"hands off; Enter moves the arm to {where}"
        if ask.question is Question.TAKE:
            return "hold the arm by hand; Enter turns its drives off"
        if self._plan.seat == "jog":
            return f"jog the tip into cavity {target.point} (`jog z -5`); Enter when it is seated"
        return f"seat the tip in cavity {target.point} and hold it there; Enter when it is seated"

    def check(self, record: Record) -> str:
        """What to look at when a record departs from the others."""
        return f"that the tip is seated in {record.point}, the right cavity"

    def _tilt(self, setup: str) -> str:
        if self._table is None:
            return setup
        angles = {
            "normal": "normal: level",
            "roll": f"roll: {np.degrees(self._table.roll_tilt_rad):.1f} deg about its x axis",
            "pitch": f"pitch: {np.degrees(self._table.pitch_tilt_rad):.1f} deg about its y axis",
        }
        return angles.get(setup, setup)


class ContactWords:
    """Of two arms whose tips are brought together."""

    cavities_m: Mapping[str, Vector] = {}

    def __init__(self, plan: SessionPlan, names: tuple[str, str]) -> None:
        self._plan, self._names = plan, names

    def question(self, ask: Ask, target: Target) -> str:
        """The request to the operator."""
        far = (
            f"{1e3 * target.distance_m:g} mm from the other" if target.distance_m else "where the other's is"
        )
        if ask.question is Question.NEXT:
            return "hands off both arms; Enter moves them to where their tips can meet"
        if ask.question is Question.TAKE:
            return f"hold arm {ask.arm} by hand; Enter turns its drives off"
        if self._plan.seat == "jog":
            return f"jog the tips together, one {far} (`jog {self._names[0]} z -5`); Enter when they are in contact"
        place = "its place of the contact" if ask.arm == self._names[0] else far
        return f"bring the tip of {ask.arm} to {place} and hold it there; Enter turns its drives on"

    def check(self, record: Record) -> str:
        """What to look at when a record departs from the others."""
        distance_m = float(record.more[DISTANCE])
        return f"that both tips were in contact{f', {1e3 * distance_m:g} mm apart' if distance_m else ''}"
