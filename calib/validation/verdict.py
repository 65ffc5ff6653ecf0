"""Verdict on a calibration from held-out points, with next steps.

The grades are tried in this order, and the first that applies is given:

| grade | when |
| --- | --- |
| too few points | fewer than FREEDOM_MINIMUM residual coordinates beyond the parameters, no hold-out, or a joint never moved |
| worse | held-out points are no better than with nominal parameters |
| over-fitted | held-out errors are OVER_FITTED times those of the fit (beyond the effect of noise alone) |
| noise not known | there are no repeats and no camera noise in the file, or the points scatter far less than the stated noise |
| not at the floor | held-out errors exceed GOOD times the noise: an effect is missing in the model |
| good | within GOOD times the noise |
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array
from calib.identify.identification import Identification
from calib.identify.outliers import Suspects
from calib.points.points import FREE, POSITION, Points, seen_again
from calib.validation.holdout import HeldOut
from calib.validation.statistics import mean_half_width
from control.model.arm import Arm

Grade = Literal["good", "noise not known", "not at the floor", "over-fitted", "worse", "too few points"]

FREEDOM_MINIMUM = 20  # the noise is then known to 1 / sqrt(2 * 20) = 16 %; with fewer, ratios to it are meaningless
WORSE_PERCENT = 0.0  # improvement on held-out points
OVER_FITTED = 2.0  # held-out over fitted RMS, beyond sqrt((1 + p/3m) / (1 - p/3m)) from noise
EXACT_m = 1e-6  # held-out errors below follow rounding and no noise: nobody measures a tip to a micrometre
UNTOUCHED = 0.3  # of the stated noise: points that scatter less were not measured with it
GOOD = 1.5  # held-out over noise: the remaining error is then about as large as the noise (sqrt(1.5^2 - 1) = 1.1)
CONDITION_LIMIT = 100.0  # above, the weakest combination of parameters is 100 times less certain than the best
# Of its arm, Table 5 "Original": |d| and |L| of each link; a calibrated one of that kind is within some millimetres.
PAPER_LENGTHS_m = np.array([[0.076, 0.0], [0.0, 0.4], [0.012, 0.0], [0.3543, 0.0]])
SAME_ARM_m = 0.01
PAPER_PERCENT = {"normal": 38.8, "roll": 28.9, "pitch": 17.3}  # SpringerPlus 5:1771, Table 4
MEAN_OF_NORM = math.sqrt(8.0 / math.pi)  # mean length of a normal vector of three coordinates, standard deviation 1
SAME_POSTURE_rad = 0.02  # repeats in one posture show only noise; in several, model errors too
# Degrees of freedom that a noise from repeats needs, here and in `gap`: it is then known to 24 %; and how to get there.
REPEATS_FREEDOM = 9
TO_MEASURE_NOISE = "record three points two or three times each"


@dataclass(frozen=True, slots=True)
class Verdict:
    """The verdict: `sentences` give the reasons, `next_steps` the remedies; each is self-contained."""

    grade: Grade
    sentences: tuple[str, ...]
    next_steps: tuple[str, ...]

    @property
    def is_good(self) -> bool:
        """Whether the calibrated arm can be used."""
        return self.grade == "good"

    def in_words(self) -> tuple[str, ...]:
        """All sentences, the verdict first."""
        return (*self.sentences, *self.next_steps)


@dataclass(frozen=True, slots=True)
class NoiseFloor:
    """Noise floor: standard deviation of one axis of a tip position, its source, and the degrees of freedom it is known by."""

    axis_m: float
    source: str
    freedom: float = math.inf

    @property
    def mean_m(self) -> float:
        """Mean distance caused by this noise."""
        return MEAN_OF_NORM * self.axis_m


def noise_floor(arm: Arm, points: Points, problem: ArmProblem, x: Array) -> NoiseFloor | None:
    """What the points' covariances or the camera's noise say, or the scatter of repeats; the smaller if both are known.

    Repeats are poses in one cavity and posture with the same payload, reached from the same side: their differences
    are noise; a varying effect can only increase it.
    """
    found = [_from_repeats(points, problem.residuals(x)), _from_covariances(points) or _from_camera(arm, points)]
    known = [floor for floor in found if floor is not None]
    return min(known, key=lambda floor: floor.axis_m) if known else None


def _from_repeats(points: Points, errors: Array) -> NoiseFloor | None:
    squares, freedom = 0.0, 0
    for rows in _repeats(points):
        squares += float(np.sum((errors[rows] - errors[rows].mean(axis=0)) ** 2))
        freedom += 3 * (len(rows) - 1)
    if freedom < REPEATS_FREEDOM or squares <= 0.0:
        return None
    return NoiseFloor(math.sqrt(squares / freedom), f"the scatter of repeats ({freedom} degrees of freedom)", freedom)


def _from_covariances(points: Points) -> NoiseFloor | None:
    variances = points.covariance[:, [POSITION.index(name) for name in ("cov_xx_m2", "cov_yy_m2", "cov_zz_m2")]]
    known = np.isfinite(variances).all(axis=1)
    if not known.mean() > 0.5:
        return None
    return NoiseFloor(float(np.sqrt(variances[known].mean())), "the covariances of the points")


def _from_camera(arm: Arm, points: Points) -> NoiseFloor | None:
    is_measured = bool(np.isfinite(points.tip_m).all(axis=1).mean() > 0.5)
    if not is_measured or arm.camera is None or arm.camera.position_noise_m <= 0.0:
        return None
    return NoiseFloor(arm.camera.position_noise_m, "the camera's noise in the arm's file")


def _repeats(points: Points) -> list[list[int]]:
    """Groups of two or more rows that are repeats."""
    groups: dict[tuple[object, ...], list[int]] = {}
    for row in seen_again(zip(points.setup, points.point, strict=True)):
        side, load = tuple(points.direction[row].tolist()), str(points.payload_kg[row])
        groups.setdefault((points.setup[row], points.point[row], side, load), []).append(row)
    spread = {key: float(np.ptp(points.q_rad[rows], axis=0).max()) for key, rows in groups.items()}
    return [rows for key, rows in groups.items() if len(rows) > 1 and spread[key] < SAME_POSTURE_rad]


def verdict(
    fit: Identification,
    held: HeldOut | None,
    floor: NoiseFloor | None,
    suspects: Suspects | None = None,
    setups: Sequence[str] = (),
    still: Sequence[str] = (),
) -> Verdict:
    """The verdict on a calibration; `setups` names the setup of each point, for the advice, `still` joints that never moved."""
    slips = _slips(suspects)
    held = held.without(slips) if held is not None else None
    grade = "too few points" if still else _grade(fit, held, floor, slips)
    sentences = [_answer(grade, fit)]
    if still:
        sentences.append(f"{' and '.join(still)} never moved: what belongs to them was not tested.")
    if floor is not None and _is_untouched(fit, floor):
        sentences.append(
            f"The points scatter by {1e3 * _axis_m(fit):.2g} mm about the fit, far less than the noise that is stated: they"
            " were not measured with it."
        )
    if held is not None:
        sentences += [*_on_held_out(held, floor, len(slips)), *_against_paper(fit, held)]
    if grade == "over-fitted" and held is not None:
        sentences.append(
            f"The mean error is {1e3 * fit.mean_after_m:.3f} mm at the points of the fit and"
            f" {1e3 * float(np.mean(held.after_m)):.3f} mm at held-out points: parameters follow the noise, or the other"
            " points do not cover the held-out ones."
        )
    boards = set(setups) - {FREE}
    if len(boards) == len(set(setups)) == 1 and grade in ("good", "noise not known", "not at the floor"):
        sentences.append(f'This applies only around the setup "{setups[0]}": nothing else was tested.')
    steps = (*_about_suspects(suspects), *_next(grade, fit, floor, len(boards)))
    return Verdict(grade, tuple(sentences), steps)


def _slips(suspects: Suspects | None) -> frozenset[int]:
    """Rows of single outliers, which do not count against the arm."""
    if suspects is None or suspects.is_systematic:
        return frozenset()
    return frozenset(one.row for one in suspects.outliers)


def _grade(fit: Identification, held: HeldOut | None, floor: NoiseFloor | None, slips: Collection[int] = ()) -> Grade:
    if 3 * len(fit.error_after_m) - fit.rank < FREEDOM_MINIMUM or held is None:
        return "too few points"
    if held.improvement_percent <= WORSE_PERCENT:
        return "worse"
    if _over_fit(fit, held, slips) > OVER_FITTED:
        return "over-fitted"
    if floor is None or _is_untouched(fit, floor):
        return "noise not known"
    return "good" if float(np.mean(held.after_m)) <= GOOD * floor.mean_m else "not at the floor"


def _axis_m(fit: Identification) -> float:
    """Standard deviation of one axis about the fit."""
    m = len(fit.error_after_m)
    return float(np.sqrt(np.sum(fit.error_after_m**2) / max(1, 3 * m - fit.rank)))


def _is_untouched(fit: Identification, floor: NoiseFloor) -> bool:
    """Whether the points know nothing of the noise."""
    return _axis_m(fit) < UNTOUCHED * floor.axis_m


def _over_fit(fit: Identification, held: HeldOut, slips: Collection[int] = ()) -> float:
    """RMS error at held-out points over its expectation from the fit's residual."""
    share = fit.rank / (3.0 * len(fit.error_after_m))
    fitted = np.delete(fit.error_after_m, sorted(slips), axis=0)
    rms_m = float(np.sqrt(np.mean(np.sum(fitted**2, axis=1))))
    expected = rms_m * math.sqrt((1.0 + share) / max(1.0 - share, 0.05))
    return float(np.sqrt(np.mean(held.after_m**2))) / max(expected, EXACT_m)


def _answer(grade: Grade, fit: Identification) -> str:
    """The first sentence; it names parameters at their bounds, where that limits what the result is worth."""
    bound = [estimate.parameter.name for estimate in fit.estimates if estimate.is_at_bound]
    rest = "rests on its bound" if len(bound) == 1 else "rest on their bounds"
    if grade == "good" and bound:
        return (
            f"The result is good on points not used: the residual is near the noise. But {', '.join(bound)} {rest}:"
            " elsewhere the geometry may be wrong."
        )
    answer = {
        "noise not known": "The result is better than nominal; whether it is good is unknown, since the noise is unknown.",
        "good": "The result is good: the residual on points not used is near the noise.",
        "not at the floor": "The result is better than nominal, but effects other than this geometry remain.",
        "over-fitted": "The result is over-fitted: it predicts points not used much worse than those used.",
        "worse": "The result is worse than nominal on points not used: keep the nominal arm.",
        "too few points": "There are too few points to judge the result.",
    }[grade]
    if bound and grade in ("noise not known", "not at the floor"):
        return f"{answer} {', '.join(bound)} {rest}: the arm, its zeros or the bounds may be others."
    return answer


def _on_held_out(held: HeldOut, floor: NoiseFloor | None, slips_count: int = 0) -> list[str]:
    """Improvement on held-out points, compared with the noise floor and the paper."""
    before, after = 1e3 * float(np.mean(held.before_m)), 1e3 * float(np.mean(held.after_m))
    what = "scatter of each cavity's predicted tips" if held.is_scatter else "error"
    change = "better" if held.improvement_percent >= 0.0 else "worse"
    how = "setup by setup" if held.by == "setup" else held.by
    but = f", without the {slips_count} that contradict the others" if slips_count else ""
    half = 1e3 * mean_half_width(held.after_m)
    interval = f" [{after - half:.3f}, {after + half:.3f}] (95 %)" if math.isfinite(half) else ""
    sentences = [
        f"On points not used (held out {how}{but}), the mean {what} went from {before:.3f} to {after:.3f} mm{interval}:"
        f" {abs(held.improvement_percent):.1f} % {change}."
    ]
    if floor is not None:
        sentences.append(
            f"The noise of one axis is {1e3 * floor.axis_m:.3f} mm (from {floor.source}), a mean distance of"
            f" {1e3 * floor.mean_m:.3f} mm; the error is {after / (1e3 * floor.mean_m):.2f} times that."
        )
    else:
        sentences.append("The noise is unknown: there are no repeats in one posture, and the arm's file gives no camera noise.")
    return sentences


def _against_paper(fit: Identification, held: HeldOut) -> list[str]:
    """Improvement beside SpringerPlus 5:1771, Table 4, for setups of the paper's names; another arm is not compared."""
    lengths_m = np.abs(fit.nominal_dh[:, [0, 2]])
    if lengths_m.shape != PAPER_LENGTHS_m.shape or np.abs(lengths_m - PAPER_LENGTHS_m).max() > SAME_ARM_m:
        return []
    ours = {
        name: 100.0 * (1.0 - fold.mean_after_m / max(fold.mean_before_m, 1e-12))
        for fold in held.folds
        for name in PAPER_PERCENT
        if fold.name == f'setup "{name}"'
    }
    if not ours:
        return []
    pairs = ", ".join(f"{name} {ours[name]:.1f} % (paper {PAPER_PERCENT[name]} %)" for name in ours)
    return [f"Improvement compared with SpringerPlus 5:1771: {pairs}."]


def _about_suspects(suspects: Suspects | None) -> list[str]:
    if suspects is None or not (suspects.setups or suspects.outliers):
        return []
    count = len(suspects.outliers)
    if suspects.is_systematic:
        return [
            f"{count} points contradict the others, too many for single mistakes: look for a common cause (payload, side of"
            " approach, time). Run armwright gap."
        ]
    if suspects.slip is not None:
        return [f"{suspects.slip.words}, then calibrate again."]
    whole = [f'setup "{one.setup}"' for one in suspects.setups]
    single = [f"{count} point{'s' if count > 1 else ''}"] if count else []
    return [
        f"Check {' and '.join([*whole, *single])} that contradict{'' if count != 1 or whole else 's'} the others: measure again"
        " or exclude, then calibrate again."
    ]


def _next(grade: Grade, fit: Identification, floor: NoiseFloor | None, boards_count: int) -> list[str]:
    """Next steps, the most useful first."""
    sentences = []
    if grade == "too few points":
        of_board = ": all cavities of the board, in three tilts" if boards_count else ""
        sentences.append(f"Take more points{of_board}; armwright plan-poses chooses them.")
    if grade == "not at the floor":
        sentences.append(
            "Run armwright gap: it looks for backlash, compliance and other effects in the residuals. Poses approached from"
            " both sides show backlash."
        )
    if grade in ("over-fitted", "worse"):
        sentences.append(
            f"Take {'free poses away from the board, or more tilts,' if boards_count else 'more poses'} so that the points cover"
            " the arm's working volume; or fix parameters that the points hardly determine."
        )
    if not math.isfinite(fit.condition_number) or fit.condition_number > CONDITION_LIMIT:
        tilts = "more tilts of the board and " if boards_count == 1 else ""
        where = " away from the board" if boards_count else ""
        sentences.append(
            f"The points determine some parameters {fit.condition_number:.0f} times worse than others: add {tilts}a dozen"
            f" poses{where} (armwright plan-poses)."
        )
    binding = [e.parameter.name for e in fit.estimates if e.is_at_bound and e.is_determined]
    if binding:
        sentences.append(
            f"{', '.join(binding)} rest{'s' if len(binding) == 1 else ''} on the bound: measure the part, or widen the bound"
            " if it can deviate that much."
        )
    if grade == "noise not known":
        sentences.append(f"{TO_MEASURE_NOISE.capitalize()} to measure the noise.")
    return sentences
