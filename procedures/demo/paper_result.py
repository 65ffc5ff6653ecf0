"""Results of the replay: mean errors before and after, and improvements with 95 % intervals."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array, norms
from calib.validation.statistics import mean_half_width, student_t
from calib.validation.verify import aligned
from procedures.demo import paper_published as published
from procedures.demo.paper_models import PaperModel
from procedures.demo.paper_poses import OTHER, SETUPS, Target

PLACES = (*SETUPS, OTHER)


@dataclass(frozen=True, slots=True)
class Improvement:
    """Mean errors [m] over the same points before and after, and the improvement of the mean [%].

    Half widths of 95 % intervals; that of the improvement is the ratio estimator's, from errors at the same points.
    """

    count: int
    before_m: float
    before_half_m: float
    after_m: float
    after_half_m: float
    percent: float
    percent_half: float


def improvement(before_m: Array, after_m: Array) -> Improvement:
    """Of distances (m,) at the same points; NaN half widths for a single point."""
    m = len(before_m)
    ratio = float(np.mean(after_m) / np.mean(before_m))
    rest = after_m - ratio * before_m
    half = math.nan
    if m > 1:
        spread = float(np.std(rest, ddof=1)) / (math.sqrt(m) * float(np.mean(before_m)))
        half = 100.0 * student_t(m - 1) * spread
    return Improvement(
        m,
        float(np.mean(before_m)),
        mean_half_width(before_m),
        float(np.mean(after_m)),
        mean_half_width(after_m),
        100.0 * (1.0 - ratio),
        half,
    )


@dataclass(frozen=True, slots=True)
class PaperReplay:
    """The whole result: the models, and their results at the same targets; `before` by the nominal arm."""

    targets: tuple[Target, ...]
    before_m: Array
    models: tuple[PaperModel, ...]
    reached_m: Mapping[str, Array]
    table_error_m: float
    table_says: tuple[str, ...]

    def rows(self, place: str) -> list[int]:
        """Indices of the targets of a tilt, or of the other trajectory."""
        return [k for k, (setup, _, _) in enumerate(self.targets) if setup == place]

    @property
    def wanted_m(self) -> Array:
        """Targets (m, 3)."""
        return np.array([tip_m for _, _, tip_m in self.targets])

    def error_m(self, model: str | None) -> Array:
        """Measured minus wanted, (m, 3), of a model's visit; None: the nominal arm's."""
        return np.asarray((self.before_m if model is None else self.reached_m[model]) - self.wanted_m)

    def of(self, model: str, place: str) -> Improvement:
        """The improvement by a model at one place."""
        rows = self.rows(place)
        return improvement(norms(self.error_m(None)[rows]), norms(self.error_m(model)[rows]))


def table_rows(replay: PaperReplay) -> list[tuple[str, ...]]:
    """Identification by place: mean error in mm and improvement; then the published figures."""
    rows: list[tuple[str, ...]] = [("identified from", "points", *PLACES)]
    names = [model.name for model in replay.models]
    before = [replay.of(names[0], place) for place in PLACES]
    rows.append(
        (
            "not calibrated [mm]",
            "",
            *(f"{1e3 * b.before_m:.2f} ± {1e3 * b.before_half_m:.2f}" for b in before),
        )
    )
    for model in replay.models:
        each = [replay.of(model.name, place) for place in PLACES]
        rows.append((f"{model.name} [mm]", str(model.points_count), *map(_mm, each)))
        rows.append(("  improved", "", *map(_percent, each)))
    own = (f"{published.IMPROVED_percent[place]:.1f} %" for place in SETUPS)
    rows.append(("published, own tilt", "33", *own, "32.1 to 53.0 %, pitch none"))
    return rows


def table_text(replay: PaperReplay) -> str:
    """The table as plain text."""
    return aligned(table_rows(replay))


def own_tilt(replay: PaperReplay) -> list[tuple[str, Improvement, float]]:
    """Each tilt's identification verified on the same tilt, with the published figures."""
    return [(s, replay.of(s, s), published.IMPROVED_percent[s]) for s in SETUPS]


def document(replay: PaperReplay, program: str, date: str, inputs: Mapping[str, str]) -> dict[str, object]:
    """paper.json: SI units, improvements in percent; a missing number is null."""
    return {
        "format": "paper-replay/1",
        "program_version": program,
        "date": date,
        "inputs": dict(inputs),
        "initial_error_at_the_table_m": replay.table_error_m,
        "identified": {model.name: _model(replay, model) for model in replay.models},
        "published": {
            "source": published.CITED,
            "before_m": published.BEFORE_m,
            "after_m": published.AFTER_m,
            "improved_percent": published.IMPROVED_percent,
            "other_trajectory": published.OTHER_TRAJECTORY,
        },
    }


def _model(replay: PaperReplay, model: PaperModel) -> dict[str, object]:
    found = model.found
    return {
        "what": model.what,
        "points": model.points_count,
        "mean_error_at_its_points_m": {"before": found.mean_before_m, "after": found.mean_after_m},
        "parameters": {
            e.parameter.name: {"deviation": e.deviation, "unit": e.parameter.unit} for e in found.estimates
        },
        "at_bound": list(found.binding),
        "effects": [
            {"effect": e.effect, "joint": e.joint, "parameters": dict(e.parameters)} for e in model.backlash
        ],
        "verified": {place: _improvement(replay.of(model.name, place)) for place in PLACES},
        "in_words": list(model.remarks),
    }


def _improvement(entry: Improvement) -> dict[str, float | int | None]:
    values = {
        "count": entry.count,
        "before_m": entry.before_m,
        "before_half_m": entry.before_half_m,
        "after_m": entry.after_m,
        "after_half_m": entry.after_half_m,
        "improved_percent": entry.percent,
        "improved_half_percent": entry.percent_half,
    }
    return {key: value if math.isfinite(value) else None for key, value in values.items()}


def _mm(entry: Improvement) -> str:
    return f"{1e3 * entry.after_m:.2f} ± {1e3 * entry.after_half_m:.2f}"


def _percent(entry: Improvement) -> str:
    return f"{entry.percent:.1f} ± {entry.percent_half:.1f} %"


def widths_text(model: PaperModel) -> str:
    """Backlash of each joint of a model, in mrad."""
    widths = (f"joint {e.joint} {1e3 * e.parameters['width_rad']:.2f} mrad" for e in model.backlash)
    return ", ".join(widths) or "none"
