"""`armwright demo paper`: the experiment of SpringerPlus 5:1771 on the mock arm, with two further steps.

As there: 33 cavities on the level, rolled and pitched board, the tip seated by hand; DH deviations within 5 mm and 2 degrees by
the sum of distances, from each tilt alone; verification at unused points, measured by the camera. Beyond it:
all tilts together, free poses measured by the camera, and backlash in the model and in the commands.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arrays import Array, norms
from calib.calibration import write_calibrated_arm
from calib.points.points import Points, read_points
from calib.points.writer import PointsWriter
from calib.results import input_file, made_today, write_json
from calib.session.take import board_points
from control.files import write_whole
from control.model import table as tables
from control.model.arm import Arm, Table
from control.plain_text import Advance
from procedures.demo import paper_models
from procedures.demo.paper_page import PaperReplay, document, paper_page
from procedures.mock import MockBench

BEFORE_SHARE, TABLE_SHARE, FREE_SHARE = 0.1, 0.42, 0.54  # share of the total time at the end of each part


@dataclass(frozen=True, slots=True)
class PaperOutcome:
    """The result and its path."""

    replay: PaperReplay
    report: Path
    figures: Path


def run(arm: Arm, bench: MockBench, out: Path, advance: Advance) -> PaperOutcome:
    """Run the whole experiment on the bench's arm; results are in the folder `out`."""
    table = tables.table_of(arm)
    targets = (*paper_models.verification_targets(table), *paper_models.other_trajectory(table))
    advance("homing", 0.0)
    client = bench.start(arm)
    client.enable()
    client.home()
    mover = paper_models.Mover(arm, bench, client)
    visits = _Visits(mover, targets, out, advance)
    before_m = visits.visit(arm, "before", 0.02, BEFORE_SHARE)
    _record(arm, table, mover, out / "points.csv", advance)
    points, _ = read_points(out / "points.csv", arm.joint_count)
    advance("identification", FREE_SHARE)
    models = paper_models.models_of(arm, points)
    reached = {}
    for k, model in enumerate(models):
        shares = FREE_SHARE + (0.98 - FREE_SHARE) * np.array([k, k + 1]) / len(models)
        commanded_arm = paper_models.with_friction(model, arm, points) if model.backlash else model.arm
        reached[model.name] = visits.visit(commanded_arm, model.name, *shares.tolist())
    if arm.rest is not None:
        client.move_joints(arm.rest.q_rad, bench.speed)
    bench.stop()
    advance("report", 0.98)
    replay = PaperReplay(targets, before_m, models, reached, _table_error_m(arm, points), paper_models.table_says(arm, points))
    outcome = _written(arm, replay, out)
    advance("done", 1.0)
    return outcome


@dataclass(frozen=True, slots=True)
class _Visits:
    """Moves the tip to the targets by a model of the arm and measures it with the camera."""

    mover: paper_models.Mover
    targets: Sequence[paper_models.Goal]
    out: Path
    advance: Advance

    def visit(self, arm: Arm, name: str, start: float, end: float) -> Array:
        """Measured tips (m, 3); the records go to verification_NAME.csv, the progress from `start` to `end`."""
        poses = paper_models.commands(arm, self.targets, self.mover.q_rad)
        file = self.out / f"verification_{_in_file(name)}.csv"
        what = "verification, before" if name == "before" else f"verification, after: {name}"
        with PointsWriter(file, arm.joint_count) as writer:
            for done, _ in enumerate(self.mover.visit(poses, writer)):
                self.advance(what, start + (end - start) * done / len(poses))
        return read_points(file, arm.joint_count)[0].tip_m


def _record(arm: Arm, table: Table, mover: paper_models.Mover, file: Path, advance: Advance) -> None:
    """The session: every cavity on every tilt by hand, then the free poses, each from both sides."""
    cavities = [point for setup in paper_models.SETUPS for point in board_points(setup, tables.cavities(table, setup))]
    free = [
        paper_models.GentlePose("free", f"f{k}", tuple(q.tolist()), (side,) * arm.joint_count, repeat)
        for k, q in enumerate(paper_models.free_poses(arm), 1)
        for repeat, side in ((1, 1), (2, -1))
    ]
    with PointsWriter(file, arm.joint_count) as writer:
        for done, record in enumerate(mover.seat(cavities, writer), 1):
            share = BEFORE_SHARE + (TABLE_SHARE - BEFORE_SHARE) * done / len(cavities)
            advance(f"table: {record.setup} {record.point}", share)
        for done, _ in enumerate(mover.visit(free, writer)):
            advance("free poses", TABLE_SHARE + (FREE_SHARE - TABLE_SHARE) * done / len(free))


def _table_error_m(arm: Arm, points: Points) -> float:
    """Mean distance of the nominal model's tips from the cavities of the level board."""
    level = points.chosen([k for k, setup in enumerate(points.setup) if setup == paper_models.SETUPS[0]])
    return float(norms(level.tip_m - ArmModel(arm).tips(arm.dh, level.q_rad)).mean())


def _written(arm: Arm, replay: PaperReplay, out: Path) -> PaperOutcome:
    """Report, figures and calibrated arms."""
    made = made_today(*(input_file(path, "recorded points") for path in sorted(out.glob("*.csv"))))
    of_points = made_today(input_file(out / "points.csv", "recorded points"))
    for model in replay.models:
        write_calibrated_arm(out / f"arm_{_in_file(model.name)}.toml", arm, model.found, of_points)
    figures, report = out / "paper.json", out / "report.html"
    write_json(figures, made.heading("paper-replay/1") | document(replay))
    write_whole(report, paper_page(replay, arm.name, made))
    return PaperOutcome(replay, report, figures)


def _in_file(name: str) -> str:
    return name.replace(" ", "_")
