"""All fourteen criteria of what was recorded: which figures there are, and what is missing for the others.

Those of visits are in `evaluate_poses`; here are those of approaches (4, 5, 12) and of paths (8 to 11, 14).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array, frozen, norms
from calib.iso9283 import evaluate_poses as of_poses
from calib.iso9283 import path_criteria as path
from calib.iso9283 import pose_criteria
from calib.iso9283.pose_criteria import Iso9283Error, above_zero
from calib.iso9283.recorded import CAMERA, ENCODERS, NO_LOG, PoseGroup, RecordedRun
from calib.iso9283.result import Criterion, Evaluation, Figure, PathTrace, SettlingTrace, criterion, with_headlines


def evaluate(
    groups: Sequence[PoseGroup],
    runs: Sequence[RecordedRun] = (),
    others: Mapping[str, Sequence[PoseGroup]] | None = None,
    corners: Sequence[Array] | None = None,
    band_m: float | None = None,
    joint_count: int = 3,
    notes: Sequence[str] = (),
) -> Evaluation:
    """The fourteen criteria, in order; `needs` of each lists missing input.

    others: the same programme by other arms. corners: E1 .. E4 of the rectangle. band_m: the limit band of stabilization,
    overshoot and posing time; the pose repeatability of P1 if absent.
    """
    first = of_poses.pose_criterion(groups)
    bands = _bands(first, band_m)
    stabilization, overshoot, settled = settling_criteria(runs, bands)
    along, traces = path_criteria(runs)
    return Evaluation(
        (
            first,
            of_poses.direction_criterion(groups),
            of_poses.distance_criterion(groups),
            stabilization,
            overshoot,
            of_poses.drift_criterion(groups),
            of_poses.exchange_criterion(groups, others or {}),
            along,
            reorientation_criterion(runs, joint_count),
            cornering_criterion(runs, corners),
            velocity_criterion(runs),
            posing_criterion(runs, bands),
            of_poses.load_criterion(groups),
            weaving_criterion(runs),
        ),
        tuple(notes),
        of_poses.clouds(groups),
        tuple(traces),
        tuple(settled),
    )


def _bands(first: Criterion, band_m: float | None) -> Bands | None:
    if band_m is not None:
        return Bands(above_zero(band_m, "limit band"), "the given limit band")
    found = [f for f in first.figures if f.symbol == "RP_l" and f.where.startswith("P1")]
    return Bands(found[0].value, "the repeatability RP_l of P1") if found and found[0].value > 0.0 else None


REST_s = 0.3  # at the end of an approach, of which the attained pose is the mean
NOISE_SIGMAS = 4.5  # standard deviations per axis: exceeded by less than one of a thousand positions at rest


@dataclass(frozen=True, slots=True)
class Bands:
    """Limit bands in m: `wanted_m` is the pose repeatability, or the user's."""

    wanted_m: float
    source: str


def settling_criteria(runs: Sequence[RecordedRun], bands: Bands | None) -> tuple[Criterion, Criterion, list[SettlingTrace]]:
    """4 and 5: stabilization time and overshoot of the approaches to P1, by the camera and by the encoders."""
    approaches = [run for run in runs if run.programme == "approach"]
    if not approaches or bands is None:
        need = NO_LOG + "approaches to P1 until the arm rests (programme approach)"
        if approaches:
            need = "a limit band: --band-m, or repeated visits of P1 (the band is their repeatability)"
        return criterion(4, (), (need,)), criterion(5, (), (need,)), []
    times, peaks, traces, needs = [], [], [], []
    is_seen = all(len(run.seen_m) > 2 for run in approaches)
    if not is_seen:
        needs.append("for the tip itself a position measured by a camera (x_m, y_m, z_m); encoders do not measure it")
    for source in (CAMERA, ENCODERS) if is_seen else (ENCODERS,):
        band_m, remark = _band(approaches, source, bands)
        cycles = []
        for run in approaches:
            try:
                cycles.append(_settled(run, source, band_m))
            except Iso9283Error as error:
                needs.append(f"run {run.number} by the {source}: {error}")
        if cycles:
            t, ov = pose_criteria.mean_of_cycles([c.time_s for c in cycles]), max(c.overshoot_m for c in cycles)
            by = "" if source == CAMERA else f" ({ENCODERS})"
            times.append(Figure(f"t{by}", t, "s", f"P1, {source}", len(cycles), True, remark))
            peaks.append(Figure(f"OV{by}", ov, "m", f"P1, {source}", len(cycles), True, remark))
            traces.append(cycles[0].trace)
    return criterion(4, times, needs), criterion(5, peaks, needs), traces


@dataclass(frozen=True, slots=True)
class _Settled:
    time_s: float
    overshoot_m: float
    trace: SettlingTrace


def _settled(run: RecordedRun, source: str, band_m: float) -> _Settled:
    time_s, tip_m = run.measured(source)
    rest_m = pose_criteria.rest_position(time_s, tip_m, REST_s)
    distance = norms(tip_m - rest_m)
    arguments = (time_s, tip_m, rest_m, band_m)
    trace = SettlingTrace(f"P1, {source}", frozen(time_s - run.moving_s[0]), frozen(distance), band_m)
    return _Settled(pose_criteria.stabilization_time(*arguments), pose_criteria.overshoot(*arguments), trace)


def _band(runs: Sequence[RecordedRun], source: str, bands: Bands) -> tuple[float, str]:
    """The limit band, at least the scatter of single measurements at rest."""
    noise_m = NOISE_SIGMAS * _scatter_at_rest_m(runs, source)
    if noise_m <= bands.wanted_m:
        return bands.wanted_m, f"limit band {1e3 * bands.wanted_m:.3f} mm ({bands.source})"
    return noise_m, (
        f"limit band {1e3 * noise_m:.3f} mm: the scatter of single measurements at rest;"
        f" {bands.source} is {1e3 * bands.wanted_m:.3f} mm"
    )


def _scatter_at_rest_m(runs: Sequence[RecordedRun], source: str) -> float:
    """Standard deviation per axis of the measurements at the ends of runs."""
    squares, freedom = 0.0, 0
    for run in runs:
        time_s, tip_m = run.measured(source)
        at_rest = tip_m[time_s >= time_s[-1] - REST_s]
        squares += float(((at_rest - at_rest.mean(axis=0)) ** 2).sum())
        freedom += 3 * (len(at_rest) - 1)
    return float(np.sqrt(squares / freedom)) if freedom else 0.0


def posing_criterion(runs: Sequence[RecordedRun], bands: Bands | None) -> Criterion:
    """12: time from departure until the arm stays within the limit band, by the distance moved."""
    moves = [run for run in runs if run.programme == "posing"]
    if not moves or bands is None:
        need = NO_LOG + "moves between poses over several distances (programme posing)"
        return criterion(12, (), (need if not moves else "a limit band: --band-m, or repeated visits of P1",))
    source = CAMERA if all(len(run.seen_m) > 2 for run in moves) else ENCODERS
    band_m, remark = _band(moves, source, bands)
    by_distance: dict[int, list[float]] = {}
    needs = []
    for run in moves:
        distance = round(1e3 * float(np.linalg.norm(run.set_m[-1] - run.set_m[0])))
        try:
            time_s, tip_m = run.measured(source)
            rest_m = pose_criteria.rest_position(time_s, tip_m, REST_s)
            value = pose_criteria.posing_time(time_s, tip_m, run.moving_s[0], rest_m, band_m)
            by_distance.setdefault(distance, []).append(value)
        except Iso9283Error as error:
            needs.append(f"run {run.number}: {error}")
    figures = [
        Figure("t", float(np.mean(values)), "s", f"{distance} mm", len(values), remark=f"{source}, {remark}")
        for distance, values in sorted(by_distance.items())
    ]
    return criterion(12, with_headlines(figures), needs)


POINTS_ON_PATH = 100
PATH_MARGIN = 0.05  # of the length, at either end, omitted for start and stop
SPEED_WINDOW_s = 0.2
CENTRAL = 0.5  # of a path's time: part where the speed is evaluated
STEADY = 0.05  # of the speed: set-points that vary less have constant speed


def path_criteria(runs: Sequence[RecordedRun]) -> tuple[Criterion, list[PathTrace]]:
    """8: AT and RT of every path at every speed."""
    figures: list[Figure] = []
    needs: list[str] = []
    traces = []
    groups = _path_groups(runs, lambda run: run.programme in ("line", "circle", ""))
    for name, cycles in groups.items():
        try:
            points, attained = _attained(cycles)
            accuracy = path.path_accuracy(points, attained)
            remark = f"{accuracy.skipped} of {len(points)} calculation points skipped" if accuracy.skipped else ""
            figures.append(Figure("AT_p", accuracy.total_m, "m", name, len(cycles), remark=remark))
            if len(cycles) >= 2:
                scatter = path.path_repeatability(points, attained)
                figures.append(Figure("RT_p", scatter.total_m, "m", name, len(cycles), remark=remark))
            else:
                needs.append(f"for the path repeatability of {name} at least two runs; got one")
            traces.append(PathTrace(name, frozen(points), frozen(attained)))
        except Iso9283Error as error:
            needs.append(f"{name}: {error}")
    if not groups:
        needs.append(NO_LOG + "a straight line and a circle, ten times each")
    needs.append("for AT_a, AT_b, AT_c, RT_a, RT_b, RT_c a measured orientation of the tip along the path")
    return criterion(8, with_headlines(figures), needs), traces


def reorientation_criterion(runs: Sequence[RecordedRun], joint_count: int) -> Criterion:
    """9: AT_p of runs on a straight path along which the orientation turns (programme reorientation)."""
    groups = _path_groups(runs, lambda run: run.programme == "reorientation")
    if not groups:
        why = " (three joints only set the tip's position)" if joint_count <= 3 else ""
        need = f"an arm that rotates the tip along a line{why}: runs of programme reorientation in log.csv"
        return criterion(9, (), (need,))
    figures, needs = [], []
    for name, cycles in groups.items():
        try:
            accuracy = path.path_accuracy(*_attained(cycles))
            figures.append(Figure("AT_p", accuracy.total_m, "m", name, len(cycles)))
        except Iso9283Error as error:
            needs.append(f"{name}: {error}")
    return criterion(9, with_headlines(figures), needs)


def cornering_criterion(runs: Sequence[RecordedRun], corners: Sequence[Array] | None) -> Criterion:
    """10: CR and CO at the corners E2, E3, E4; at E1 the path begins and ends at rest."""
    groups = _path_groups(runs, lambda run: run.programme == "rectangle")
    if not groups or corners is None:
        need = NO_LOG + "runs around a rectangle (programme rectangle)"
        return criterion(10, (), (need if not groups else "programme.json, which holds the corners",))
    figures = []
    for name, cycles in groups.items():
        seen = [run.seen_m for run in cycles if len(run.seen_m) > 1]
        if not seen:
            return criterion(10, (), (f"{name}: a measured tip (x_m, y_m, z_m, by a camera)",))
        for k in (1, 2, 3):
            before, corner, after = (np.asarray(corners[i % 4]) for i in (k - 1, k, k + 1))
            arriving, leaving = corner - before, after - corner
            near = [_near(path_m, corner, before, after) for path_m in seen]
            where = f"E{k + 1}, {name}"
            figures.append(Figure("CR", path.corner_round_off(corner, near), "m", where, len(near)))
            length_m = 0.5 * float(np.linalg.norm(leaving))
            value = path.corner_overshoot(corner, arriving, leaving, length_m, near)
            figures.append(Figure("CO", value, "m", where, len(near)))
    return criterion(10, with_headlines(figures), ())


def velocity_criterion(runs: Sequence[RecordedRun]) -> Criterion:
    """11: AV, RV and FV on the middle half of the straight line."""
    groups = _path_groups(runs, lambda run: run.programme == "line" or (not run.programme and _is_steady(run)))
    figures: list[Figure] = []
    needs: list[str] = []
    for name, cycles in groups.items():
        try:
            velocity, commanded, remark = _velocity(cycles)
        except Iso9283Error as error:
            needs.append(f"{name}: {error}")
            continue
        where, n = f"{name}, {commanded:.3f} m/s commanded", len(cycles)
        figures.append(Figure("AV", velocity.accuracy_percent, "%", where, n, remark=remark))
        if velocity.repeatability_percent is not None:
            figures.append(Figure("RV", velocity.repeatability_percent, "%", where, n, remark=remark))
        figures.append(Figure("FV", velocity.fluctuation_m_s, "m/s", where, n, remark=remark))
    if not groups:
        needs.append(NO_LOG + "a straight line at constant speed, ten times")
    return criterion(11, with_headlines(figures), needs)


def _velocity(cycles: Sequence[RecordedRun]) -> tuple[path.PathVelocity, float, str]:
    measured, commanded = [], []
    for run in cycles:
        first, last = _middle(run)
        window_s = min(SPEED_WINDOW_s, 0.25 * (last - first))
        at, speed = path.speeds(*run.measured(CAMERA), window_s)
        measured.append(speed[(first <= at) & (at <= last)])
        at, speed = path.speeds(run.time_s, run.set_m, window_s)
        commanded.append(float(speed[(first <= at) & (at <= last)].mean()))
    wanted = float(np.mean(commanded))
    remark = f"camera speeds over {window_s:.2f} s, in the middle half of the run"
    asked = cycles[0].speed_m_s
    if np.isfinite(asked) and wanted < 0.98 * asked:
        remark += f"; {asked:.3f} m/s were requested; the planner slowed the path to the arm's limits"
    return path.path_velocity(wanted, measured), wanted, remark


def weaving_criterion(runs: Sequence[RecordedRun]) -> Criterion:
    """14: WS and WF of weaving runs, against the weave of the set-points."""
    weaves = [run for run in runs if run.programme == "weave"]
    if not weaves:
        return criterion(14, (), (NO_LOG + "a path that weaves about a line (programme weave)",))
    deviations, needs = [], []
    for run in weaves:
        try:
            began, ended = run.moving_s
            across = _across(run.set_m)
            time_s, tip_m = run.measured(CAMERA)
            moving = (time_s >= began) & (time_s <= ended)
            commanded_rows = (run.time_s >= began) & (run.time_s <= ended)
            commanded = path.weave_of(run.time_s[commanded_rows], run.set_m[commanded_rows], across)
            attained = path.weave_of(time_s[moving], tip_m[moving], across)
            deviations.append(path.weaving_deviations(commanded, attained))
        except Iso9283Error as error:
            needs.append(f"run {run.number}: {error}")
    figures = []
    if deviations:
        where = f"{1e3 * commanded.stroke_m:.0f} mm stroke, {commanded.frequency_Hz:.2f} Hz"
        stroke, frequency = (float(np.mean(column)) for column in zip(*deviations, strict=True))
        figures = [
            Figure("WS", stroke, "%", where, len(deviations), True),
            Figure("WF", frequency, "%", where, len(deviations), True),
        ]
    return criterion(14, figures, needs)


def _across(set_m: Array) -> Array:
    """The direction of a weave's stroke: normal to the line from its start to its end."""
    along = set_m[-1] - set_m[0]
    along = along / np.linalg.norm(along)
    off = set_m - set_m[0]
    off = off - np.outer(off @ along, along)
    return np.asarray(np.linalg.svd(off - off.mean(axis=0), full_matrices=False)[2][0])


def _attained(cycles: Sequence[RecordedRun]) -> tuple[Array, Array]:
    """Calculation points of a commanded path (m, 3) and where the cycles' measured paths cross them (n, m, 3)."""
    points, tangents = path.calculation_points(cycles[0].set_m, POINTS_ON_PATH, PATH_MARGIN)
    attained = [path.crossings(points, tangents, run.measured(CAMERA)[1]) for run in cycles]
    return points, np.stack(attained)


def _path_groups(runs: Sequence[RecordedRun], is_wanted: Callable[[RecordedRun], bool]) -> dict[str, list[RecordedRun]]:
    """Repeats of the same path at the same speed, by name.

    Sequence[RecordedRun] without a name in the log are compared by their set-points; single runs do not belong to a test.
    """
    groups: dict[str, list[RecordedRun]] = {}
    for run in runs:
        if not is_wanted(run) or not run.is_moving:
            continue
        if run.programme:
            speed = f" at {run.speed_m_s:.3g} m/s" if np.isfinite(run.speed_m_s) else ""
            groups.setdefault(f"{run.programme}{speed}", []).append(run)
            continue
        same = (n for n, others in groups.items() if not others[0].programme and _is_repeat(run, others[0]))
        groups.setdefault(next(same, f"path of run {run.number}"), []).append(run)
    return {name: cycles for name, cycles in groups.items() if cycles[0].programme or len(cycles) > 1}


def _middle(run: RecordedRun) -> tuple[float, float]:
    """Start and end of the middle part of a run, where the speed can be constant."""
    began, ended = run.moving_s
    half = 0.5 * CENTRAL * (ended - began)
    return 0.5 * (began + ended) - half, 0.5 * (began + ended) + half


def _is_steady(run: RecordedRun) -> bool:
    """Whether the set-point has constant velocity in the middle of a run."""
    first, last = _middle(run) if run.is_moving else (0.0, 0.0)
    chosen = (run.time_s >= first) & (run.time_s <= last)
    if chosen.sum() < 3:
        return False
    velocity_m_s = np.diff(run.set_m[chosen], axis=0) / np.diff(run.time_s[chosen])[:, None]
    mean = velocity_m_s.mean(axis=0)
    return bool(norms(velocity_m_s - mean).max() < STEADY * np.linalg.norm(mean))


def _is_repeat(run: RecordedRun, first: RecordedRun) -> bool:
    """Whether two runs have the same set-points, to a tenth of a millimetre at equal times."""
    if abs(run.time_s[-1] - first.time_s[-1] - run.time_s[0] + first.time_s[0]) > 0.5:
        return False
    at = np.linspace(0.0, 1.0, 50) * (run.moving_s[1] - run.moving_s[0])
    sampled = [np.column_stack([np.interp(r.moving_s[0] + at, r.time_s, r.set_m[:, k]) for k in range(3)]) for r in (run, first)]
    return bool(np.abs(sampled[0] - sampled[1]).max() < 1e-4)


def _near(path_m: Array, corner: Array, before: Array, after: Array) -> Array:
    """The part of a path around one corner, up to half-way to the adjacent corners."""
    reach = 0.5 * max(float(np.linalg.norm(corner - before)), float(np.linalg.norm(after - corner)))
    offset = path_m - corner
    chosen = path_m[norms(offset) <= reach]
    return chosen if len(chosen) > 1 else path_m
