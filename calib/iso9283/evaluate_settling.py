"""Criteria 4, 5 and 12 of recorded approaches: stabilization time, overshoot, minimum posing time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import frozen, norms
from calib.iso9283.criteria import settling
from calib.iso9283.criteria.checks import Iso9283Error
from calib.iso9283.recorded import CAMERA, ENCODERS, NO_LOG, RecordedRun
from calib.iso9283.result import Criterion, Figure, SettlingTrace, criterion, with_headlines

REST_s = 0.3  # at the end of an approach, of which the attained pose is the mean
NOISE_SIGMAS = 4.5  # standard deviations per axis: exceeded by less than one of a thousand positions at rest
Runs = Sequence[RecordedRun]


@dataclass(frozen=True, slots=True)
class Bands:
    """Limit bands in m: `wanted_m` is the pose repeatability, or the user's."""

    wanted_m: float
    source: str


def settling_criteria(runs: Runs, bands: Bands | None) -> tuple[Criterion, Criterion, list[SettlingTrace]]:
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
        needs.append(
            "for the tip itself a position measured by a camera (x_m, y_m, z_m); encoders do not measure it"
        )
    for source in (CAMERA, ENCODERS) if is_seen else (ENCODERS,):
        band_m, remark = _band(approaches, source, bands)
        cycles = []
        for run in approaches:
            try:
                cycles.append(_settled(run, source, band_m))
            except Iso9283Error as error:
                needs.append(f"run {run.number} by the {source}: {error}")
        if cycles:
            t, ov = settling.mean_of_cycles([c.time_s for c in cycles]), max(c.overshoot_m for c in cycles)
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
    rest_m = settling.rest_position(time_s, tip_m, REST_s)
    distance = norms(tip_m - rest_m)
    arguments = (time_s, tip_m, rest_m, band_m)
    trace = SettlingTrace(f"P1, {source}", frozen(time_s - run.moving_s[0]), frozen(distance), band_m)
    return _Settled(settling.stabilization_time(*arguments), settling.overshoot(*arguments), trace)


def _band(runs: Runs, source: str, bands: Bands) -> tuple[float, str]:
    """The limit band, at least the scatter of single measurements at rest."""
    noise_m = NOISE_SIGMAS * _scatter_at_rest_m(runs, source)
    if noise_m <= bands.wanted_m:
        return bands.wanted_m, f"limit band {1e3 * bands.wanted_m:.3f} mm ({bands.source})"
    return noise_m, (
        f"limit band {1e3 * noise_m:.3f} mm: the scatter of single measurements at rest;"
        f" {bands.source} is {1e3 * bands.wanted_m:.3f} mm"
    )


def _scatter_at_rest_m(runs: Runs, source: str) -> float:
    """Standard deviation per axis of the measurements at the ends of runs."""
    squares, freedom = 0.0, 0
    for run in runs:
        time_s, tip_m = run.measured(source)
        at_rest = tip_m[time_s >= time_s[-1] - REST_s]
        squares += float(((at_rest - at_rest.mean(axis=0)) ** 2).sum())
        freedom += 3 * (len(at_rest) - 1)
    return float(np.sqrt(squares / freedom)) if freedom else 0.0


def posing_criterion(runs: Runs, bands: Bands | None) -> Criterion:
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
            rest_m = settling.rest_position(time_s, tip_m, REST_s)
            value = settling.posing_time(time_s, tip_m, run.moving_s[0], rest_m, band_m)
            by_distance.setdefault(distance, []).append(value)
        except Iso9283Error as error:
            needs.append(f"run {run.number}: {error}")
    figures = [
        Figure("t", float(np.mean(values)), "s", f"{distance} mm", len(values), remark=f"{source}, {remark}")
        for distance, values in sorted(by_distance.items())
    ]
    return criterion(12, with_headlines(figures), needs)
