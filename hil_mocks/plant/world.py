"""Plants of several arms in one world of MuJoCo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco

from hil_mocks.plant.build import PlantOptions, Standing, build, to_build
from hil_mocks.plant.effects import PlantEffects
from hil_mocks.plant.parts import ArmParts
from hil_mocks.plant.plant import Plant


@dataclass(frozen=True, slots=True)
class PlacedPlant:
    """What `plants_of` builds the plant of one arm from."""

    arm: ArmParts
    effects: PlantEffects
    start_rad: Sequence[float]
    options: PlantOptions
    standing: Standing


def plants_of(placed: Sequence[PlacedPlant]) -> list[Plant]:
    """Plants of several arms in one world; `step_together` advances them."""
    models = build([to_build(one.arm, one.effects, one.options, one.standing) for one in placed])
    state = mujoco.MjData(models[0].model)
    return [
        Plant(one.arm, one.effects, one.start_rad, one.options, (at, state))
        for one, at in zip(placed, models, strict=True)
    ]
