"""A model's terms, sorted by where they act."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from calib.gap.signals.body import Load
from calib.gap.signals.terms import Law

OF_TIP = ("beam", "geometry", "frame")


def is_seen_alone(term: Law) -> bool:
    """Whether a term changes what the camera sees and nothing else."""
    return term.form.acts in OF_TIP or term.form.where == "seen"


@dataclass(slots=True)
class ActingTerms:
    """Terms by where they act."""

    load: Load = field(default_factory=Load)
    scale: dict[int, float] = field(default_factory=dict)
    delay_s: float = 0.0
    sag: list[Law] = field(default_factory=list)
    friction: list[Law] = field(default_factory=list)
    elastic: list[Law] = field(default_factory=list)
    angles: list[Law] = field(default_factory=list)
    tip: list[Law] = field(default_factory=list)

    def add_gear(self, term: Law) -> None:
        """A gear is one: what a file has of its play or softness and what is found besides make one width, or one softness."""
        for k, gear in enumerate(self.elastic):
            if (gear.index, gear.form) == (term.index, term.form):
                both = zip(gear.values, term.values, strict=True)
                self.elastic[k] = gear.at(tuple(one + other for one, other in both))
                return
        self.elastic.append(term)

    def link_friction(self, j: int) -> tuple[float, float]:
        """Coulomb and viscous friction of a joint (0-based) in all."""
        sums = {"coulomb": 0.0, "viscous": 0.0}
        for term in self.friction:
            if term.index == j and term.form.shared:
                sums[term.form.shared] += term.values[0]
        return max(sums["coulomb"], 0.0), max(sums["viscous"], 0.0)  # less than none drives

    def behind(self, term: Law) -> float:
        """The share of a friction that acts behind its elastic or loose gear."""
        if not term.form.shared:
            return 0.0
        return sum(gear.values[-1] for gear in self.elastic if gear.index == term.index)


def sorted_terms(model: Sequence[Law]) -> ActingTerms:
    """A model's terms by where they act."""
    parts = ActingTerms()
    payload, masses, inertias = 0.0, [], []
    for term in model:
        match term.form.acts:
            case "payload":
                payload += term.values[0]
            case "mass":
                masses.append((term.index, term.values[0]))
            case "inertia":
                inertias.append((term.index, term.values[0]))
            case "torque constant":
                parts.scale[term.index] = parts.scale.get(term.index, 0.0) + term.values[0]
            case "delay":
                parts.delay_s += max(term.values[0], 0.0)
            case "sampling":  # a voltage that took effect before the sample is one that comes early
                parts.delay_s -= term.values[0]
            case "sag":
                parts.sag.append(term)
            case "spring" | "play":
                parts.add_gear(term)
            case "angle":
                parts.angles.append(term)
            case "motor":
                parts.friction.append(term)
            case _:
                parts.tip.append(term)
    parts.load = Load(payload, tuple(masses), tuple(inertias))
    return parts
