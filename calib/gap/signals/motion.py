"""Motion from voltage: the model driven by the recorded voltages, in short windows and in closed loop.

Open loop an arm soon goes its own way, so that a window is a fifth of a second from a measured state; many start all over each
run and run side by side. In closed loop a run is simulated whole: what its angles are off by goes through the gains of the arm's
file into the voltage. A linear controller in the log would have done so too; where it had other gains, the errors are as this
arm's own loop would leave them. Both are checks in radians of what was named from currents and tips, and take no part in naming.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calib.arrays import Array, rms
from calib.gap.signals.body import sorted_terms
from calib.gap.signals.physics import Physics
from calib.gap.signals.recording import Flags
from calib.gap.signals.terms import Law, friction_Nm
from control.dynamics.gains import gains_of
from control.errors import MissingModel

# The model run forward: voltages in, motion out; rigid, elastic and loose joints, many recordings side by side.
#
#     L di/dt + R i = u - K motor speed
#     rigid joint:         (M + J) q'' = K i - friction - bias
#     elastic or loose:    J motor'' = K i - friction - tau,    M q'' = tau - (friction behind the gear) - bias
# with tau = k (motor - q) + d (motor' - q'), or that of the flank that the motor leans on. Symplectic Euler in steps of 0.4 ms;
# a flank, and a spring stiffer than that, is as hard as the step carries.
STEP_s = 0.0004
HARDEST = 0.25  # of inertia over step squared
FLANK_DAMPING = 0.7  # of critical


@dataclass(slots=True)
class ForwardState:
    """Angles, speeds and accelerations of the links, those of the motors at the joint, and currents: (W, n)."""

    q: Array
    speed: Array
    acceleration: Array
    motor: Array
    motor_speed: Array
    current_A: Array
    t_s: Array  # (W,), for laws that change with time


@dataclass(frozen=True, slots=True)
class _Motion:
    """What the laws of friction ask for."""

    q: Array
    speed: Array
    acceleration: Array
    t_s: Array


class Forward:
    """One model of the arm, for W motions at once that carry `payload_kg` (W,)."""

    def __init__(self, physics: Physics, model: Sequence[Law], payload_kg: Array) -> None:
        self._physics, self._parts, self._payload = physics, sorted_terms(model), payload_kg
        self._period = 1.0 / physics.recording.filters.rate_Hz
        self._steps = max(2, round(self._period / STEP_s))
        self._h = self._period / self._steps
        self._gears = self._parts.gears()
        self._rotor = physics.body.rotor_kg_m2
        self._own_rotor = np.array([0.0 if j in self._gears else J for j, J in enumerate(self._rotor)])
        self._rubbing = [
            (term, term.index, self._parts.behind(term), physics.gear_ratios[term.index])
            for term in self._parts.friction
        ]
        self._K = physics.torque_per_A * physics.scales(self._parts)

    @property
    def delay(self) -> tuple[int, float]:
        """Whole samples by which a voltage is late, and what of a sample beyond; one that comes early is taken as in time."""
        whole, within = divmod(max(self._parts.delay_s, 0.0), self._period)
        return int(whole), within

    def advance(self, state: ForwardState, newer_V: Array, older_V: Array, is_off: Flags) -> None:
        """One sample, in place: `older_V` until the delay's rest has passed, then `newer_V` (W, n)."""
        bias, inverse, mass = self._body(state)
        rigid = bias + np.einsum("wij,wj->wi", mass, state.acceleration)
        _, within = self.delay
        h = self._h
        for step in range(self._steps):
            voltage = older_V if (step + 0.5) * h < within else newer_V
            state.current_A = np.where(is_off, 0.0, self._current(state, voltage))
            transmitted = self._transmitted(state, inverse)
            load = rigid.copy()
            for j, torque in transmitted.items():
                load[:, j] = torque
            at_motor, behind = self._frictions(state, load)
            drive = self._K * state.current_A - at_motor
            pull = drive - bias
            for j, torque in transmitted.items():
                pull[:, j] = torque - behind[:, j] - bias[:, j]
            state.acceleration = np.einsum("wij,wj->wi", inverse, pull)
            state.speed = state.speed + h * state.acceleration
            state.q = state.q + h * state.speed
            motor_speed, motor = state.speed.copy(), state.q.copy()
            for j, torque in transmitted.items():
                own = (drive[:, j] - torque) / self._rotor[j]
                motor_speed[:, j] = state.motor_speed[:, j] + h * own
                motor[:, j] = state.motor[:, j] + h * motor_speed[:, j]
            state.motor_speed, state.motor = motor_speed, motor
        state.t_s = state.t_s + self._period

    def _current(self, state: ForwardState, voltage: Array) -> Array:
        physics = self._physics
        seen = physics.sagged(self._parts, voltage, state.current_A)
        target = (seen - self._K * state.motor_speed) / physics.resistance_ohm
        lag = np.maximum(physics.lag_s, 1e-9)
        return np.asarray(target + (state.current_A - target) * np.exp(-self._h / lag))

    def _transmitted(self, state: ForwardState, inverse: Array) -> dict[int, Array]:
        """Torque of each elastic or loose gear (W,)."""
        result = {}
        for j, gear in self._gears.items():
            ahead = state.motor[:, j] - state.q[:, j]
            rate = state.motor_speed[:, j] - state.speed[:, j]
            inertia = 1.0 / (1.0 / self._rotor[j] + inverse[:, j, j])
            hardest = HARDEST * inertia / self._h**2
            stiffness, damping = hardest, 2.0 * FLANK_DAMPING * np.sqrt(hardest * inertia)
            half, is_loose = 0.0, False
            for term in gear:
                if term.form.acts == "spring":
                    stiffness = np.minimum(1.0 / max(term.values[0], 1e-9), hardest)
                    damping = np.full_like(hardest, max(term.values[1], 0.0))
                else:
                    half, is_loose = 0.5 * max(term.values[0], 0.0), True
            into = ahead - np.clip(ahead, -half, half)
            torque = stiffness * into + damping * rate
            result[j] = np.where(is_loose & (into * torque <= 0.0), 0.0, torque)
        return result

    def _frictions(self, state: ForwardState, load_Nm: Array) -> tuple[Array, Array]:
        """At the motors, and behind the gears: (W, n) each."""
        at_motor, behind = np.zeros_like(load_Nm), np.zeros_like(load_Nm)
        motors = _Motion(state.motor, state.motor_speed, state.acceleration, state.t_s)
        links = _Motion(state.q, state.speed, state.acceleration, state.t_s)
        for term, j, share, ratio in self._rubbing:
            at_motor[:, j] += (1.0 - share) * friction_Nm(term, motors, j, load_Nm[:, j], ratio)
            if share > 0.0:
                behind[:, j] += share * friction_Nm(term, links, j, load_Nm[:, j], ratio)
        return at_motor, behind

    def _body(self, state: ForwardState) -> tuple[Array, Array, Array]:
        """Bias (W, n), inverse of the mass matrices with the rotors that turn with their links, those without rotors."""
        W, n = state.q.shape
        dynamics = self._physics.body.dynamics(self._parts.load)
        pushes = np.repeat(np.vstack([np.zeros((1, n)), np.eye(n)]), W, axis=0)
        carried = np.tile(np.maximum(self._payload + self._parts.load.payload_kg, 0.0), n + 1)
        found = dynamics.torques(
            np.tile(state.q, (n + 1, 1)), np.tile(state.speed, (n + 1, 1)), pushes, carried
        ).reshape(n + 1, W, n)
        mass = np.moveaxis(found[1:] - found[0], 0, 2) - np.diag(self._rotor)
        return found[0], np.linalg.inv(mass + np.diag(self._own_rotor)), mass


def begin(
    physics: Physics, model: Sequence[Law], runs: Sequence[int], samples: Sequence[int]
) -> ForwardState:
    """The measured states at these samples of these runs; behind elastic gears where they are simulated to be."""
    recording = physics.recording
    offsets, speeds = physics.following.beyond(model)
    pairs = list(zip(runs, samples, strict=True))

    def at(name: str) -> Array:
        return np.stack([getattr(recording.runs[k], name)[s] for k, s in pairs])

    motor, motor_speed = at("q"), at("speed")
    if recording.has_current:
        current = at("current_A")
    else:
        current = (at("voltage_V") - physics.torque_per_A * motor_speed) / physics.resistance_ohm
    ahead = np.stack([offsets[k][s] for k, s in pairs])
    faster = np.stack([speeds[k][s] for k, s in pairs])
    times = np.array([recording.runs[k].t_s[s] for k, s in pairs])
    return ForwardState(
        motor + ahead, motor_speed + faster, at("acceleration"), motor, motor_speed, current, times
    )


Places = npt.NDArray[np.intp]
WINDOW_s, BETWEEN_s = 0.2, 0.25
FEWEST_WINDOWS = 3  # of the held-out runs
RUNAWAY_rad = 100.0  # off: a simulated arm that is 16 turns away has left the recording for good
OPEN, CLOSED = "q_rad", "q_loop_rad"


@dataclass(frozen=True, slots=True)
class MotionGap:
    """Root mean square of simulated less measured angles [rad] on the held-out runs, and the floor of that."""

    floor_rad: float
    before_rad: float
    after_rad: float


def motion_gaps(
    physics: Physics, known: Sequence[Law], model: Sequence[Law], report: Sequence[str]
) -> dict[str, MotionGap]:
    """By channel, OPEN and CLOSED; without voltages, or with too little to simulate, there is none of them."""
    if not physics.recording.has_voltage:
        return {}
    kept = [k for k, run in enumerate(physics.recording.runs) if run.name in report]
    found: dict[str, Windows | Loop] = {OPEN: Windows(physics, kept), CLOSED: Loop(physics, kept)}
    gaps = {name: part.gap(known, model) for name, part in found.items() if part.suffices}
    return {name: one for name, one in gaps.items() if math.isfinite(one.before_rad + one.after_rad)}


class Windows:
    """Windows all over some runs, side by side."""

    def __init__(self, physics: Physics, runs: Sequence[int]) -> None:
        self._physics = physics
        self._period = 1.0 / physics.recording.filters.rate_Hz
        self.length = max(2, round(WINDOW_s / self._period))
        places = [self._starts(np.asarray(physics.recording.runs[k].usable.all(axis=1))) for k in runs]
        of_run = [np.full(len(starts), k) for k, starts in zip(runs, places, strict=True)]
        self.run: Places = np.concatenate([*of_run, np.zeros(0)]).astype(np.intp)
        self.start: Places = np.concatenate([*places, np.zeros(0)]).astype(np.intp)

    def _starts(self, usable: npt.NDArray[np.bool_]) -> Places:
        starts = np.arange(2, len(usable) - self.length - 1, max(1, round(BETWEEN_s / self._period)))
        kept = [k for k in starts.tolist() if usable[k : k + self.length].all()]
        return np.array(kept, dtype=np.intp)

    @property
    def suffices(self) -> bool:
        """Whether there are enough."""
        return len(self.run) >= FEWEST_WINDOWS

    def gap(self, known: Sequence[Law], model: Sequence[Law]) -> MotionGap:
        """With the model as it was and as it is."""
        after = self.errors(model)
        before = after if tuple(known) == tuple(model) else self.errors(known)
        return MotionGap(self._floor(after), rms(before), rms(after))

    def errors(self, model: Sequence[Law]) -> Array:
        """Simulated less measured angles, (length, W, n)."""
        runs = self._physics.recording.runs
        payload = np.array([float(runs[k].payload_kg[s]) for k, s in zip(self.run, self.start, strict=True)])
        forward = Forward(self._physics, model, payload)
        state = begin(self._physics, model, self.run.tolist(), self.start.tolist())
        whole, _ = forward.delay
        result = np.empty((self.length, *state.q.shape))
        for s in range(self.length):
            result[s] = state.motor - self._at("q_raw", s)
            if _runs_away(result[s]):
                result[s:] = np.inf
                break
            newer, older = (self._at("voltage_V", s - whole - back) for back in (0, 1))
            forward.advance(state, newer, older, self._at("is_off", s).astype(bool))
        return result

    def _at(self, name: str, ahead: int) -> Array:
        runs = self._physics.recording.runs
        return np.stack(
            [getattr(runs[k], name)[max(s + ahead, 0)] for k, s in zip(self.run, self.start, strict=True)]
        )

    def _floor(self, errors: Array) -> float:
        """From repeats, in windows that begin at the same sample, and what the encoders' steps leave of a first speed."""
        grown = max(1.0, self._physics.recording.filters.speed_gain * WINDOW_s / np.sqrt(3.0))
        differences: list[Array] = []
        for one, other in _pairs(self._physics, self.run.tolist()):
            a, b = np.flatnonzero(self.run == one), np.flatnonzero(self.run == other)
            _, in_a, in_b = np.intersect1d(self.start[a], self.start[b], return_indices=True)
            differences.append(_apart(errors[:, a[in_a]], errors[:, b[in_b]]))
        return _floor(self._physics, differences, grown)


class Loop:
    """Whole runs, with feedback that keeps the simulated arm beside the measured one."""

    def __init__(self, physics: Physics, runs: Sequence[int]) -> None:
        self._physics, self._runs = physics, list(runs)
        self._period = 1.0 / physics.recording.filters.rate_Hz
        self._gains = _gains(physics)
        usable = [np.asarray(physics.recording.runs[k].usable.all(axis=1)) for k in self._runs]
        self._starts = [int(np.argmax(flags)) for flags in usable]
        self._lengths = [
            len(flags) - start - 1 if flags.any() else 0
            for flags, start in zip(usable, self._starts, strict=True)
        ]

    @property
    def suffices(self) -> bool:
        """Whether there are runs that the driver drove all through, and gains for them."""
        if self._gains is None or not self._runs or min(self._lengths) * self._period < WINDOW_s:
            return False
        return not any(self._physics.recording.runs[k].is_off.any() for k in self._runs)

    def gap(self, known: Sequence[Law], model: Sequence[Law]) -> MotionGap:
        """With the model as it was and as it is."""
        after = self.errors(model)
        before = after if tuple(known) == tuple(model) else self.errors(known)
        differences = []
        for one, other in _pairs(self._physics, self._runs):
            a, b = (after[self._runs.index(k)] for k in (one, other))
            common = min(len(a), len(b))
            differences.append(_apart(a[:common], b[:common]))
        floor = _floor(self._physics, differences, 1.0)
        return MotionGap(floor, rms(np.concatenate(before)), rms(np.concatenate(after)))

    def errors(self, model: Sequence[Law]) -> list[Array]:
        """Simulated less measured angles, (samples, n) of each run."""
        assert self._gains is not None
        recording, kp, ki, kd = self._physics.recording, *self._gains
        runs = [recording.runs[k] for k in self._runs]
        payload = np.array([float(np.median(run.payload_kg)) for run in runs])
        forward = Forward(self._physics, model, payload)
        state = begin(self._physics, model, self._runs, self._starts)
        whole, _ = forward.delay
        longest = max(self._lengths)
        sum_rad_s, result = np.zeros_like(state.q), np.empty((longest, *state.q.shape))
        back = [np.zeros_like(state.q)] * (whole + 2)  # feedback is late as the voltages are

        def at(name: str, s: int) -> Array:
            places = (
                max(min(start + s, len(run) - 1), 0) for start, run in zip(self._starts, runs, strict=True)
            )
            return np.stack([getattr(run, name)[place] for run, place in zip(runs, places, strict=True)])

        for s in range(longest):
            result[s] = state.motor - at("q_raw", s)
            if _runs_away(result[s]):
                result[s:] = np.inf
                break
            sum_rad_s -= self._period * result[s]
            feedback = kp * -result[s] + ki * sum_rad_s + kd * (at("speed", s) - state.motor_speed)
            back = [feedback, *back[:-1]]
            newer = at("voltage_V", s - whole) + back[whole]
            older = at("voltage_V", s - whole - 1) + back[whole + 1]
            forward.advance(state, newer, older, np.zeros(state.q.shape, dtype=bool))
        return [result[:length, w] for w, length in enumerate(self._lengths)]


def _runs_away(error_rad: Array) -> bool:
    """Whether a model has lost its recording: gains of a fast loop do not hold an arm at a slow log's rate."""
    return not float(np.abs(error_rad).max()) < RUNAWAY_rad


def _gains(physics: Physics) -> tuple[Array, Array, Array] | None:
    """Of all joints in volts; None where the arm's file has none and they cannot be derived."""
    arm = physics.arm
    try:
        gains = [gains_of(arm, drive.joint) for drive in arm.drives]
    except MissingModel:
        return None
    volts = np.array([d.resistance_ohm if d.pid.mode == "current" else 1.0 for d in arm.drives])
    kp, ki, kd = (
        volts * np.array(column) for column in zip(*((g.kp, g.ki, g.kd) for g in gains), strict=True)
    )
    return kp, ki, kd


def _pairs(physics: Physics, runs: Sequence[int]) -> list[tuple[int, int]]:
    """Runs among these that repeat each other, neighbours in their group."""
    among = set(runs)
    groups = ([k for k in group if k in among] for group in physics.recording.repeats)
    return [pair for group in groups for pair in itertools.pairwise(group)]


def _apart(one: Array, other: Array) -> Array:
    """Their difference; not a number where both have run away."""
    with np.errstate(invalid="ignore"):
        return np.asarray(one - other).ravel()


def _floor(physics: Physics, differences: Sequence[Array], grown: float) -> float:
    steps = [2.0 * np.pi / d.counts_per_joint_turn for d in physics.arm.drives]
    by_steps = grown * float(np.sqrt(np.mean(np.square(steps)) / 12.0))
    found = [part for part in differences if part.size and np.isfinite(part).all()]
    repeated = rms(np.concatenate(found)) / float(np.sqrt(2.0)) if found else 0.0
    return float(np.hypot(repeated, by_steps))
