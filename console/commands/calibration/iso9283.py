"""`armwright iso9283`: the fourteen criteria of ISO 9283 from recorded data, from the arm, or from a mock arm."""

import argparse
import contextlib
import sys
from dataclasses import replace
from pathlib import Path

from calib.iso9283.pose_criteria import Iso9283Error
from calib.iso9283.programme import PROGRAMMES, Extent, TestCube, largest_cube
from calib.iso9283.result import summary_text
from console.commands.connection import in_control_of
from console.commands.progress import Bar, answer
from control.model.arm import Arm
from control.model.description import load_arm
from control.server.client import ArmClient
from procedures.folders import require_writable
from procedures.iso9283 import Planned, RecordedFiles, evaluate_files, largest_load_kg, plan, rated_speed_m_s, record
from procedures.tour import bench_of, telling_where

FULL = Extent()
QUICK = Extent(repeats=5, path_cycles=3, speed_shares=(0.5, 1.0), drift_s=30.0, drift_sets=2)
MOCK_LOAD_kg = 1.0
MOCK_SHARE = 0.7  # of the largest load: friction needs torque, too
REAL_SPEED, MOCK_SPEED = 0.5, 1.0


def run(args: argparse.Namespace) -> int:
    """Record if requested, evaluate, and print the results."""
    arm = load_arm(args.arm)
    ways = [name for name in ("points", "record", "mock") if getattr(args, name)]
    if len(ways) != 1:
        raise Iso9283Error(
            f"expected one of --points FILE, --record and --mock, got {' and '.join('--' + w for w in ways) or 'none'}"
        )
    if args.points and args.plan_only:
        raise Iso9283Error("--plan-only plans a recording: give --record or --mock, not --points")
    if not args.plan_only:
        require_writable(Path(args.out))
    if args.points:
        points, logs = Path(args.points), [Path(log) for log in args.log or ()]
        return _evaluate(args, arm, RecordedFiles(points, logs, programme=_programme(args, points)))
    _require_within(args.speed, "--speed", 1.0, "a fraction of the joints' limits")
    _require_within(args.rated_speed, "--rated-speed", arm.limits.tip_speed_m_s, "a rated path speed in m/s")
    is_real = args.record and not args.plan_only
    with contextlib.closing(in_control_of(args, arm)) if is_real else contextlib.nullcontext() as client:
        return _record_and_evaluate(args, arm, client)


def _record_and_evaluate(args: argparse.Namespace, arm: Arm, client: ArmClient | None) -> int:
    """Plan, print the plan, record on `client`'s arm or on a mock, evaluate."""
    cube = _cube(args, arm)
    extent = _extent(args, arm, cube)
    rated_m_s = args.rated_speed or rated_speed_m_s(arm, cube)
    planned = plan(arm, cube, extent, rated_m_s)
    sys.stdout.write(_described(arm, cube, planned, rated_m_s))
    sys.stdout.flush()
    if args.plan_only:
        return 0
    out = Path(args.out)
    with telling_where(out):
        if client is None:
            _record_mock(args, arm, planned, out)
        else:
            _record_real(args, arm, client, planned, out)
    files = RecordedFiles(out / "points.csv", [out / "log.csv"], programme=out / "programme.json")
    return _evaluate(args, arm, files, _notes(extent, cube))


def _evaluate(args: argparse.Namespace, arm: Arm, files: RecordedFiles, notes: tuple[str, ...] = ()) -> int:
    out = Path(args.out)
    files = replace(
        files,
        logs=[log for log in files.logs if not _is_only_header(log)],
        others=[Path(other) for other in args.other or ()],
        is_as_given=args.as_given,
    )
    evaluation, warnings = evaluate_files(arm, files, args.band_m, out, notes)
    for warning in warnings:
        sys.stderr.write(f"armwright: {warning}\n")
    written = {"report": out / "iso9283.html", "figures": out / "iso9283.json"}
    answer(args, written["figures"], summary_text(evaluation.criteria), written)
    return 0


def _require_within(value: float | None, option: str, upper: float, what: str) -> None:
    if value is not None and not 0.0 < value <= upper:
        raise Iso9283Error(f"{option}: expected {what} above 0 and up to {upper:g}, got {value:g}")


def _is_only_header(log: Path) -> bool:
    """Whether our own log.csv holds no run, because no programme with runs was requested."""
    if log.suffix == ".gz":
        return False
    with log.open("rb") as file:
        return file.readline().startswith(b"run,t_s,programme") and not file.readline()


def _programme(args: argparse.Namespace, points: Path) -> Path | None:
    """The given programme.json, or the one beside the points."""
    if args.programme:
        return Path(args.programme)
    beside = points.with_name("programme.json")
    return beside if beside.exists() else None


def _extent(args: argparse.Namespace, arm: Arm, cube: TestCube) -> Extent:
    base = QUICK if args.quick else FULL
    load_kg = args.rated_load_kg or 0.0
    if args.rated_load_kg is None and args.mock:
        load_kg = min(MOCK_LOAD_kg, MOCK_SHARE * largest_load_kg(arm, cube))
    programmes = tuple(args.programmes or PROGRAMMES)
    return Extent(
        args.repeats if args.repeats is not None else base.repeats,
        args.path_cycles if args.path_cycles is not None else base.path_cycles,
        tuple(args.speeds or base.speed_shares),
        args.drift_s if args.drift_s is not None else base.drift_s,
        base.drift_sets,
        load_kg,
        programmes,
    )


def _cube(args: argparse.Namespace, arm: Arm) -> TestCube:
    if (args.cube_centre is None) != (args.cube_edge is None):
        raise Iso9283Error("give both --cube-centre X Y Z and --cube-edge M, or neither")
    if args.cube_edge is None:
        return largest_cube(arm)
    x, y, z = args.cube_centre
    return TestCube((x, y, z), args.cube_edge)


def _record_mock(args: argparse.Namespace, arm: Arm, planned: Planned, out: Path) -> None:
    """Record on a mock arm in this process; only this needs the simulation."""
    from procedures.mock import saved_mock

    with Bar("iso9283") as bar:
        bar.advance("homing", 0.0)
        with saved_mock(arm, args.scenario, args.seed, out, args.speed or MOCK_SPEED) as bench:
            record(arm, bench, planned, out, bar.advance)


def _record_real(args: argparse.Namespace, arm: Arm, client: ArmClient, planned: Planned, out: Path) -> None:
    """Record on the connected arm, which must be homed and holding, with a camera that sees the tip."""
    loads_kg = [getattr(step, "payload_kg", 0.0) for step in planned.steps]
    bench = bench_of(client, loads_kg, needs_tip=True, speed=args.speed or REAL_SPEED)
    with Bar("iso9283") as bar:
        record(arm, bench, planned, out, bar.advance)


def _described(arm: Arm, cube: TestCube, planned: Planned, rated_m_s: float) -> str:
    x, y, z = cube.centre_m
    return (
        f"arm {arm.name}: test cube of {cube.edge_m:.3f} m about ({x:.3f}, {y:.3f}, {z:.3f}) m, rated path speed"
        f" {rated_m_s:.3g} m/s, {len(planned.steps)} visits and runs; everything is within reach\n"
    )


def _notes(extent: Extent, cube: TestCube) -> tuple[str, ...]:
    shares = ", ".join(f"{100.0 * share:.0f} %" for share in extent.speed_shares)
    return (
        f"{extent.repeats} visits of each pose (the standard: {FULL.repeats}), {extent.path_cycles} cycles of each path (the"
        f" standard: {FULL.path_cycles}), at {shares} of the rated path speed; drift over {extent.drift_s:.0f} s (the standard:"
        " eight hours)",
        f"test cube of {cube.edge_m:.3f} m, plane C1-C2-C7-C8",
    )
