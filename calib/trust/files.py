"""map.npz for programs and trust.json for everybody: formats in docs/formats.md."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from calib.inputs import InputFile
from calib.points.writer import replace_file
from calib.trust.iso9283 import PoseFigures, pose_json
from calib.trust.task import Reliability
from calib.trust.trust import Trust, share_within
from calib.trust.words import sentences, task_sentences

FORMAT = "trust/1"


def write_map(file: Path, trust: Trust) -> None:
    """The map as arrays [SI]: the first axis of errors is the sheet, a payload and a direction of approach."""
    sheets = trust.sheets
    content = io.BytesIO()
    np.savez_compressed(
        content,
        q_rad=trust.q_rad,
        tip_m=sheets[0].error.tip_m,
        payload_kg=np.array([one.payload_kg for one in sheets]),
        direction=np.array([one.direction for one in sheets]),
        expected_m=np.array([one.error.expected_m for one in sheets]),
        systematic_m2=np.array([one.error.systematic_m2 for one in sheets]),
        random_m2=np.array([one.error.random_m2 for one in sheets]),
        within_95_m=np.array([one.within_95_m for one in sheets]),
    )
    replace_file(file, content.getvalue())


def write_json(
    file: Path,
    trust: Trust,
    tasks: Sequence[Reliability],
    poses: Sequence[PoseFigures],
    about: Mapping[str, object],
    inputs: Sequence[InputFile],
) -> None:
    """trust.json: `about` has date and program_version."""
    content = {
        "format": FORMAT,
        "arm": trust.arm.name,
        **about,
        "inputs": {one.name: one.sha256 for one in inputs},
    }
    content |= trust_json(trust, tasks, poses)
    replace_file(file, (json.dumps(content, indent=2, allow_nan=False) + "\n").encode())


def trust_json(trust: Trust, tasks: Sequence[Reliability], poses: Sequence[PoseFigures]) -> dict[str, object]:
    """The result for programs; SI units."""
    reach, tolerance = trust.within_95_m, trust.request.tolerance_m
    found = trust.coverage
    return {
        "poses": len(reach),
        "within_95_m": {"median": float(np.median(reach)), "largest": float(reach.max())},
        "tolerance_m": tolerance,
        "share_within_tolerance": share_within(reach, tolerance) if tolerance is not None else None,
        "noise_m": trust.posterior.noise_m,
        "measuring_noise_m": trust.measuring_noise_m,
        "is_tied_to_base": trust.predictor.is_tied,
        "held_out": None
        if found is None
        else {
            "points": found.count,
            "inside_95": found.inside,
            "nominal_rms_m": found.without_m,
            "left_rms_m": found.left_m,
            "predicted_rms_m": found.predicted_m,
        },
        "causes": [
            {
                "name": one.name,
                "expected_m": one.expected_m,
                "uncertain_m": one.uncertain_m,
                "without_m": one.without_m,
            }
            for one in trust.importances
        ],
        "sizes": {
            source.name: float(size)
            for source, size in zip(trust.discrepancy.sources, trust.posterior.sizes, strict=True)
        },
        "tasks": [_task_json(one) for one in tasks],
        "iso9283": pose_json(poses),
        "in_words": [*sentences(trust), *(line for one in tasks for line in task_sentences(one))],
        "warnings": list(trust.warnings),
    }


def _task_json(one: Reliability) -> dict[str, object]:
    low, high = one.interval
    return {
        "tolerance_m": one.tolerance_m,
        "probability": one.probability,
        "lower": low,
        "upper": high,
        "draws": one.draws,
        "largest_median_m": float(np.median(one.largest_m)),
        "largest_95_m": float(np.quantile(one.largest_m, 0.95)),
        "worst_time_s": one.worst_time_s,
        "duration_s": one.duration_s,
    }
