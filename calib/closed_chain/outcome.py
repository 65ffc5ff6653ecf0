"""Results of two arms in contact: text for a terminal, pair.json, both arms' files."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from calib.arm_problem.frames import Frame
from calib.arrays import Array
from calib.closed_chain.calibrate import PairFound
from calib.closed_chain.pair_problem import names_of
from calib.identify.estimates import Estimate
from calib.identify.open_combinations import open_in_words
from calib.results import Provenance, entries, write_json
from control.kinematics.rotation import quaternion_of, quaternions
from control.model.arm import Arm
from control.model.cell import Cell, Placed
from control.model.description import save_arm

FORMAT = "pair/1"
SCALE = (
    "Contacts in one place leave the scale of both arms open: it stays at nominal. Contacts at a known distance (distance_m)"
    " determine it."
)
NO_EFFECT = 0.98  # share of a parameter that the contacts leave open, from which on its value means nothing


def pair_text(nominal: tuple[Arm, Arm], found: PairFound) -> str:
    """Errors of contacts left out first, then what is determined, then both arms and where they stand."""
    lines = []
    if len(found.held_after_m):
        lines.append(
            f"On contacts not used (every 5th left out in turn), the mean error went from {_mm(found.held_before_m)} to"
            f" {_mm(found.held_after_m)} mm (largest {1e3 * float(found.held_after_m.max()):.3f})."
        )
    else:
        lines.append("Too few contacts to leave some out: how good the result is elsewhere is unknown.")
    lines += [
        f"{len(found.after_m)} contacts: mean error {_mm(found.before_m)} mm with nominal arms, {_mm(found.after_m)} mm after, at"
        " the contacts of the fit.",
        *_joined(found.angles_rad),
        f"They determine {found.known.rank} of {len(found.estimates)} parameters (condition number"
        f" {found.known.condition_number:.0f}).",
        *(f"{sentence}." for sentence in (*remarks(found), *open_in_words(found.known.undetermined))),
        *([] if found.has_distance else [SCALE]),
        "",
        f"{'parameter':<22}{'unit':<6}{'nominal':>12}{'identified':>12}{'sd':>10}",
        *(_line(one) for one in found.estimates if one.parameter.has_bound or "_tool_" in one.parameter.name),
        "",
        _stand(names_of(nominal), found.base),
    ]
    return "\n".join(lines) + "\n"


def _mm(errors_m: Array) -> str:
    return f"{1e3 * float(errors_m.mean()):.3f}"


def _joined(angles_rad: Array) -> list[str]:
    """How well the orientation between joined tools fits."""
    if not len(angles_rad):
        return []
    return [
        f"Joined tools: {len(angles_rad)} contacts, orientation within {1e3 * _rms(angles_rad):.3f} mrad (rms) after."
    ]


def _rms(angles_rad: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(angles_rad**2, axis=1))))


def _line(one: Estimate) -> str:
    unit, factor, digits = ("deg", math.degrees(1.0), 4) if one.parameter.unit == "rad" else ("mm", 1e3, 3)
    values = f"{factor * one.parameter.nominal:>12.{digits}f}{factor * one.value:>z12.{digits}f}"
    if one.undetermined_share > NO_EFFECT:
        return f"{one.parameter.name:<22}{unit:<6}{values}{'':>10}  no effect here"
    spread = "" if math.isnan(one.sd) else f"{factor * one.sd:.{digits}f}"
    remark = "at its bound" if one.is_at_bound else "" if one.is_determined else "not determined alone"
    return f"{one.parameter.name:<22}{unit:<6}{values}{spread:>10}  {remark}".rstrip()


def _stand(names: tuple[str, str], base: Frame) -> str:
    w, x, y, z = quaternions(base.rotation[None])[0].tolist()
    origin = ", ".join(f"{value:.6f}" for value in base.origin_m)
    return (
        f"Base of {names[1]} in the base frame of {names[0]} (as in cell.toml):\n"
        f"origin_m = [{origin}]\norientation = [{w:.9f}, {x:.9f}, {y:.9f}, {z:.9f}]"
    )


def calibrated_cell(cell: Cell, arms: tuple[Arm, Arm], base: Frame) -> Cell:
    """The cell with calibrated arms of the same names, the second at `base` in the first's base frame."""
    one, two = arms
    first = dataclasses.replace(cell.placed(one.name), arm=one)
    rows = np.array(first.rotation) @ base.rotation
    second = Placed(two, first.in_cell(base.origin_m.tolist()), quaternion_of(rows.tolist()))
    made = {one.name: first, two.name: second}
    return dataclasses.replace(cell, arms=tuple(made.get(placed.name, placed) for placed in cell.arms))


def write_pair(
    out: Path,
    nominal: tuple[Arm, Arm],
    found: PairFound,
    objective: str,
    made: Provenance,
) -> list[Path]:
    """Write NAME.toml of both arms and pair.json; return the files."""
    files = [out / f"{name}.toml" for name in (*names_of(nominal), "pair")]
    files[-1] = files[-1].with_suffix(".json")
    for file, arm, calibrated in zip(files[:-1], nominal, found.arms, strict=True):
        save_arm(dataclasses.replace(calibrated, calibration=made.of_arm(arm, objective)), file)
    write_json(files[-1], made.heading(FORMAT) | pair_json(nominal, found))
    return files


def pair_json(nominal: tuple[Arm, Arm], found: PairFound) -> dict[str, object]:
    """The result for other programs."""
    return {
        "arms": names_of(nominal),
        "contacts": len(found.after_m),
        "mean_error_m": {"before": found.before_m.mean(), "after": found.after_m.mean()},
        "held_out": {
            "mean_before_m": found.held_before_m.mean(),
            "mean_after_m": found.held_after_m.mean(),
            "max_after_m": found.held_after_m.max(),
        }
        if len(found.held_after_m)
        else None,
        "rank": found.known.rank,
        "condition_number": found.known.condition_number,
        "parameters": {
            one.parameter.name: entries(one.parameter, "unit", "nominal")
            | entries(one, "value", "sd", "is_determined", "is_at_bound")
            for one in found.estimates
            if one.parameter.has_bound or "_tool_" in one.parameter.name
        },
        "second_base": {
            "origin_m": found.base.origin_m,
            "orientation": quaternions(found.base.rotation[None])[0],
        },
        "undetermined": [
            {"names": group.names, "freedoms": group.freedoms_count} for group in found.known.undetermined
        ],
        "joined_angle_rms_rad": _rms(found.angles_rad) if len(found.angles_rad) else None,
        "remarks": list(remarks(found)),
        "in_words": open_in_words(found.known.undetermined),
    }


# What a reader of a pair's calibration must know: whether it explains the contacts, which the others contradict, bounds.

EXPLAINED = 0.5  # of the error of contacts left out: a calibration that leaves more has not understood them
CONTRADICTED = 6.0  # times the median error of contacts left out
LEAST_m = 5e-4  # below it a contact is as good as hands and backlash allow
NAMED = 6  # contacts, and parameters
SPARE = 1.5  # rows of three numbers over the numbers that they determine


def remarks(found: PairFound) -> Iterator[str]:
    """Sentences, the gravest first; none for a result without reproach."""
    before, after = found.held_before_m, found.held_after_m
    is_enough = found.numbers_count >= SPARE * found.known.rank
    if len(after):
        left_m, nominal_m = float(np.median(after)), float(np.median(before))  # some contacts may be none
        if left_m > max(EXPLAINED * nominal_m, LEAST_m):
            yield (
                f"This does not explain the contacts: left out, half of them stay open by {1e3 * left_m:.2f} mm or more, with"
                f" nominal arms by {1e3 * nominal_m:.2f} mm. Check distance_m (in m), the order of the joints, and that both tips"
                " touched"
            )
        wrong = np.flatnonzero(after > max(CONTRADICTED * float(np.median(after)), LEAST_m))
        if len(wrong) and is_enough:
            worst = wrong[np.argsort(-after[wrong])]
            named = [f"{found.names[row]} ({1e3 * after[row]:.2f} mm)" for row in worst[:NAMED]]
            more = f" and {len(wrong) - NAMED} more" if len(wrong) > NAMED else ""
            yield f"Contradicted by the others: {', '.join(named)}{more}. Look at them; remove what was not a contact"
    at_bound = [one.parameter.name for one in found.estimates if one.is_at_bound]
    if at_bound:
        more = f" and {len(at_bound) - NAMED} more" if len(at_bound) > NAMED else ""
        yield (
            f"At their bounds: {', '.join(at_bound[:NAMED])}{more}. If parts may be that far off, give a larger --bound;"
            " else look for a wrong contact"
        )
    if not is_enough:
        yield (
            f"{found.numbers_count} numbers determine {found.known.rank} parameters: the errors at the contacts of the fit say"
            " nothing, and more contacts are needed"
        )
