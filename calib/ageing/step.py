"""One change between two calibrations, such as a slipped zero, that explains a record which a straight line does not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from calib.ageing.history import Entry
from calib.ageing.line import Line, line_of
from calib.ageing.trend import Rate, by_zeros
from control.model.arm import Arm

LEFT_MOST: Final = (
    0.1  # of a line's excess chi-squared: steady drift, an outlier or mere scatter leaves a step far more
)


@dataclass(frozen=True, slots=True)
class Step:
    """The calibrations on its two sides; changes of zeros; has_rest: other geometry changed; since: the calibrations behind it;
    alone: the only calibration of a side, which may be a spoilt one instead.
    """

    before: Entry
    after: Entry
    changes: tuple[Rate, ...]
    has_rest: bool
    since: tuple[Entry, ...]
    alone: Entry | None


def step_of(arm: Arm, entries: Sequence[Entry], line: Line) -> Step | None:
    """The step that explains the calibrations far better than their line; None if none does. Entries are sorted by date."""
    known = [one for one in entries if one.geometry is not None]
    places = [k for k in range(1, len(known)) if known[k].day > known[k - 1].day]
    found = [(step, k) for k in places if (step := line_of(arm, known, known[k].day)) is not None]
    step, place = min(found, key=lambda one: one[0].chi_squared)
    if _excess(step) > LEFT_MOST * _excess(line):
        return None
    changes, has_rest = by_zeros(step, 1.0)
    sides = known[:place], known[place:]
    alone = next((side[0] for side in reversed(sides) if len(side) == 1), None)
    return Step(known[place - 1], known[place], changes, has_rest, tuple(sides[1]), alone)


def _excess(line: Line) -> float:
    """Chi-squared beyond what the calibrations' own intervals explain."""
    return max(0.0, line.chi_squared - line.freedom)


def step_json(step: Step) -> dict[str, object]:
    """For programs; SI units."""
    return {
        "between": [one.measured.isoformat() for one in (step.before, step.after)],
        "changes": [
            {"name": one.name, "change": one.change, "half_interval": one.half, "is_sure": one.drifts}
            for one in step.changes
        ],
        "other_geometry": step.has_rest,
    }
