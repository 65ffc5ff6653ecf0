"""What can be measured on the reference arm, as the tests of the design see it."""

import dataclasses

import numpy as np

from benchmarks.calibration.design_trial import ARM, NOISE_m
from calib.arm_problem.assembly import Choice
from calib.design.candidates import free_candidates, joined, placed_boards, table_candidates, workspace_poses
from calib.design.information import experiment_of

UNKNOWN = dataclasses.replace(ARM, table=dataclasses.replace(ARM.table, known_pose=False))
WORKSPACE = workspace_poses(ARM, [], 150)


def experiment(arm=ARM, setups=("normal", "roll", "pitch"), free_count=200, choice=None):
    """Cavities of the setups and some free poses: (experiment, poses)."""
    boards = placed_boards(arm, setups, None, {})
    parts = [table_candidates(arm, board, None, False) for board in boards.values()]
    parts += [free_candidates(arm, boards.values(), count=free_count)] if free_count else []
    poses = joined(parts)
    return experiment_of(arm, poses, WORKSPACE, NOISE_m, choice or Choice()), poses


def drawn(count, total, seed):
    return np.random.default_rng(seed).choice(total, count, replace=False)
