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
from calib.gap.signals.terms import Law, torque_of
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


class Forward:
    """One model of the arm, for W motions at once that carry `payload_kg` (W,)."""

    def __init__(self, physics: Physics, model: Sequence[Law], payload_kg: Array) -> None:
        self._physics, self._parts = physics, sorted_terms(model)
        self._period = 1.0 / physics.recording.filters.rate_Hz
        self._steps = max(2, round(self._period / STEP_s))
        self._h = self._period / self._steps
        self._gears = self._parts.gears()
        self._rotor = physics.body.rotor_kg_m2
        self._own_rotor = np.array([0.0 if j in self._gears else J for j, J in enumerate(self._rotor)])
        self._rubbing = [
            (
                term.index,
                self._parts.behind(term),
                torque_of(term),
                physics.gear_ratios[term.index] if term.form.is_of_motor else 1.0,
            )
            for term in self._parts.friction
        ]
        self._K = physics.torque_per_A * physics.scales(self._parts)
        self._decay = np.exp(-self._h / np.maximum(physics.lag_s, 1e-9))
        # the states that a mass matrix and the bias are found by: without acceleration, then with that of one joint
        n = len(self._rotor)
        self._dynamics = physics.body.dynamics(self._parts.load)
        self._pushes = np.repeat(np.vstack([np.zeros((1, n)), np.eye(n)]), len(payload_kg), axis=0)
        self._carried = np.tile(np.maximum(payload_kg + self._parts.load.payload_kg, 0.0), n + 1)

    @property
    def delay(self) -> tuple[int, float]:
        """Whole samples by which a voltage is late, and what of a sample beyond; one that comes early is taken as in time."""
        whole, within = divmod(max(self._parts.delay_s, 0.0), self._period)
        return int(whole), within

    def advance(self, state: ForwardState, newer_V: Array, older_V: Array, is_off: Flags) -> None:
        """One sample, in place: `older_V` until the delay's rest has passed, then `newer_V` (W, n)."""
        bias, inverse, mass = self._body(state)
        rigid = bias + np.einsum("wij,wj->wi", mass, state.acceleration)
        hardest = {j: HARDEST / (1.0 / self._rotor[j] + inverse[:, j, j]) / self._h**2 for j in self._gears}
        (_, within), h, is_ever_off = self.delay, self._h, bool(is_off.any())
        for step in range(self._steps):
            current = self._current(state, older_V if (step + 0.5) * h < within else newer_V)
            state.current_A = np.where(is_off, 0.0, current) if is_ever_off else current
            transmitted = {j: self._transmitted(state, j, hardest[j]) for j in self._gears}
            load = rigid.copy() if transmitted else rigid
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

    def _current(self, state: ForwardState, voltage: Array) -> Array:
        physics = self._physics
        seen = physics.sagged(self._parts, voltage, state.current_A)
        target = (seen - self._K * state.motor_speed) / physics.resistance_ohm
        return np.asarray(target + (state.current_A - target) * self._decay)

    def _transmitted(self, state: ForwardState, j: int, hardest: Array) -> Array:
        """Torque of an elastic or loose gear (W,), which can be as stiff as `hardest` (W,)."""
        ahead = state.motor[:, j] - state.q[:, j]
        rate = state.motor_speed[:, j] - state.speed[:, j]
        stiffness, damping = hardest, 2.0 * FLANK_DAMPING * hardest * self._h / math.sqrt(HARDEST)
        half, is_loose = 0.0, False
        for term in self._gears[j]:
            if term.form.acts == "spring":
                stiffness = np.minimum(1.0 / max(term.values[0], 1e-9), hardest)
                damping = np.full_like(hardest, max(term.values[1], 0.0))
            else:
                half, is_loose = 0.5 * max(term.values[0], 0.0), True
        into = ahead - np.clip(ahead, -half, half)
        torque = stiffness * into + damping * rate
        return np.where(is_loose & (into * torque <= 0.0), 0.0, torque)

    def _frictions(self, state: ForwardState, load_Nm: Array) -> tuple[Array, Array]:
        """At the motors, and behind the gears: (W, n) each."""
        at_motor, behind = np.zeros_like(load_Nm), np.zeros_like(load_Nm)
        for j, share, torque, ratio in self._rubbing:
            load = load_Nm[:, j]
            at_motor[:, j] += (1.0 - share) * torque(state.motor[:, j] * ratio, state.motor_speed[:, j], load)
            if share > 0.0:
                behind[:, j] += share * torque(state.q[:, j] * ratio, state.speed[:, j], load)
        return at_motor, behind

    def _body(self, state: ForwardState) -> tuple[Array, Array, Array]:
        """Bias (W, n), inverse of the mass matrices with the rotors that turn with their links, those without rotors."""
        W, n = state.q.shape
        q, speed = (np.tile(own, (n + 1, 1)) for own in (state.q, state.speed))
        found = self._dynamics.torques(q, speed, self._pushes, self._carried).reshape(n + 1, W, n)
        mass = np.moveaxis(found[1:] - found[0], 0, 2) - np.diag(self._rotor)
        return found[0], np.linalg.inv(mass + np.diag(self._own_rotor)), mass


def begin(physics: Physics, model: Sequence[Law], runs: Sequence[int], samples: Sequence[int]) -> ForwardState:
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
    return ForwardState(motor + ahead, motor_speed + faster, at("acceleration"), motor, motor_speed, current)


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


def motion_gaps(physics: Physics, known: Sequence[Law], model: Sequence[Law], report: Sequence[str]) -> dict[str, MotionGap]:
    """By channel, OPEN and CLOSED; without voltages, or with too little to simulate, there is none of them."""
    if not physics.recording.has_voltage:
        return {}
    kept = [k for k, run in enumerate(physics.recording.runs) if run.name in report]
    found = {OPEN: windows(physics, kept), CLOSED: whole_runs(physics, kept)}
    gaps = {name: one.gap(known, model) for name, one in found.items() if one is not None}
    return {name: one for name, one in gaps.items() if math.isfinite(one.before_rad + one.after_rad)}


def windows(physics: Physics, runs: Sequence[int]) -> Simulated | None:
    """Windows all over some runs; None where they are too few."""
    period_s, starts = 1.0 / physics.recording.filters.rate_Hz, []
    length, apart = max(2, round(WINDOW_s / period_s)), max(1, round(BETWEEN_s / period_s))
    for run in runs:
        usable = np.asarray(physics.recording.runs[run].usable.all(axis=1))
        places = range(2, len(usable) - length - 1, apart)
        starts += [(run, k) for k in places if usable[k : k + length].all()]
    if len(starts) < FEWEST_WINDOWS:
        return None
    payload_kg = [float(physics.recording.runs[run].payload_kg[k]) for run, k in starts]
    return Simulated(physics, tuple(starts), (length,) * len(starts), np.array(payload_kg), None)


def whole_runs(physics: Physics, runs: Sequence[int]) -> Simulated | None:
    """Runs as a whole, with feedback; None without runs that the driver drove all through, or gains for them."""
    usable = [np.asarray(physics.recording.runs[run].usable.all(axis=1)) for run in runs]
    begins = [int(np.argmax(flags)) for flags in usable]
    lengths = [len(own) - k - 1 if own.any() else 0 for own, k in zip(usable, begins, strict=True)]
    gains, some = _gains(physics), [physics.recording.runs[run] for run in runs]
    is_short = min(lengths, default=0) / physics.recording.filters.rate_Hz < WINDOW_s
    if gains is None or is_short or any(run.is_off.any() for run in some):
        return None
    payload_kg = np.array([float(np.median(run.payload_kg)) for run in some])
    return Simulated(physics, tuple(zip(runs, begins, strict=True)), tuple(lengths), payload_kg, gains)


@dataclass(frozen=True, slots=True)
class Simulated:
    """W motions side by side, each from a measured state (run, sample) on for so many samples.

    `gains` of a feedback in volts that keeps the simulated arm beside the measured one; None: none.
    """

    physics: Physics
    starts: tuple[tuple[int, int], ...]
    lengths: tuple[int, ...]
    payload_kg: Array
    gains: tuple[Array, Array, Array] | None

    def gap(self, known: Sequence[Law], model: Sequence[Law]) -> MotionGap:
        """With the model as it was and as it is."""
        after = self.errors(model)
        before = after if tuple(known) == tuple(model) else self.errors(known)
        return MotionGap(self._floor(after), rms(np.concatenate(before)), rms(np.concatenate(after)))

    def errors(self, model: Sequence[Law]) -> list[Array]:
        """Simulated less measured angles, (samples, n) of each motion."""
        forward = Forward(self.physics, model, self.payload_kg)
        state = begin(self.physics, model, *zip(*self.starts, strict=True))
        (whole, _), longest, still = forward.delay, max(self.lengths), np.zeros_like(state.q)
        sum_rad_s, result = still.copy(), np.empty((longest, *state.q.shape))
        back = [still] * (whole + 2)  # feedback is late as the voltages are
        seen_rad, seen_rad_s, is_off = (self._along(name) for name in ("q_raw", "speed", "is_off"))
        newer_V, older_V = (self._along("voltage_V", late) for late in (whole, whole + 1))
        for s in range(longest):
            result[s] = state.motor - seen_rad[s]
            if _runs_away(result[s]):
                result[s:] = np.inf
                break
            if self.gains is not None:
                kp, ki, kd = self.gains
                sum_rad_s -= result[s] / self.physics.recording.filters.rate_Hz
                faster = seen_rad_s[s] - state.motor_speed
                back = [kp * -result[s] + ki * sum_rad_s + kd * faster, *back[:-1]]
            forward.advance(state, newer_V[s] + back[whole], older_V[s] + back[whole + 1], is_off[s])
        return [result[:length, w] for w, length in enumerate(self.lengths)]

    def _along(self, name: str, late: int = 0) -> Array:
        """What was measured so many samples before each sample of every motion, (longest, W, n)."""
        runs, samples = self.physics.recording.runs, np.arange(max(self.lengths)) - late
        measured = [(getattr(runs[run], name), k) for run, k in self.starts]
        return np.stack([own[np.clip(k + samples, 0, len(own) - 1)] for own, k in measured], axis=1)

    def _floor(self, errors: Sequence[Array]) -> float:
        """From repeats, in windows that begin at the same sample, and what the encoders' steps leave of a first speed."""
        own: dict[int, dict[int, Array]] = {}
        for (run, start), error in zip(self.starts, errors, strict=True):
            own.setdefault(run, {})[0 if self.gains is not None else start] = error
        differences = []
        for one, other in _pairs(self.physics, [run for run, _ in self.starts]):
            for start in own[one].keys() & own[other].keys():
                a, b = own[one][start], own[other][start]
                common = min(len(a), len(b))
                with np.errstate(invalid="ignore"):  # not a number where both have run away
                    differences.append((a[:common] - b[:common]).ravel())
        grown = 1.0
        if self.gains is None:
            grown = max(1.0, self.physics.recording.filters.speed_gain * WINDOW_s / np.sqrt(3.0))
        steps = [2.0 * np.pi / d.counts_per_joint_turn for d in self.physics.arm.drives]
        by_steps = grown * float(np.sqrt(np.mean(np.square(steps)) / 12.0))
        found = [part for part in differences if part.size and np.isfinite(part).all()]
        repeated = rms(np.concatenate(found)) / float(np.sqrt(2.0)) if found else 0.0
        return float(np.hypot(repeated, by_steps))


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
    kp, ki, kd = (volts * np.array(column) for column in zip(*((g.kp, g.ki, g.kd) for g in gains), strict=True))
    return kp, ki, kd


def _pairs(physics: Physics, runs: Sequence[int]) -> list[tuple[int, int]]:
    """Runs among these that repeat each other, neighbours in their group."""
    among = set(runs)
    groups = ([k for k in group if k in among] for group in physics.recording.repeats)
    return [pair for group in groups for pair in itertools.pairwise(group)]
