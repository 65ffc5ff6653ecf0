"""What planning by the predicted error gains on the mock arm, before anything is corrected. `make planning-study`.

Each mock arm is recorded once with its camera (static poses as `armwright gap --record --quick` takes them). A circle and eight
stops are then planned as given and by `calib.task_planning`, in place and with work that may be moved, run, and measured with the
camera. `demo`: the arm of the demo by its nominal file. `play`: 3 to 8 mrad of play in one joint, geometry calibrated, play not
corrected. `worn`: the same with 4 mrad in every joint.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from benchmarks.studies import add_options
from calib.arrays import Array
from calib.calibration import CalibrationPlan, calibrate
from calib.gap.plan.plan import GENTLE, PlanRequest, recording_plan
from calib.points.points import Points, read_points
from calib.studies import executor
from calib.task_planning import Freedom, WayOfPath, WayOfStops, planned_path, planned_stops
from calib.trust.trust import MapRequest, trust_in
from control.model.arm import Arm, Vector3
from control.model.description import load_arm
from control.motion.waypoints import Waypoints
from control.plain_text import silent
from control.server.client import ArmClient
from hil_mocks.scenario import EffectTable, Scenario, load_scenario
from procedures.gap_recording import record
from procedures.mock import SteppedBench, saved_mock, scenario_bytes
from procedures.survey import Model, SurveyedPath, track_of

SORTS = ("demo", "play", "worn")
AREA_m = (0.3, 0.3, 0.2)
PLAY_rad = (0.003, 0.008)
WORN_rad = 0.004
HEIGHT_m = 0.05
SETTLE_s, AVERAGE_s = 0.3, 0.3


@dataclass(frozen=True)
class Gain:
    """Errors as given and as planned, root mean square [m]: predicted (2,), and measured by the camera (2,)."""

    task: str  # circle or stops, in place or moved
    predicted_m: tuple[float, float]
    measured_m: tuple[float, float]

    @property
    def ratio(self) -> float:
        """Measured error as planned over that as given."""
        return self.measured_m[1] / self.measured_m[0]


@dataclass(frozen=True)
class Cases:
    """Arms of one sort, the first of this seed; the work may be moved by +- area_m."""

    sort: str
    first_seed: int
    area_m: Vector3


def tasks(arm: Arm) -> tuple[Waypoints, Waypoints]:
    """A circle above the table's, and stops on it, in an order that turns the joints over."""
    x, y, z = (arm.table.origin_m if arm.table is not None else None) or (0.5, 0.0, 0.0)

    def ring(turns: list[float], radius_m: float) -> Waypoints:
        angles = [2.0 * math.pi * turn for turn in turns]
        points = [(x + radius_m * math.cos(a), y + radius_m * math.sin(a), z + HEIGHT_m) for a in angles]
        return Waypoints(tuple(points), None)

    return ring([k / 24 for k in range(25)], 0.09), ring([0.0, 0.5, 0.12, 0.62, 0.25, 0.75, 0.37, 0.87], 0.12)


def hidden(sort: str, seed: int) -> Scenario:
    """The mock arm of a case."""
    demo = msgspec.structs.replace(load_scenario("demo"), seed=seed)
    if sort == "demo":
        return demo
    rng = np.random.default_rng(seed)
    joint, width = int(rng.integers(1, 4)), float(rng.uniform(*PLAY_rad))
    widths = {joint: width} if sort == "play" else dict.fromkeys((1, 2, 3), WORN_rad)
    kept = tuple(one for one in demo.effect if not (one.effect == "backlash" and one.joint in widths))
    play = tuple(EffectTable("backlash", j, {"width_rad": w}) for j, w in widths.items())
    return msgspec.structs.replace(demo, effect=(*kept, *play))


def gains(sort: str, seed: int, area_m: Vector3) -> list[Gain]:
    """Record, plan, run, measure; one Gain a task."""
    nominal = load_arm("right")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scenario = folder / "hidden.toml"
        scenario.write_bytes(scenario_bytes(hidden(sort, seed)))
        plan = recording_plan(nominal, PlanRequest(has_motions=False, is_quick=True))
        with saved_mock(nominal, str(scenario), seed, folder / "recorded") as bench:
            record(nominal, bench, plan, folder / "recorded", silent)
        points, _ = read_points(folder / "recorded" / "points.csv", nominal.joint_count)
        return list(_compared(nominal, points, sort, area_m, scenario, folder / "log"))


def _compared(nominal: Arm, points: Points, sort: str, area_m: Vector3, scenario: Path, log: Path) -> Iterator[Gain]:
    arm = nominal if sort == "demo" else calibrate(nominal, points, CalibrationPlan(starts_count=2)).arm
    predictor = trust_in(arm, points, MapRequest(poses_count=300, is_checked=False)).predictor
    circle, ring = tasks(nominal)
    freedoms = {"in place": Freedom(any_order=True), "moved": Freedom(area_m, any_order=True)}
    paths = {name: planned_path(arm, predictor, circle, freedom) for name, freedom in freedoms.items()}
    stops = {name: planned_stops(arm, predictor, ring, freedom) for name, freedom in freedoms.items()}
    bench = SteppedBench(nominal, scenario, log)
    try:
        client = bench.start(replace(arm, table=None))  # it moves with the work
        client.enable()
        client.home()
        given_m = run_path(paths["moved"].plain, None, client, log)
        for name, path in paths.items():
            found_m = run_path(path.chosen, path.chosen.lead_in_rad, client, log)
            yield Gain(f"circle {name}", (path.plain.cost.rms_m, path.chosen.cost.rms_m), (given_m, found_m))
        given_m = visit_stops(stops["moved"].plain, client)
        for name, plan in stops.items():
            found_m = visit_stops(plan.chosen, client)
            yield Gain(f"stops {name}", (plan.plain.cost.rms_m, plan.chosen.cost.rms_m), (given_m, found_m))
        bench.stop()
    finally:
        bench.close()


def run_path(way: WayOfPath, lead_in_rad: Sequence[float] | None, client: ArmClient, log: Path) -> float:
    """Run the path, by way of a lead-in if given; its error by the camera, root mean square [m]."""
    to_rest(way.arm, client)
    if lead_in_rad is not None:
        client.move_joints(lead_in_rad)
    client.move_joints(way.plan.q_start_rad, 0.5)
    client.run_path(way.plan.to_message())
    number = int(client.status()["run"])
    client.wait(0.5)
    track = track_of(next(log.glob("*.armlog")), Model(way.arm), SurveyedPath(number), "path")
    return _rms_m(track.measured_m - track.planned_m)


def to_rest(arm: Arm, client: ArmClient) -> None:
    """Where plans begin: a way straight from the last task's place may lead through the table."""
    if arm.rest is not None:
        client.move_joints(arm.rest.q_rad)


def visit_stops(way: WayOfStops, client: ArmClient) -> float:
    """Visit the stops; their error by the camera, root mean square [m]."""
    off = []
    to_rest(way.arm, client)
    for row in way.order:
        if way.has_lead_in[row]:
            client.move_joints(way.lead_in_rad[row].tolist())
        client.move_joints(way.poses.q_rad[row].tolist(), GENTLE)
        client.wait(SETTLE_s)
        off.append(np.array(client.average(AVERAGE_s).tip_m) - np.array(way.waypoints.points[row]))
    return _rms_m(np.array(off))


def _rms_m(errors: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


def gains_of_case(cases: Cases, number: int) -> list[Gain]:
    """`gains`, as a task of a study."""
    return gains(cases.sort, cases.first_seed + number, cases.area_m)


def main() -> None:
    """Print a line a task and arm, and the mean ratio of each sort."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=6)
    parser.add_argument("--first-seed", type=int, default=12, help="12 is the demo's own")
    parser.add_argument("--sorts", nargs="+", choices=SORTS, default=SORTS)
    parser.add_argument("--area", nargs=3, type=float, default=AREA_m, metavar=("X", "Y", "Z"))
    add_options(parser)
    args = parser.parse_args()
    x, y, z = args.area
    with executor(args.cases, args.workers, args.cluster) as runs:
        for sort in args.sorts:
            cases, found = Cases(sort, args.first_seed, (x, y, z)), list[Gain]()
            for number, of_arm in runs.results(gains_of_case, cases, range(args.cases)):
                found += of_arm
                for one in of_arm:
                    predicted, measured = (
                        f"{1e3 * before:.3f} to {1e3 * after:.3f} mm" for before, after in (one.predicted_m, one.measured_m)
                    )
                    print(
                        f"{sort} {args.first_seed + number} {one.task}: predicted {predicted}, measured {measured},"
                        f" ratio {one.ratio:.2f}",
                        flush=True,
                    )
            for task in dict.fromkeys(one.task for one in found):
                ratios = [one.ratio for one in found if one.task == task]
                print(f"{sort} {task}: ratio {np.mean(ratios):.2f}, worst {max(ratios):.2f}, {len(ratios)} arms")


if __name__ == "__main__":
    main()
