"""tolerances.json for programs and map.npz: formats in docs/formats.md."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.points.writer import replace_file
from calib.tolerances.result import PERCENTILES, Made
from calib.tolerances.study import SHARE, STAGES
from calib.tolerances.words import sentences

FORMAT = "tolerances/1"


def write_map(file: Path, made: Made) -> None:
    """The map as arrays [SI]: the first axis of errors is the stage."""
    at, arm = made.design.map, made.design.arm
    content = io.BytesIO()
    np.savez_compressed(
        content,
        stage=np.array(STAGES),
        q_rad=at.q_rad,
        direction=at.direction,
        tip_m=ArmModel(arm).tips(arm.dh, at.q_rad),
        rms_m=np.sqrt(np.mean(made.distance_m**2, axis=1)),
        median_m=np.median(made.distance_m, axis=1),
        within_95_m=np.array([made.map_m(stage) for stage in range(len(STAGES))]),
        kept_m=made.kept_m,
    )
    replace_file(file, content.getvalue())


def write_json(
    file: Path,
    made: Made,
    tolerance_m: float | None,
    about: Mapping[str, object],
    inputs: Mapping[str, str],
) -> None:
    """tolerances.json: `about` has date and program_version; `inputs` a hash by name."""
    content = {
        "format": FORMAT,
        "arm": made.design.arm.name,
        **about,
        "inputs": dict(inputs),
    }
    content |= made_json(made, tolerance_m)
    replace_file(file, (json.dumps(content, indent=2, allow_nan=False) + "\n").encode())


def made_json(made: Made, tolerance_m: float | None) -> dict[str, object]:
    """The result for programs; SI units."""
    design = made.design
    return {
        "arms": made.arms_count,
        "seed": design.seed,
        "calibration": {"poses": len(design.calibration), "noise_m": design.tolerances.noise_m},
        "share_of_poses": SHARE,
        "tolerance_m": tolerance_m,
        "stages": [_stage(made, stage, tolerance_m) for stage in range(len(STAGES))],
        "in_words": list(sentences(made, tolerance_m)),
    }


def _stage(made: Made, stage: int, tolerance_m: float | None) -> dict[str, object]:
    kept = {f"{100 * share:g} %": asdict(made.kept(stage, share)) for share in PERCENTILES}
    return {
        "stage": STAGES[stage],
        "kept_m": kept,
        "rms_m": made.rms_m(stage),
        "share_within_tolerance": None if tolerance_m is None else asdict(made.within(stage, tolerance_m)),
        "costs": [
            {"name": one.name, "share": asdict(one.share[stage]), "left_rms_m": one.left_m[stage]}
            for one in made.costs
        ],
    }
