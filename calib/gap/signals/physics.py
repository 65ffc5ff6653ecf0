"""One evaluation of the model on all runs: current from motion, voltage from current and motion, tip from angles.

Electrical, with the command u held over a sample from its time on (delayed by tau), i sampled just before the next:
    L di/dt + R i = u - K speed,   K = torque constant times gear ratio (times what torque_constant says).
Mechanical, at the motor, in joint angles:
    K i = J speed' + transmitted + friction(speed, transmitted) + cogging(q).
Samples are corners of the staircase that the voltage makes: what lies between them is in `staircase`. Where no voltage is
recorded, the mean of a current stands T/2 - L/R earlier than its sample, and the voltage's part of i is shifted by that much;
a drive that closes the loop itself changes its voltage many times a sample, so that its current is that of the moment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arm_problem.link_bending import bending_m
from calib.arm_problem.observations import seen_less_far_m
from calib.arrays import Array
from calib.gap.signals.body import ActingTerms, BodyTorques, is_seen_alone, sorted_terms
from calib.gap.signals.following import YieldingJoints
from calib.gap.signals.recording import EvenRun, RunSet
from calib.gap.signals.staircase import Staircase, settled_shares
from calib.gap.signals.terms import STILL, Law, MotorAhead, angle_error, joint_ahead, place, sampled_friction_Nm
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm

LATEST_s = 0.01  # of a delay
MOST_OF_PERIOD = 0.999  # later than that, a sample is the next one


@dataclass(frozen=True, slots=True)
class Prediction:
    """What the model expects of one run at every sample, minus what was measured: (m, n), (m, n), (frames, 3)."""

    current_A: Array
    voltage_as_A: Array
    tip_m: Array


@dataclass(frozen=True, slots=True)
class Sensed:
    """What a model makes of one run's sensors, whatever its mechanics, (m, n) each: the motors beyond their encoders, the links'
    angles, speeds and accelerations where encoders err, the mean current, and what voltage and speed leave of it.
    """

    ahead: MotorAhead
    turns: tuple[Array, ...]
    current_A: Array
    electrical_A: Array


class Physics:
    """Evaluates models on one recording."""

    def __init__(self, arm: Arm, recording: RunSet) -> None:
        self.arm, self.recording = arm, recording
        self.body = BodyTorques(arm, recording)
        # K, joint torque per ampere; R and L/R of the windings; motor turns a joint turn: (n,)
        self.torque_per_A = np.array([d.torque_constant_Nm_A * d.gear_ratio for d in arm.drives])
        self.resistance_ohm = np.array([d.resistance_ohm for d in arm.drives])
        self.lag_s = np.array([d.lag_s for d in arm.drives])
        self.gear_ratios = tuple(float(d.gear_ratio) for d in arm.drives)
        self._supply = np.array([d.supply_V for d in arm.drives])
        self._period = 1.0 / recording.filters.rate_Hz
        self._voltage = [recording.filters.states(run.voltage_V) for run in recording.runs]
        self._staircase = Staircase(self.body.windings(), self._period, [value for value, _, _ in self._voltage])
        self.following = YieldingJoints(recording, self.body)
        self.tips = SeenTips(arm, recording)
        self._last_driven: tuple[tuple[Law, ...], list[tuple[Array, Array, Array]]] | None = None
        self._last_sensed: tuple[object, list[Sensed]] | None = None

    def current_roughness(self, k: int, joint: int) -> float:
        """White noise of run k's current sensor [A]: the third difference takes off what is smooth.

        What the commanded voltage drives through the winding is taken off first, as it is rough on purpose; how late it acts is
        not known, but at any other time it leaves more.
        """
        run = self.recording.runs[k]
        current = run.current_raw_A[:, joint]
        if not self.recording.has_voltage:
            return _roughness(current)
        delays = np.arange(0.0, LATEST_s, 0.5 * self._period).tolist()
        return min(
            _roughness(current - self._held(run.voltage_V, delay)[:, joint] / self.resistance_ohm[joint]) for delay in delays
        )

    def predict(self, model: Sequence[Law]) -> list[Prediction]:
        """The model's residuals on every run."""
        parts = sorted_terms(model)
        driven = self._driven(tuple(one for one in model if not is_seen_alone(one)))
        return [
            Prediction(current, voltage, self.tips.beside_camera(parts, run, k, offset))
            for k, (run, (current, voltage, offset)) in enumerate(zip(self.recording.runs, driven, strict=True))
        ]

    def _driven(self, model: tuple[Law, ...]) -> list[tuple[Array, Array, Array]]:
        """Currents of motion and of voltage, and links' angles beyond their encoders, (m, n) of each run; kept."""
        if self._last_driven is None or self._last_driven[0] != model:
            self._last_driven = model, self._driven_anew(model)
        return self._last_driven[1]

    def _driven_anew(self, model: tuple[Law, ...]) -> list[tuple[Array, Array, Array]]:
        parts = sorted_terms(model)
        parts.delay_s = max(parts.delay_s, -MOST_OF_PERIOD * self._period)
        torques = self.body.link_torques(parts.load)
        moved = self.following.all(parts) if parts.elastic else []
        result = []
        for k, (run, sensed) in enumerate(zip(self.recording.runs, self._sensed(parts), strict=True)):
            link, offset = torques[k], np.zeros_like(run.q)
            if moved:
                link, offset = moved[k]
            if parts.angles:
                link = link - torques[k] + self.body.moved(parts.load, run, *sensed.turns)
                for term in parts.angles:
                    at, by = place(term)
                    if at != by and term.form.where == "behind":  # its motor pulls at the other joint through the belt
                        link[:, by] += term.values[0] * link[:, at]
            result.append((self._current(parts, run, link, sensed), sensed.electrical_A, offset))
        return result

    def _sensed(self, parts: ActingTerms) -> list[Sensed]:
        """Of every run; the last is kept, as frictions, loads and gears change nothing of it."""
        key = parts.delay_s, parts.scale, parts.sag, parts.angles
        if self._last_sensed is None or self._last_sensed[0] != key:
            found = []
            for k, run in enumerate(self.recording.runs):
                ahead, turns = angle_error(parts.angles, run) if parts.angles else (STILL, ())
                current = self._mean_current(parts, run, k, self.scales(parts), ahead)
                found.append(Sensed(ahead, turns, current, self._electrical(parts, run, k, ahead)))
            self._last_sensed = key, found
        return self._last_sensed[1]

    def _current(self, parts: ActingTerms, run: EvenRun, link: Array, sensed: Sensed) -> Array:
        """Mean current expected from the motion, less the measured one."""
        ahead = sensed.ahead
        wanted = link + self.body.rotor_kg_m2 * (run.acceleration + ahead.acceleration_rad_s2)
        for term in parts.friction:
            j = term.index
            beyond = 0.0 if isinstance(ahead.angle_rad, float) else ahead.angle_rad[:, j]
            own = sampled_friction_Nm(term, run, link[:, j], self.gear_ratios[j], beyond)
            wanted[:, j] += own * (1.0 - parts.behind(term))
        return np.asarray(wanted / (self.torque_per_A * self.scales(parts)) - sensed.current_A)

    def _mean_current(self, parts: ActingTerms, run: EvenRun, k: int, scale: Array, ahead_of: MotorAhead) -> Array:
        K = self.torque_per_A * scale
        if not self.recording.has_current:
            value, slope, _ = self._voltage[k]
            held = value - (0.5 * self._period + parts.delay_s + self.lag_s) * slope
            current = (held - K * (run.speed + ahead_of.speed_rad_s - self.lag_s * run.acceleration)) / self.resistance_ohm
            current += self._staircase.along("driven", parts.delay_s)[k]
            return np.where(run.is_off, 0.0, current)
        if self.recording.has_voltage:
            return np.asarray(run.current_A + self._staircase.along("mean", parts.delay_s)[k])
        held_s = self.recording.held_s
        ahead = np.where(held_s > 0.0, 0.5 * held_s - self.lag_s, 0.0) + min(parts.delay_s, 0.0)
        return np.asarray(run.current_A + ahead * (run.current_slope + K * run.acceleration / self.resistance_ohm))

    def _electrical(self, parts: ActingTerms, run: EvenRun, k: int, ahead: MotorAhead) -> Array:
        """Sampled current expected from voltage and speed, less the measured one."""
        if not (self.recording.has_current and self.recording.has_voltage):
            return np.zeros((len(run), 0))
        scale = self.scales(parts)
        held = self._held(self._voltage[k][0], parts.delay_s)
        seen = self.sagged(parts, held, run.current_A)
        speed = run.speed + ahead.speed_rad_s - self.lag_s * run.acceleration
        expected = (seen - self.torque_per_A * scale * speed) / self.resistance_ohm
        expected += self._staircase.along("sampled", parts.delay_s)[k]
        return np.asarray(expected - run.current_A)

    def _held(self, voltage: Array, delay_s: float) -> Array:
        """The voltage that a winding has settled to when its current is sampled, (m, n)."""
        n = int(delay_s // self._period)
        shares = np.array([settled_shares(float(lag), self._period, delay_s) for lag in self.lag_s])
        return np.asarray(sum(shares[:, back] * _earlier(voltage, n + 1 + back) for back in range(3)))

    def sagged(self, parts: ActingTerms, voltage: Array, current: Array) -> Array:
        """What of a commanded voltage (m, n) reaches the windings of motors that draw current (m, n)."""
        for term in parts.sag:
            if term.form.drawn is None:
                raise ValueError(f"{term.form} says nothing of what a supply gives")
            drawn = term.form.drawn(voltage, current, self._supply)
            voltage = voltage * (1.0 - term.values[0] * drawn / self._supply)
        return voltage

    def scales(self, parts: ActingTerms) -> Array:
        """What the torque constants are of their nominal values (n,)."""
        scale = np.ones(len(self.torque_per_A))
        for j, value in parts.scale.items():
            scale[j] += value
        return scale


def _roughness(values: Array) -> float:
    """Standard deviation of what is white in values (m,)."""
    return float(1.4826 * np.median(np.abs(np.diff(values, 3))) / np.sqrt(20.0))


def _earlier(values: Array, samples: int) -> Array:
    return np.vstack([np.repeat(values[:1], samples, axis=0), values[: len(values) - samples]])


# What the camera sees: tips from angles, and what moves them without a joint.
BENDS_KEPT = 16


class SeenTips:
    """The tips of one recording."""

    def __init__(self, arm: Arm, recording: RunSet) -> None:
        self._arm, self._recording = arm, recording
        self._kinematics = ForwardKinematics(arm)
        self._rigid = [
            self._kinematics.tips(run.q_raw[run.frames]) if recording.has_tip else np.zeros((0, 3)) for run in recording.runs
        ]
        self.jacobians = [
            self._kinematics.jacobians(run.q_raw[run.frames]) if recording.has_tip else np.zeros((0, 3, 0))
            for run in recording.runs
        ]
        self._dh: list[Array] | None = None
        self._bends: dict[tuple[int, float], list[Array]] = {}

    def beside_camera(self, parts: ActingTerms, run: EvenRun, k: int, offset: Array) -> Array:
        """Expected less seen tips (frames, 3) of run k, whose links are `offset` (m, n) beyond their encoders."""
        if not self._recording.has_tip:
            return np.zeros((0, 3))
        q = run.q_raw[run.frames]
        expected = self._rigid[k]
        if parts.elastic or parts.angles:
            turned = q + offset[run.frames]
            if parts.angles:
                turned += joint_ahead(parts.angles, q, run.t_s[run.frames])
            expected = self._kinematics.tips(turned)
        for term in parts.tip:
            expected = expected + self._shift(parts, term, k, run)
        return np.asarray(expected - run.tip_m)

    def _shift(self, parts: ActingTerms, term: Law, k: int, run: EvenRun) -> Array:
        if term.form.acts == "beam":
            return self._bent(term.name.joint or 1, parts.load.payload_kg)[k] * term.values[0]
        if term.form.acts == "geometry":
            if self._dh is None:
                self._dh = [self._kinematics.identification_jacobian(r.q_raw[r.frames]) for r in self._recording.runs]
            return np.asarray(self._dh[k] @ np.array(term.values))
        return seen_less_far_m(run.tip_m, np.array(term.values))

    def _bent(self, link: int, extra_kg: float) -> list[Array]:
        """How the tip moves per 1 / EI of a link as its loads hang on it and are thrown about, (frames, 3) of each run.

        The beam follows its loads at once: its resonance is far above what an arm is moved with.
        """
        key = (link, extra_kg)
        if key not in self._bends:
            if len(self._bends) > BENDS_KEPT:
                self._bends.clear()
            self._bends[key] = [self._bent_along(link, extra_kg, run) for run in self._recording.runs]
        return self._bends[key]

    def _bent_along(self, link: int, extra_kg: float, run: EvenRun) -> Array:
        payload = np.maximum(run.payload_kg + extra_kg, 0.0)

        def accelerated(place_m: Array) -> Array:
            return self._recording.filters.states(place_m)[2]

        return bending_m(self._arm, run.q_raw, payload, link, accelerated)[run.frames]
