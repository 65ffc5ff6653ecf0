"""Maps of joints' torques from time series: what the currents need beside everything named.

Two looks. The first is of rows up to 25 Hz, as the decision has them: noise of the measured acceleration is in what the currents
need and in the load alike, and the less of it there is, the less it passes for friction. A motor's turn is faster: the second is
of samples up to 60 Hz, what the first leaves, over the motor's turn alone.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import sparse

from calib.arm_problem.joint_effects import along
from calib.arrays import Array, Mask, rms
from calib.gap.finding import MapCheck
from calib.gap.maps.choose import (
    Candidate,
    DrawnMap,
    MapRows,
    MapsFound,
    chosen,
    maps_of,
    over_angle,
    over_load,
    over_speed,
    over_turn,
)
from calib.gap.posterior.constants import FOLDS
from calib.gap.series.find import DynamicOutcome
from calib.gap.signals.body import sorted_terms
from calib.gap.signals.recording import EvenRun
from control.model.arm import Arm
from control.model.effects import direction
from control.model.maps import CorrectionMap, Over

SAMPLES_PER_s = 200.0  # of the second look: what 60 Hz can tell
PIECE_s = 0.5  # of a run: longer than what hangs together
PIECES = 4  # that are left out together
MOVES_rad_s = 0.008  # below, friction is pre-sliding (as in calib.gap.residuals.rows)
REPORTS_FROM = 2.0 / 3.0  # of a single run (as in calib.gap.series.split)
NONE = "no map of the joints' torques helps recordings that were not fitted: none is written"
Places = npt.NDArray[np.intp]


def torque_maps(arm: Arm, outcome: DynamicOutcome) -> tuple[Arm, MapsFound]:
    """The arm with maps of its joints' torques, where these help runs that were held out, and what they do."""
    if not outcome.physics.recording.has_current:
        return arm, MapsFound((), (), ("a map of torques needs motor currents: none is written",))
    maps = MapsFound((), ())
    driven = {drive.joint for drive in arm.drives}
    for joint in range(1, arm.joint_count + 1):
        signals = Signals.of(outcome, joint)
        first = _looked(signals, signals.slow(), is_fast=False)
        maps += first
        if joint in driven:
            rest = signals.without(first.maps)
            maps += _looked(rest, rest.fast(), is_fast=True)
    if not maps.drawn:
        return arm, MapsFound((), (), (NONE,))
    return dataclasses.replace(arm, maps=(*arm.maps, *maps.maps)), maps


@dataclass(frozen=True, slots=True)
class Signals:
    """One joint's samples (m,), run after run: what the model lacks, `left_Nm`, as the motor would have to add it.

    What that may follow: `motor_rad` is the motor's angle as it was read, all others as the state filter leaves them, and
    `load_Nm` as smooth as rows are.
    """

    outcome: DynamicOutcome
    joint: int
    run: Places
    place: Places
    usable: Mask
    q_rad: Array
    motor_rad: Array
    speed_rad_s: Array
    load_Nm: Array
    left_Nm: Array

    @classmethod
    def of(cls, outcome: DynamicOutcome, joint: int) -> Signals:
        """Of a joint, 1-based."""
        physics, j = outcome.physics, joint - 1
        runs, filters = physics.recording.runs, physics.recording.filters
        parts = sorted_terms(outcome.model)
        rotor, row = float(physics.body.rotor_kg_m2[j]), filters.row
        load = [
            np.convolve(link_Nm[:, j] + rotor * run.acceleration[:, j], row, mode="same")
            for link_Nm, run in zip(physics.body.link_torques(parts.load), runs, strict=True)
        ]
        torque_per_A = float(physics.torque_per_A[j] * physics.scales(parts)[j])
        residual_Nm = [-torque_per_A * prediction.current_A[:, j] for prediction in physics.predict(outcome.model)]
        return cls(
            outcome,
            joint,
            np.repeat(np.arange(len(runs)), [len(run) for run in runs]),
            np.concatenate([np.arange(len(run)) for run in runs]),
            _joined(runs, "usable", j) > 0,
            _joined(runs, "q", j),
            physics.gear_ratios[j] * _joined(runs, "q_raw", j),
            _joined(runs, "speed", j),
            np.concatenate(load),
            np.concatenate(residual_Nm),
        )

    def without(self, maps: tuple[CorrectionMap, ...]) -> Signals:
        """The same beside maps."""
        added = sum((self.table(correction) for correction in maps), np.zeros(len(self.run)))
        return dataclasses.replace(self, left_Nm=self.left_Nm - added)

    def over(self, variable: Over) -> Array:
        """What a table is over."""
        match variable:
            case "motor_turn_rad":
                return self.motor_rad
            case "load_Nm":
                return self.load_Nm
            case "speed_rad_s":
                return self.speed_rad_s
            case _:
                return self.q_rad

    def table(self, correction: CorrectionMap) -> Array:
        """What a map says at every sample."""
        return along(correction, self.over(correction.over), direction(self.speed_rad_s, np))

    def slow(self) -> Band:
        """Rows of the decision: already filtered samples, filtered once more."""
        filters = self.outcome.physics.recording.filters
        return Band.of(self, filters.row, filters.step, is_filtered=True)

    def fast(self) -> Band:
        """Samples as the state filter leaves them; what is made of raw angles goes through it."""
        filters = self.outcome.physics.recording.filters
        return Band.of(self, filters.state[0], max(1, round(filters.rate_Hz / SAMPLES_PER_s)), is_filtered=False)


@dataclass(frozen=True, slots=True)
class Band:
    """Rows (r,) at samples `at`: `mix` (r, m) filters what is made of samples, `left_Nm` (r,) are the signals' own."""

    at: Places
    mix: sparse.csr_array
    left_Nm: Array

    @classmethod
    def of(cls, signals: Signals, kernel: Array, step: int, is_filtered: bool) -> Band:
        """One row every `step` samples where all within reach may be used; `is_filtered`: samples have to be filtered, too."""
        half, m = (len(kernel) - 1) // 2, len(signals.run)
        count = np.bincount(signals.run)[signals.run]
        inside = (signals.place >= half) & (signals.place < count - half)
        bad = np.concatenate([[0], np.cumsum(~signals.usable)])
        here = np.arange(m)
        clean = bad[np.minimum(here + half + 1, m)] == bad[np.maximum(here - half, 0)]
        moves = np.abs(signals.speed_rad_s) > MOVES_rad_s
        at = np.flatnonzero(inside & clean & moves & (signals.place % step == 0))
        columns = at[:, None] + np.arange(-half, half + 1)
        starts = len(kernel) * np.arange(len(at) + 1)
        mix = sparse.csr_array((np.tile(kernel, len(at)), columns.ravel(), starts), shape=(len(at), m))
        return cls(at, mix, mix @ signals.left_Nm if is_filtered else signals.left_Nm[at])


def _looked(signals: Signals, band: Band, is_fast: bool) -> MapsFound:
    """Maps that one look gives."""
    nothing = MapsFound((), ())
    usual = rms(band.left_Nm) if len(band.at) else 0.0
    candidates = _candidates(signals, band, is_fast)
    if not usual > 0.0 or not candidates:
        return nothing
    way = direction(signals.speed_rad_s, np)
    tables = tuple((band.mix @ candidate.columns(signals.over(candidate.over), way)).toarray() for candidate in candidates)
    none = np.zeros((len(band.at), 0))
    folds, pieces = _divided(signals, band)
    choice = chosen(MapRows(band.left_Nm / usual, none, np.zeros(0), candidates, tables, folds, pieces))
    if choice is None:
        return nothing
    maps = maps_of([(candidates[k], usual * values) for k, values in zip(choice.numbers, choice.values, strict=True)])
    before, after = (usual * rms(residual[folds == -1]) for residual in (choice.before, choice.after))
    drawn = tuple(_drawn(signals, band, correction, usual * choice.after) for correction in maps)
    return MapsFound(drawn, (MapCheck("torque_Nm", signals.joint, before, after),))


def _candidates(signals: Signals, band: Band, is_fast: bool) -> tuple[Candidate, ...]:
    joint, at = signals.joint, band.at
    if not len(at):
        return ()
    if is_fast:
        return over_turn(joint, float(np.ptp(signals.motor_rad[at])))
    return (
        *over_angle(joint, "torque_Nm", signals.q_rad[at]),
        *over_load(joint, "torque_Nm", signals.load_Nm[at]),
        *over_speed(joint, signals.speed_rad_s[at]),
    )


def _divided(signals: Signals, band: Band) -> tuple[Places, Places]:
    """Folds of stretches of the runs that decide, -1 for the runs that report; and pieces of runs.

    Not of whole runs: the fastest one would be foretold from slower ones, and every table would come out too stiff.
    """
    runs, run, place = signals.outcome.physics.recording.runs, signals.run[band.at], signals.place[band.at]
    rate_Hz = signals.outcome.physics.recording.filters.rate_Hz
    names = signals.outcome.split.report_runs
    reports = np.isin(run, [k for k, run in enumerate(runs) if run.name in names])
    if len(runs) == 1:
        reports = place >= REPORTS_FROM * len(runs[0])
    pieces_of_run = place // max(1, round(PIECE_s * rate_Hz))
    pieces = pieces_of_run + (int(pieces_of_run.max()) + 1) * run
    return np.where(reports, -1, pieces // PIECES % FOLDS).astype(np.intp), pieces


def _drawn(signals: Signals, band: Band, correction: CorrectionMap, left_Nm: Array) -> DrawnMap:
    table, at = signals.table(correction), signals.over(correction.over)[band.at]
    data = band.mix @ table + left_Nm
    return DrawnMap(correction, np.mod(at, math.tau) if correction.is_periodic else at, data, table[band.at])


def _joined(runs: tuple[EvenRun, ...], key: str, j: int) -> Array:
    return np.concatenate([getattr(run, key)[:, j] for run in runs])
