"""The true board pose in a mock session with an unknown board."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from calib.design.candidates import OTHER_TILTS, tilted
from calib.session.moves import Vector
from calib.session.plan import Target
from control.model import table as tables
from control.model.arm import Table

ORIGIN_m = (0.5, 0.0, 0.0)  # if the file gives none: that of the reference arm
SHIFT_m, TURN_rad = 0.02, 0.03


def hidden_place(table: Table, seed: int) -> Callable[[Target], Vector]:
    """Cavities in the base frame of a board some centimetres and degrees off nominal, different by setup."""
    known = replace(table, known_pose=True, origin_m=table.origin_m or ORIGIN_m)
    cavities = tables.board_cavities(known)

    def place(target: Target) -> Vector:
        draw = random.Random(f"board {seed} {target.setup}")
        shift = np.array(
            [draw.uniform(-SHIFT_m, SHIFT_m), draw.uniform(-SHIFT_m, SHIFT_m), draw.uniform(0.0, SHIFT_m)]
        )
        ax, ay, az = (draw.uniform(-TURN_rad, TURN_rad) for _ in range(3))
        skew = np.array([[0.0, -az, ay], [az, 0.0, -ax], [-ay, ax, 0.0]])
        turn = np.linalg.solve(np.eye(3) - 0.5 * skew, np.eye(3) + 0.5 * skew)  # Cayley: a rotation
        setup = target.setup if target.setup in (*tables.SETUPS, *OTHER_TILTS) else "normal"
        place = tilted(known, setup) @ np.array(cavities[target.point])
        x, y, z = (turn @ place + np.array(known.origin_m) + shift).tolist()
        return x, y, z

    return place
