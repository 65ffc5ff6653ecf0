"""Every effect of the gap workflow by name, and what the records say together."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from calib.arm_problem.joint_effects import LAWS
from calib.arrays import Array
from calib.gap.effects import encoder, gear, links, loads, motor
from calib.gap.effects.record import EffectRecord, InPoses, InSeries, PoseScene, Role, Sought, known_law, unlisted
from calib.gap.finding import EffectName, Parameters
from calib.gap.posterior.constants import USUAL
from calib.gap.posterior.term import Block, Key, Term, parameters_of
from calib.gap.residuals.scene import OperatingPoint, SeriesScene, SeriesTerm
from calib.gap.signals.terms import Law, place
from control.model.arm import Arm
from control.model.effects import EFFECTS

RECORDS: Final[dict[str, EffectRecord]] = {
    record.effect: record for record in (*encoder.RECORDS, *gear.RECORDS, *links.RECORDS, *loads.RECORDS, *motor.RECORDS)
}


# What both poses and time series may show of an arm, by one set of linear unknowns; what warms up does so anew in each session.
SHARED: Final = tuple(
    name
    for name, record in RECORDS.items()
    if record.poses is not None and record.series is not None and name in LAWS and not EFFECTS[name].alike
)


def poses_of(effect: str) -> InPoses | None:
    """How an effect is looked for in poses, if it is."""
    return RECORDS[effect].poses if effect in RECORDS else None


def series_of(effect: str) -> InSeries | None:
    """How an effect is looked for in time series, if it is."""
    return RECORDS[effect].series if effect in RECORDS else None


def pose_terms(scene: PoseScene, effects: Collection[str] = RECORDS.keys()) -> tuple[Term, ...]:
    """Every effect on every joint or link, in every variant, that these poses could show; `effects`: only these."""
    return tuple(
        term
        for record in RECORDS.values()
        if record.poses is not None and record.effect in effects
        for term in record.poses.terms(record, scene)
    )


def are_total_in_poses(effect: str) -> bool:
    """Whether poses look for what the file has of an effect as a whole."""
    return (poses := poses_of(effect)) is not None and poses.is_total


def is_load(effect: str) -> bool:
    """Whether holding currents alone show an effect in poses."""
    return (poses := poses_of(effect)) is not None and poses.is_load


def told_apart_by(effects: Collection[str]) -> list[str]:
    """The recordings of poses that would settle which of these effects is there."""
    looks = [poses for effect in effects if (poses := poses_of(effect)) is not None]
    return list(dict.fromkeys(in_poses.told_apart_by for in_poses in looks))


def role_of(effect: str) -> Role:
    """Effects of one role on one joint can be mistaken for each other."""
    return RECORDS[effect].role if effect in RECORDS else ""


def needing_drives() -> tuple[str, ...]:
    """The effects that need the drives' electrical values."""
    return tuple(record.effect for record in RECORDS.values() if record.needs_drives)


def known_laws(arm: Arm) -> tuple[Law, ...]:
    """What the arm's file already has and what shows in time series."""
    effects = [(EffectName(effect.effect, effect.joint), effect.parameters) for effect in arm.effects]
    laws = (known_law(RECORDS[name.effect], name, values) for name, values in effects if name.effect in RECORDS)
    return tuple(law for law in laws if law is not None)


def other_forms(law: Law) -> tuple[Law, ...]:
    """The law with the same values in the other forms that act alike: arm.toml does not say in which of them a part keeps it."""
    series = series_of(law.name.effect)
    forms = () if series is None else series.forms
    return tuple(replace(law, form=form) for form in forms if form is not law.form and form.acts == law.form.acts)


def parameters(arm: Arm, law: Law, covariance: Array) -> Parameters:
    """A law's values as the file's parameters, each with its standard deviation."""
    series = series_of(law.name.effect)
    if series is not None and series.parameters is not None:
        return series.parameters(arm, law, covariance)
    return parameters_of(law.name.effect)(np.array(law.values), covariance)


def follows_map(effect: str) -> bool:
    """Whether a map can hold how a part departs from a law: over the joint's angle or load, or what its motor turns against.

    None holds a flank of a play, a drift with time, or a bending link.
    """
    record = RECORDS[effect]
    return record.traits.blocks in ("q{j}", "load") or (record.series is not None and record.series.form.acts == "motor")


def usual(effect: str) -> float:
    """The usual size of an effect, or of a block, in smallest sizes worth a name."""
    return USUAL if (series := series_of(effect)) is None else series.usual


def series_terms(
    point: OperatingPoint,
    names: Collection[str] | None = None,
    before: Sequence[SeriesTerm] = (),
    keys: Collection[Key] | None = None,
) -> Iterator[SeriesTerm]:
    """All variants of all effects that the channels could show; `names`: only these effects, by name; `keys`: only these.

    `before`: the terms of the first linearisation, which stay for what was not found, unless what was found on its joint changes
    it: a gear that is soft or loose another such gear, an encoder's error where the motor's cogging comes round.
    """
    laws = point.laws.values()
    geared = {law.name.joint for law in laws if law.form.is_gear}
    misread = {place(law)[0] + 1 for law in laws if law.form.acts == "angle"}
    for record, key in _listed(point.scene):
        if keys is not None and key not in keys:
            continue
        is_listed = names is None or key.effect in names or key.effect not in EFFECTS
        listed_key = key if is_listed else Block(key.joint or 0, key.effect)
        is_other = (is_gear(key.effect) and key.joint in geared) or (comes_round(key.effect) and key.joint in misread)
        if before and key not in point.laws and not is_other:
            yield from (term for term in before if term.key == listed_key)
        elif record.series is not None:
            terms = record.series.terms(Sought(point, record, key))
            yield from terms if is_listed else map(unlisted, terms)


def is_gear(effect: str) -> bool:
    """Whether it is a gear that is soft or loose."""
    return (series := series_of(effect)) is not None and series.form.is_gear


def comes_round(effect: str) -> bool:
    """Whether it comes round with the motor's shaft, in orders that are searched."""
    return (series := series_of(effect)) is not None and series.form.is_of_motor


def _listed(scene: SeriesScene) -> Iterator[tuple[EffectRecord, EffectName]]:
    """What the channels could show: all of joint 1, all of joint 2 ..., then what is no joint's."""
    arm, recording = scene.arm, scene.recording
    has = {
        "motor": recording.has_current or recording.has_voltage,
        "angle": True,
        "tip": recording.has_tip,
        "electrical": recording.has_current and recording.has_voltage,  # of voltages alone, all that is slow looks late
    }
    shown = [record for record in RECORDS.values() if record.series is not None and has[record.series.needs]]
    of_joints = [record for record in shown if _is_of_joints(record)]
    for joint in range(1, arm.joint_count + 1):
        behind = [record for record in of_joints if arm.is_behind_encoder(record.effect, joint)]
        yield from ((record, EffectName(record.effect, joint)) for record in behind)
    for record in shown:
        if record not in of_joints and record.series is not None:
            yield from ((record, EffectName(record.effect, place)) for place in record.series.places(arm))


def _is_of_joints(record: EffectRecord) -> bool:
    kind = EFFECTS.get(record.effect)
    return kind is not None and kind.place.startswith("joint")
