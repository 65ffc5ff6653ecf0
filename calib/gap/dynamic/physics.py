"""One evaluation of the model on all runs: current from motion, voltage from current and motion, tip from angles.

Electrical, with the command u held over a sample from its time on (delayed by tau), i sampled just before the next:
    L di/dt + R i = u - K speed,   K = torque constant times gear ratio (times what torque_constant says).
Mechanical, at the motor, in joint angles:
    K i = J speed' + transmitted + friction(speed, transmitted) + cogging(q).
Samples are corners of the staircase that the voltage makes: what lies between them is in `staircase`. Where no voltage is
recorded, the mean of a current stands T/2 - L/R earlier than its sample, and the voltage's part of i is shifted by that much.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from calib.arrays import Array
from calib.gap.dynamic.angles import ANGLES, BEHIND, STILL, MotorAhead, angle_error, joint_ahead
from calib.gap.dynamic.body import Body, Load
from calib.gap.dynamic.laws import friction_Nm
from calib.gap.dynamic.play import Followed, Follower, elastics, looses
from calib.gap.dynamic.recording import Flags, Motion, Recording
from calib.gap.dynamic.staircase import Staircase, Winding, settled_shares
from calib.gap.dynamic.terms import Term
from calib.identify.link_bending import bending_m
from control.model.arm import Arm
from control.model.kinematics import Kinematics

SHORTEST_SPRING_rad_Nm = 1e-8
SHARED = ("coulomb_friction", "viscous_friction")  # part of it may act behind an elastic or loose gear
RESTING_rad_s = 0.002  # between link and motor: slower, a loose link lies on its flank
MOST_OF_PERIOD = 0.999  # later than that, a sample is the next one
INERTIA_EVERY = 25  # samples: how heavy a joint is, on the whole
FOLLOWED_KEPT = 16  # motions of elastic joints, some 1.5 MB each

Rubbed = tuple[tuple[Term, tuple[float, float]], ...]


@dataclass(frozen=True, slots=True)
class Prediction:
    """What the model expects of one run at every sample, minus what was measured: (m, n), (m, n), (frames, 3)."""

    current_A: Array
    voltage_as_A: Array
    tip_m: Array


@dataclass(slots=True)
class Parts:
    """Terms by where they act."""

    load: Load = field(default_factory=Load)
    scale: dict[int, float] = field(default_factory=dict)
    delay_s: float = 0.0
    sag: list[tuple[str, float]] = field(default_factory=list)
    friction: list[Term] = field(default_factory=list)
    elastic: list[Term] = field(default_factory=list)
    angles: list[Term] = field(default_factory=list)
    electrical: list[Term] = field(default_factory=list)
    tip: list[Term] = field(default_factory=list)

    def rubbing(self, j: int) -> tuple[float, float]:
        """Coulomb and viscous friction of a joint (0-based) in all."""
        sums = dict.fromkeys(SHARED, 0.0)
        for term in self.friction:
            if term.index == j and term.form in sums:
                sums[term.form] += term.values[0]
        return sums["coulomb_friction"], sums["viscous_friction"]

    def behind(self, term: Term) -> float:
        """The share of a friction that acts behind its elastic or loose gear."""
        if term.form not in SHARED:
            return 0.0
        return sum(gear.values[-1] for gear in self.elastic if gear.index == term.index)


class Physics:
    """Evaluates models on one recording."""

    def __init__(self, arm: Arm, recording: Recording) -> None:
        self.arm, self.recording = arm, recording
        self.body = Body(arm, recording)
        self._kinematics = Kinematics(arm)
        self._K = np.array([d.torque_constant_Nm_A * d.gear_ratio for d in arm.drives])
        self._R = np.array([d.resistance_ohm for d in arm.drives])
        self._lag = np.array([d.inductance_H / d.resistance_ohm for d in arm.drives])
        self._supply = np.array([d.supply_V for d in arm.drives])
        self._gear = np.array([d.gear_ratio for d in arm.drives])
        self._period = 1.0 / recording.filters.rate_Hz
        self._voltage = [recording.filters.states(run.voltage_V) for run in recording.runs]
        self._staircase = Staircase(
            [
                Winding(*map(float, one))
                for one in zip(self._inertias(), self._K, self._R, self._lag, strict=True)
            ],
            self._period,
            [value for value, _, _ in self._voltage],
        )
        self._torques: dict[Load, list[Array]] = {}
        self._moved: dict[tuple[Load, Rubbed], list[tuple[Array, Array]]] = {}
        self._follow: dict[tuple[Load, int], Follower] = {}
        self._followed_terms: dict[tuple[Load, tuple[float, float], Term], Followed] = {}
        self._tips = [
            self._kinematics.tips(run.q_raw[run.frames]) if recording.has_tip else np.zeros((0, 3))
            for run in recording.runs
        ]
        self.jacobians = [
            self._kinematics.jacobians(run.q_raw[run.frames]) if recording.has_tip else np.zeros((0, 3, 0))
            for run in recording.runs
        ]
        self._dh: list[Array] | None = None
        self._bends: dict[tuple[int, float], list[Array]] = {}

    @property
    def torque_per_A(self) -> Array:
        """K, joint torque per ampere (n,)."""
        return self._K

    @property
    def resistance_ohm(self) -> Array:
        """R of the windings (n,)."""
        return self._R

    @property
    def lag_s(self) -> Array:
        """L/R of the windings (n,)."""
        return self._lag

    @property
    def gear_ratios(self) -> tuple[float, ...]:
        """Motor turns a joint turn."""
        return tuple(float(ratio) for ratio in self._gear)

    def _inertias(self) -> Array:
        """What each motor turns while the others may give way, the middle of the recording (n,)."""
        q = np.concatenate([run.q[::INERTIA_EVERY] for run in self.recording.runs])
        inverses = np.linalg.inv(self.body.dynamics(Load()).mass_matrices(q))
        return np.asarray(1.0 / np.median(np.diagonal(inverses, axis1=1, axis2=2), axis=0))

    def link_torques(self, load: Load) -> list[Array]:
        """Link torques of each run (m, n), kept for the loads seen last."""
        if load not in self._torques:
            if len(self._torques) > 24:
                self._torques.clear()
            self._torques[load] = self.body.link_torques(load)
        return self._torques[load]

    def current_roughness(self, k: int, joint: int) -> float:
        """White noise of run k's current sensor [A]: the third difference takes off what is smooth.

        What the commanded voltage drives through the winding is taken off first, as it is rough on purpose.
        """
        run = self.recording.runs[k]
        current = run.current_raw_A[:, joint]
        if self.recording.has_voltage:
            current = current - self._held(run.voltage_V, 0.0)[:, joint] / self._R[joint]
        return float(1.4826 * np.median(np.abs(np.diff(current, 3))) / np.sqrt(20.0))

    def predict(self, model: Sequence[Term]) -> list[Prediction]:
        """The model's residuals on every run."""
        parts = sorted_terms(model)
        parts.delay_s = max(parts.delay_s, -MOST_OF_PERIOD * self._period)
        torques = self.link_torques(parts.load)
        moved = self._follow_all(parts) if parts.elastic else []
        result = []
        for k, run in enumerate(self.recording.runs):
            link, offset = torques[k], np.zeros_like(run.q)
            if moved:
                link, offset = moved[k]
            ahead = STILL
            if parts.angles:
                ahead, turns = angle_error(parts.angles, run)
                link = link - torques[k] + self.body.moved(parts.load, run, *turns)
                for term in parts.angles:
                    if term.form == "belt_coupling" + BEHIND:  # motor 3 pulls at joint 2 through its belt
                        link[:, 1] += term.values[0] * link[:, 2]
            mechanical = self._current(parts, run, k, link, ahead)
            electrical = self._electrical(parts, run, k, ahead)
            result.append(Prediction(mechanical, electrical, self._tip(parts, run, k, offset)))
        return result

    def _current(self, parts: Parts, run: Motion, k: int, link: Array, ahead: MotorAhead) -> Array:
        """Mean current expected from the motion, less the measured one."""
        wanted = link + self.body.rotor_kg_m2 * (run.acceleration + ahead.acceleration_rad_s2)
        for term in parts.friction:
            j = term.index
            own = friction_Nm(term, run, j, link[:, j], float(self._gear[j]))
            wanted[:, j] += own * (1.0 - parts.behind(term))
        scale = self.scales(parts)
        measured = self._mean_current(parts, run, k, scale, ahead)
        return np.asarray(wanted / (self._K * scale) - measured)

    def _mean_current(self, parts: Parts, run: Motion, k: int, scale: Array, ahead_of: MotorAhead) -> Array:
        K = self._K * scale
        if not self.recording.has_current:
            value, slope, _ = self._voltage[k]
            held = value - (0.5 * self._period + parts.delay_s + self._lag) * slope
            current = (held - K * (run.speed + ahead_of.speed_rad_s - self._lag * run.acceleration)) / self._R
            current += self._staircase.of_driven_current(parts.delay_s)[k]
            return np.where(run.is_off, 0.0, current)
        if self.recording.has_voltage:
            return np.asarray(run.current_A + self._staircase.of_mean_current(parts.delay_s)[k])
        ahead = 0.5 * self._period - self._lag + min(parts.delay_s, 0.0)
        return np.asarray(run.current_A + ahead * (run.current_slope + K * run.acceleration / self._R))

    def _electrical(self, parts: Parts, run: Motion, k: int, ahead: MotorAhead) -> Array:
        """Sampled current expected from voltage and speed, less the measured one."""
        if not (self.recording.has_current and self.recording.has_voltage):
            return np.zeros((len(run), 0))
        scale = self.scales(parts)
        held = self._held(self._voltage[k][0], parts.delay_s)
        seen = self.sagged(parts, held, run.current_A)
        speed = run.speed + ahead.speed_rad_s - self._lag * run.acceleration
        expected = (seen - self._K * scale * speed) / self._R
        expected += self._staircase.of_sampled_current(parts.delay_s)[k]
        for term in parts.electrical:
            j = term.index
            if term.form == "resistance":
                expected[:, j] -= term.values[0] * run.current_A[:, j]
            elif term.form == "current offset":
                expected[:, j] += term.values[0]
            elif term.form == "inductance":
                expected[:, j] -= term.values[0] * run.current_slope[:, j]
        return np.asarray(expected - run.current_A)

    def _held(self, voltage: Array, delay_s: float) -> Array:
        """The voltage that a winding has settled to when its current is sampled, (m, n)."""
        n = int(delay_s // self._period)
        shares = np.array([settled_shares(float(lag), self._period, delay_s) for lag in self._lag])
        return np.asarray(sum(shares[:, back] * _earlier(voltage, n + 1 + back) for back in range(3)))

    def sagged(self, parts: Parts, voltage: Array, current: Array) -> Array:
        """What of a commanded voltage (m, n) reaches the windings of motors that draw current (m, n)."""
        for form, resistance in parts.sag:
            if form == "supply_sag":  # a bridge draws duty times motor current
                drawn = np.sum(voltage / self._supply * current, axis=1, keepdims=True)
            else:
                drawn = np.sum(np.abs(current), axis=1, keepdims=True)
            voltage = voltage * (1.0 - resistance * drawn / self._supply)
        return voltage

    def scales(self, parts: Parts) -> Array:
        """What the torque constants are of their nominal values (n,)."""
        scale = np.ones(len(self._K))
        for j, value in parts.scale.items():
            scale[j] += value
        return scale

    def _follow_all(self, parts: Parts) -> list[tuple[Array, Array]]:
        """Link torques and angles beyond the encoders', with the motion of elastic or loose joints in them."""
        key = (parts.load, tuple((term, parts.rubbing(term.index)) for term in parts.elastic))
        if key not in self._moved:
            if len(self._moved) > 6:
                self._moved.pop(next(iter(self._moved)))
            self._moved[key] = self._follow_anew(parts)
        return self._moved[key]

    def _follow_anew(self, parts: Parts) -> list[tuple[Array, Array]]:
        followed = {term.index: self._followed(parts, term) for term in parts.elastic}
        result = []
        for k, run in enumerate(self.recording.runs):
            q, speed, acceleration = np.array(run.q), np.array(run.speed), np.array(run.acceleration)
            offset = np.zeros_like(q)
            for j, found in followed.items():
                offset[:, j] = found.delta_rad[: len(run), k]
                q[:, j] += offset[:, j]
                speed[:, j] += found.speed_rad_s[: len(run), k]
                acceleration[:, j] += found.acceleration_rad_s2[: len(run), k]
            link = self.body.moved(parts.load, run, q, speed, acceleration)
            for j, found in followed.items():
                link[:, j] = found.transmitted_Nm[: len(run), k]
            result.append((link, offset))
        return result

    def flights(self, model: Sequence[Term]) -> dict[int, list[Flags]]:
        """Samples (m,) of each run at which a loose joint (0-based) of the model lies on neither flank or just lands."""
        parts = sorted_terms(model)
        found = {}
        for term in parts.elastic:
            if term.form == "backlash":
                moving = np.abs(self._followed(parts, term).speed_rad_s) > RESTING_rad_s
                found[term.index] = [moving[: len(run), k] for k, run in enumerate(self.recording.runs)]
        return found

    def beyond(self, model: Sequence[Term]) -> tuple[list[Array], list[Array]]:
        """Angles and speeds of the links beyond their motors', (m, n) of each run."""
        parts = sorted_terms(model)
        angles = [np.zeros_like(run.q) for run in self.recording.runs]
        speeds = [np.zeros_like(run.q) for run in self.recording.runs]
        for term in parts.elastic:
            found = self._followed(parts, term)
            for k, run in enumerate(self.recording.runs):
                angles[k][:, term.index] = found.delta_rad[: len(run), k]
                speeds[k][:, term.index] = found.speed_rad_s[: len(run), k]
        return angles, speeds

    def foresee(self, model: Sequence[Term], variants: Sequence[Term]) -> None:
        """Follow one joint's elastic or loose gear with several values at once, for `predict` to find them done."""
        self._foresee(sorted_terms(model), variants)

    def _foresee(self, parts: Parts, variants: Sequence[Term]) -> None:
        rubbing = parts.rubbing(variants[0].index)
        missing = [term for term in variants if (parts.load, rubbing, term) not in self._followed_terms]
        if not missing:
            return
        of = replace(
            self._follower(parts.load, missing[0].index), coulomb_Nm=rubbing[0], viscous_Nm_s_rad=rubbing[1]
        )
        values = [t.values for t in missing]
        if missing[0].form == "backlash":
            found = looses(of, [(max(w, 0.0), share) for w, share in values])
        else:
            springs = [(1.0 / max(c, SHORTEST_SPRING_rad_Nm), max(d, 0.0), share) for c, d, share in values]
            found = elastics(of, springs)
        while len(self._followed_terms) > FOLLOWED_KEPT:
            self._followed_terms.pop(next(iter(self._followed_terms)))
        for term, one in zip(missing, found, strict=True):
            self._followed_terms[parts.load, rubbing, term] = one

    def _followed(self, parts: Parts, term: Term) -> Followed:
        key = parts.load, parts.rubbing(term.index), term
        if key not in self._followed_terms:
            # The slopes by its values are asked for next, and cost nothing beside it.
            self._foresee(parts, [term, *(neighbour for neighbour, _ in term.neighbours())])
        return self._followed_terms[key]

    def _follower(self, load: Load, j: int) -> Follower:
        key = (load, j)
        if key not in self._follow:
            if len(self._follow) > 24:
                self._follow.clear()
            torques = [part[:, j] for part in self.link_torques(load)]
            self._follow[key] = Follower(
                _side_by_side(torques),
                _side_by_side(self.body.own_inertia(load, j)),
                _side_by_side(self.body.gravity_slope(load, j)),
                self._period,
                _side_by_side([run.speed[:, j] for run in self.recording.runs]),
            )
        return self._follow[key]

    def _tip(self, parts: Parts, run: Motion, k: int, offset: Array) -> Array:
        if not self.recording.has_tip:
            return np.zeros((0, 3))
        q = run.q_raw[run.frames]
        turned = np.array(q)
        turned += offset[run.frames]
        if parts.angles:
            turned += joint_ahead(parts.angles, q, run.t_s[run.frames])
        expected = self._tips[k] if turned is q else self._kinematics.tips(turned)
        for term in parts.tip:
            expected = expected + self._shift(parts, term, k, run)
        return np.asarray(expected - run.tip_m)

    def _shift(self, parts: Parts, term: Term, k: int, run: Motion) -> Array:
        if term.form == "camera time":
            return np.asarray(
                np.einsum("mij,mj->mi", self.jacobians[k], run.speed[run.frames]) * term.values[0]
            )
        if term.form == "link_flexure":
            return self._bent(term.name.joint or 1, parts.load.payload_kg)[k] * term.values[0]
        if term.form == "link_geometry":
            if self._dh is None:
                self._dh = [
                    self._kinematics.identification_jacobian(r.q_raw[r.frames]) for r in self.recording.runs
                ]
            return np.asarray(self._dh[k] @ np.array(term.values))
        shift, turn = np.array(term.values[:3]), np.array(term.values[3:])
        return np.asarray(shift + np.cross(turn, self._tips[k]))

    def _bent(self, link: int, extra_kg: float) -> list[Array]:
        """How the tip moves per 1 / EI of a link as its loads hang on it and are thrown about, (frames, 3) of each run.

        The beam follows its loads at once: its resonance is far above what an arm is moved with.
        """
        key = (link, extra_kg)
        if key not in self._bends:
            if len(self._bends) > 16:
                self._bends.clear()
            self._bends[key] = [self._bent_along(link, extra_kg, run) for run in self.recording.runs]
        return self._bends[key]

    def _bent_along(self, link: int, extra_kg: float, run: Motion) -> Array:
        payload = np.maximum(run.payload_kg + extra_kg, 0.0)

        def accelerated(place_m: Array) -> Array:
            return self.recording.filters.states(place_m)[2]

        return bending_m(self.arm, self.arm.dh, run.q_raw, payload, link, accelerated)[run.frames]


def sorted_terms(model: Sequence[Term]) -> Parts:
    """A model's terms by where they act."""
    parts = Parts()
    payload, masses, inertias = 0.0, [], []
    for term in model:
        match term.form:
            case "payload":
                payload += term.values[0]
            case "mass_kg":
                masses.append((term.index, term.values[0]))
            case "inertia_kg_m2":
                inertias.append((term.index, term.values[0]))
            case "torque_constant":
                parts.scale[term.index] = parts.scale.get(term.index, 0.0) + term.values[0]
            case "command_delay":
                parts.delay_s += max(term.values[0], 0.0)
            case "sampling time":  # a voltage that took effect before the sample is one that comes early
                parts.delay_s -= term.values[0]
            case "supply_sag" | "supply_sag by sum":
                parts.sag.append((term.form, term.values[0]))
            case "joint_compliance" | "backlash":
                parts.elastic.append(term)
            case form if form in ANGLES:
                parts.angles.append(term)
            case "link_geometry" | "base_frame" | "camera time" | "link_flexure":
                parts.tip.append(term)
            case "resistance" | "current offset" | "inductance":
                parts.electrical.append(term)
            case _:
                parts.friction.append(term)
    parts.load = Load(payload, tuple(masses), tuple(inertias))
    return parts


def _earlier(values: Array, samples: int) -> Array:
    return np.vstack([np.repeat(values[:1], samples, axis=0), values[: len(values) - samples]])


def _side_by_side(columns: list[Array]) -> Array:
    """Runs of different lengths as one array (longest, runs); the shorter ones stay at their last value."""
    longest = max(len(column) for column in columns)
    return np.stack([np.pad(column, (0, longest - len(column)), mode="edge") for column in columns], axis=1)
