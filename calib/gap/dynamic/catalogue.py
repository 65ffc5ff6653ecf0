"""What may be hidden: every effect of the list on every joint, and what is in no list, with starts for the search.

The unlisted ones (drag with the square of speed, another resistance, friction that depends on the place, ...) are
there so that they are recognised: what they explain better than any effect of the list is reported as unknown.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterator
from dataclasses import dataclass

from calib.arm_problem.link_bending import beams
from calib.gap.finding import EffectName
from calib.gap.signals.angles import BEHIND, SEEN
from calib.gap.signals.recording import Recording
from calib.gap.signals.terms import Term
from control.model.arm import Arm

STRIBECK_rad_s = (0.012, 0.022, 0.04, 0.07, 0.12, 0.22)
ORDERS = tuple(range(1, 41))
READ_SHARES = (0.1, 0.3, 0.5, 0.7, 0.9)  # of a period, after the voltage has changed
DELAYS_s = (0.0006, 0.0012, 0.0018, 0.0024, 0.0030, 0.0038, 0.0046, 0.0056, 0.007, 0.009)
SPRINGS_rad_Nm = (1 / 5000.0, 1 / 1500.0, 1 / 500.0, 1 / 150.0)
WARMING_s = (0.8, 2.5, 8.0, 40.0, 300.0)
WIDTHS_rad = (0.002, 0.006, 0.016)
SHAPES = {
    "encoder_scale": "joint {joint}: an error in proportion to its angle",
    "encoder_eccentricity": "joint {joint}: an error that is a sine of its angle",
    "belt_coupling": "joint 3: an error in proportion to joint 2's angle",
    "thermal_drift": "joint {joint}: an error that grows with time and settles",
    "base_frame": "the tip, shifted and turned as a whole",
    "link_geometry": "the tip, as if lengths or axes of the links were others",
}


@dataclass(frozen=True, slots=True)
class Candidate:
    """An effect with the starts of its search; `is_listed` false: recognised, but never named.

    `linear`: the rows are linear in the values, so that one step finds them. `free`: how many of the values count.
    """

    name: EffectName
    starts: tuple[Term, ...]
    is_listed: bool
    linear: bool = True
    where: str = ""  # of an unlisted one: what it says

    @property
    def is_shape(self) -> bool:
        """Whether it is the law of an effect that has been taken off the list."""
        return not self.is_listed and self.name.effect in SHAPES

    def __str__(self) -> str:
        """As the finding names it."""
        return str(self.name)


def candidates(arm: Arm, recording: Recording, names: Collection[str] | None = None) -> list[Candidate]:
    """All that this recording's channels could show; `names`: only these effects of the list."""
    found = list(_listed(arm, recording))
    nameless: list[Candidate] = []
    if names is not None:
        nameless = [
            _nameless(one) for one in found if one.name.effect in SHAPES and one.name.effect not in names
        ]
        found = [candidate for candidate in found if candidate.name.effect in names]
    return [*found, *nameless, *_unlisted(arm, recording)]


def _nameless(one: Candidate) -> Candidate:
    """A smooth error of angle, time or place that no effect of the list has: it is still in the world, without a name."""
    return dataclasses.replace(
        one, is_listed=False, where=SHAPES[one.name.effect].format(joint=one.name.joint)
    )


def _listed(arm: Arm, recording: Recording) -> Iterator[Candidate]:
    moves = recording.has_current or recording.has_voltage
    for joint in range(1, arm.joint_count + 1):
        if moves:
            yield from _frictions(joint)
            yield _simple("torque_constant", joint, (0.0,))
        if moves or recording.has_tip:
            yield _many("joint_compliance", joint, [(c, 0.3, 0.0) for c in SPRINGS_rad_Nm])
            yield _many("backlash", joint, [(w, 0.0) for w in WIDTHS_rad])
        if recording.has_tip:
            yield _encoder("encoder_eccentricity", joint, (0.0, 0.0))
            yield _encoder("encoder_scale", joint, (0.0,))
            name = EffectName("thermal_drift", joint)
            forms = ("thermal_drift", "thermal_drift" + SEEN)
            drifts = tuple(Term(name, form, (0.0, time_s)) for form in forms for time_s in WARMING_s)
            yield Candidate(name, drifts, True, False)
    if moves:
        yield _simple("payload", None, (0.0,))
        yield from _inertias(arm)
    if recording.has_voltage:
        name = EffectName("command_delay")
        yield Candidate(name, tuple(Term(name, "command_delay", (d,)) for d in DELAYS_s), True, False)
    if recording.has_current and recording.has_voltage:
        name = EffectName("supply_sag")
        forms = ("supply_sag", "supply_sag by sum")
        yield Candidate(name, tuple(Term(name, form, (0.0,)) for form in forms), True)
    if recording.has_tip:
        if arm.joint_count >= 3:
            yield _encoder("belt_coupling", None, (0.0,))
        if all(link.mass_kg for link in arm.links if link.joint == "revolute"):
            for link in beams(arm):
                yield _simple("link_flexure", link, (0.0,))
        yield _simple("base_frame", None, (0.0,) * 6)
        yield _simple("link_geometry", None, (0.0,) * (4 * len(arm.links)))


def _frictions(joint: int) -> Iterator[Candidate]:
    for effect in ("coulomb_friction", "viscous_friction", "load_friction", "asymmetric_friction"):
        yield _simple(effect, joint, (0.0,))
    forms = ("stribeck_friction", "stribeck exponential")
    name = EffectName("stribeck_friction", joint)
    yield Candidate(
        name, tuple(Term(name, form, (0.0, v)) for form in forms for v in STRIBECK_rad_s), True, False
    )
    name = EffectName("cogging", joint)
    yield Candidate(name, tuple(Term(name, "cogging", (0.0, 0.0), float(n)) for n in ORDERS), True)


def _inertias(arm: Arm) -> Iterator[Candidate]:
    for k, link in enumerate(arm.links):
        if link.mass_kg is None or link.com_m is None:
            continue
        name = EffectName("link_inertia", k + 1)
        yield Candidate(name, tuple(Term(name, form, (0.0,)) for form in ("mass_kg", "inertia_kg_m2")), True)


def _unlisted(arm: Arm, recording: Recording) -> Iterator[Candidate]:
    for joint in range(1, arm.joint_count + 1):
        if recording.has_current or recording.has_voltage:
            for form, count, where in _LAWS:
                yield _strange(form, joint, count, where)
        if recording.has_current and recording.has_voltage:
            for form, where in _WINDINGS:
                yield _strange(form, joint, 1, where)
        if recording.has_tip:
            yield _strange("zero", joint, 1, "the tip, as if joint {joint}'s zero were another in these runs")
    if recording.has_current or recording.has_voltage:
        name, period_s = EffectName("sampling time"), 1.0 / recording.filters.rate_Hz
        where = "the currents, with their slope: angles and currents are read at another moment of the sample"
        starts = tuple(Term(name, "sampling time", (share * period_s,)) for share in READ_SHARES)
        yield Candidate(name, starts, is_listed=False, linear=False, where=where)
    if recording.has_tip:
        name = EffectName("camera time")
        where = "the tip, in proportion to its speed: the camera's times are offset"
        yield Candidate(name, (Term(name, "camera time", (0.0,)),), False, where=where)


_LAWS = (
    ("drag", 1, "the current of joint {joint}, growing with the square of its speed"),
    ("cubic drag", 1, "the current of joint {joint}, growing with the cube of its speed"),
    ("position friction", 2, "the friction of joint {joint}, changing with its angle"),
    ("position torque", 2, "a torque on joint {joint} that depends on its angle, as of a spring"),
    ("joint turn torque", 2, "a torque on joint {joint}, once a turn of the joint"),
    ("warming", 1, "the friction of joint {joint}, changing during a run"),
    ("inertia", 1, "the current of joint {joint}, in proportion to its acceleration"),
)
_WINDINGS = (
    ("resistance", "the voltage of joint {joint}, in proportion to its current: another winding resistance"),
    ("current offset", "the voltage of joint {joint}, constant: an offset of its current sensor"),
    ("inductance", "the voltage of joint {joint}, in proportion to its current's slope: another inductance"),
)


def _simple(effect: str, joint: int | None, values: tuple[float, ...]) -> Candidate:
    name = EffectName(effect, joint)
    return Candidate(name, (Term(name, effect, values),), True)


def _encoder(effect: str, joint: int | None, values: tuple[float, ...]) -> Candidate:
    """An encoder that errs against its motor, or against its link, or as far as the camera sees."""
    name = EffectName(effect, joint)
    forms = (effect, effect + BEHIND, effect + SEEN)
    return Candidate(name, tuple(Term(name, form, values) for form in forms), True)


def _many(effect: str, joint: int, starts: list[tuple[float, ...]]) -> Candidate:
    name = EffectName(effect, joint)
    return Candidate(name, tuple(Term(name, effect, values) for values in starts), True, False)


def _strange(form: str, joint: int, count: int, where: str) -> Candidate:
    name = EffectName(form, joint)
    return Candidate(name, (Term(name, form, (0.0,) * count),), False, where=where.format(joint=joint))
