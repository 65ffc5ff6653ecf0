"""Scores the posterior of time series: exact and rough laws, many at once, nulls, what no list names, what the file has in part.

python -m benchmarks.gap.dynamic.series_score --sorts rough many --cases 60 --first-seed 90000
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.gap.dynamic.cases import Asked, Case, made
from benchmarks.gap.dynamic.hidden import FOREIGN, LISTED, LISTED_BY_JOINT
from benchmarks.gap.dynamic.score import arm_of, log_of
from benchmarks.studies import say
from calib.gap.finding import EffectName, GapFinding, as_totals, with_totals
from calib.gap.series.find import examine
from calib.gap.words import interval
from control.model.arm import Arm, Effect
from control.model.effects import EFFECTS

SORTS = ("exact", "rough", "many", "null", "foreign", "known")
ROUGH, ROUGH_MANY = 0.08, 0.08
MANY = (
    "coulomb_friction",
    "viscous_friction",
    "stribeck_friction",
    "load_friction",
    "asymmetric_friction",
    "cogging",
    "torque_constant",
    "joint_compliance",
    "backlash",
    "encoder_eccentricity",
    "encoder_scale",
    "thermal_drift",
)
KNOWABLE = (
    "encoder_scale",
    "backlash",
    "joint_compliance",
    "load_friction",
    "torque_constant",
    "coulomb_friction",
    "cogging",
    "asymmetric_friction",
    "command_delay",
    "supply_sag",
    "encoder_eccentricity",
    "belt_coupling",
)
INVERSE = ("stiffness_Nm_rad", "EI_Nm2")  # the softness is what is known in part
SCALED = (
    "torque_Nm",
    "coefficient_Nm_s_rad",
    "fraction",
    "amplitude_Nm",
    "amplitude_rad",
    "width_rad",
    "ratio",
    "delay_s",
    "resistance_ohm",
    "mass_kg",
    "inertia_kg_m2",
    *INVERSE,
)
GEARS = ("joint_compliance", "backlash")


def asked(sort: str, seed: int) -> Asked:
    """What a case of a sort hides."""
    rng = np.random.default_rng(seed + 31_000_000)
    every = [*((name, j) for name in LISTED_BY_JOINT for j in (1, 2, 3)), *((name, None) for name in LISTED)]
    match sort:
        case "null":
            return Asked(seed, "none")
        case "known":
            known = KNOWABLE[seed % len(KNOWABLE)]
            return Asked(seed, known, None if known in LISTED else int(rng.integers(1, 4)))
        case "foreign":
            return Asked(seed, str(FOREIGN[int(rng.integers(len(FOREIGN)))]))
        case "many":
            names: list[str] = []
            while len(names) < int(seed % 4) + 3:
                one = str(rng.choice(MANY))
                if one not in names and not (one in GEARS and any(g in names for g in GEARS)):
                    names.append(one)
            return Asked(seed, "+".join(names), rough=ROUGH_MANY)
        case _:
            name, joint = every[int(rng.integers(len(every)))]
            return Asked(seed, name, joint or (2 if name == "link_geometry" else 1), rough=ROUGH if sort == "rough" else 0.0)


def known_in_part(case: Case) -> Arm:
    """The case's arm whose file has its hidden effects at a third to two thirds of what they are."""
    arm, rng = arm_of(case.arm_toml), np.random.default_rng(case.asked.seed + 33_000_000)
    own = []
    for entry in case.truth:
        name, share = _key(entry), float(rng.uniform(0.33, 0.67))
        given = {key: value for key, value in entry["parameters"].items() if isinstance(value, float | int)}
        for key, value in given.items():
            if key in SCALED:
                given[key] = value / share if key in INVERSE else value * share
            elif key == "scale" and name.effect == "torque_constant":
                given[key] = 1.0 + share * (value - 1.0)
            elif key == "scale":
                given[key] = share * value
        own.append(Effect(name.effect, name.joint, given))
    return with_totals(arm, own)


def true_total(arm: Arm, entry: dict[str, Any]) -> dict[str, float]:
    """What an effect of the truth amounts to beside what the simulated arm has of it: dry and viscous friction act besides."""
    own = [one.parameters for one in arm.effects if EffectName(one.effect, one.joint) == _key(entry)]
    return {key: value + sum(one[key] for one in own) for key, value in entry["parameters"].items()}


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=60)
    parser.add_argument("--first-seed", type=int, default=90_000)
    parser.add_argument("--sorts", nargs="*", choices=SORTS, default=list(SORTS))
    given = parser.parse_args()
    for k, sort in enumerate(SORTS):
        if sort in given.sorts:
            first = given.first_seed + 1000 * k if given.first_seed >= 10_000 else given.first_seed + 100 * k
            _score(sort, [asked(sort, first + n) for n in range(given.cases)])


class Tally:
    """What is counted of one sort."""

    def __init__(self) -> None:
        self.count: Counter[str] = Counter()
        self.errors: list[float] = []
        self.inside: list[float] = []
        self.held: list[bool] = []
        self.gaps: list[float] = []
        self.took: list[float] = []

    def line(self) -> str:
        """In a line."""
        text = "  ".join(f"{key} {count}" for key, count in sorted(self.count.items()))
        text += f"; seconds median {np.median(self.took):.0f}, most {max(self.took):.0f}"
        if self.errors:
            text += f"; parameters: median {np.median(self.errors):.1%}, within 10 % {np.mean(np.array(self.errors) <= 0.1):.0%}"
            text += f", within 2 sd {np.mean(np.array(self.inside) <= 1.96):.0%}"
            text += f", in their intervals {np.mean(self.held):.0%} of {len(self.inside)}"
        if self.gaps:
            text += f"; gap after median {np.median(self.gaps):.2f}, largest {max(self.gaps):.2f}"
        return text


def _score(sort: str, some: Sequence[Asked]) -> None:
    tally = Tally()
    for case in made(some):
        began = time.process_time()
        arm = known_in_part(case) if sort == "known" else arm_of(case.arm_toml)
        outcome = examine(arm, log_of(case))
        tally.took.append(time.process_time() - began)
        found = as_totals(arm, outcome.finding) if sort == "known" else outcome.finding
        _judge(case, found, tally, f"{sort} {case.asked.seed}")
    say(f"== {sort} {len(some)}: {tally.line()}")


def _key(entry: dict[str, Any]) -> EffectName:
    kind = EFFECTS.get(entry["effect"])
    return EffectName(entry["effect"], None if kind is not None and kind.place == "none" else entry["joint"])


def _judge(case: Case, found: GapFinding, tally: Tally, label: str) -> None:
    listed = [entry for entry in case.truth if entry["effect"] in EFFECTS]
    whole = arm_of(case.arm_toml) if label.startswith("known") else None
    wanted = {_key(entry): entry["parameters"] if whole is None else true_total(whole, entry) for entry in listed}
    got = {one.name: one for one in found.effects}
    could = {one.name for one in found.nameable if one.is_nameable}
    in_set = {name for names in found.ambiguous for name in names}
    wrong = got.keys() - wanted.keys()
    is_exact = got.keys() == wanted.keys()
    tally.count["exact"] += is_exact
    tally.count["right"] += bool(wanted) and wanted.keys() <= got.keys()
    tally.count["right or set"] += bool(wanted) and wanted.keys() <= got.keys() | in_set
    tally.count["nameable"] += bool(wanted) and wanted.keys() <= could
    tally.count["nameable right"] += bool(wanted) and wanted.keys() <= could and wanted.keys() <= got.keys()
    tally.count["wrong name"] += bool(wrong)
    tally.count["unknown"] += found.unknown is not None
    for name in wanted.keys() & got.keys():
        for key, true in wanted[name].items():
            if key in got[name].parameters and key not in ("order", "phase_rad", "speed_rad_s", "time_constant_s"):
                value, sd = got[name].parameters[key]
                base = true - 1.0 if name.effect == "torque_constant" else true
                tally.errors.append(abs(value - true) / abs(base))
                tally.inside.append(abs(value - true) / max(sd, 1e-300))
                lower, upper = interval(got[name], key)
                tally.held.append(lower <= true <= upper)
    if wanted and wanted.keys() <= got.keys():
        tally.gaps.append(found.gap_after)
    said = {
        str(name): {k: (float(f"{v[0]:.4g}"), float(f"{v[1]:.2g}")) for k, v in one.parameters.items()}
        for name, one in got.items()
        if name.effect != "link_geometry"
    }
    say(
        f"  {label} {'ok ' if is_exact and not (found.unknown and wanted) else 'BAD' if wrong or not wanted else '-- '}"
        f" {[(str(n), {k: float(f'{v:.4g}') for k, v in p.items()}) for n, p in wanted.items()] or case.asked.effects}: {said}"
        f" sets {[[str(n) for n in s] for s in found.ambiguous]} unknown {found.unknown and found.unknown.where}"
        f" gap {found.gap_before:.2f} {found.gap_after:.2f} nameable {wanted.keys() <= could} {tally.took[-1]:.0f} s"
    )


if __name__ == "__main__":
    main()
