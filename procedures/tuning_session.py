"""A joint's response, measured on the arm: a multisine while it moves at constant speed, a step, a move.

In: an arm's runtime of its own, gains, an amplitude. Out: the plant's response with its quality, and what step and move did.

"""

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Self, cast

import numpy as np
from numpy.typing import NDArray

from control.dynamics.gains import Response
from control.errors import ArmError
from control.hardware.connect import connect
from control.hardware.interface import Hardware, OutputMode, Wanted
from control.model.arm import Arm
from control.model.drive import JointMap
from control.motion.setpoint import SetPoint, at_rest
from control.safety.modes import Mode
from control.server.assemble import assemble
from control.server.client import ArmClient
from control.server.in_process import InProcessChannel
from firmware_iface.clock import Clock
from firmware_iface.errors import LinkError

Real = NDArray[np.float64]
PERIOD_S = 2.0
PASSES = 4
BEYOND = 50  # samples of the next period, to separate steady motion from the response
LOWEST_Hz, HIGHEST_Hz = 2.0, 80.0  # below, the loop holds the joint, and the mean motion interferes
LINES = 48
LOW_Hz, HIGH_Hz = 2.0, 20.0  # range of usual crossover frequencies
LEAST_SHARE = 0.7  # share of the frequencies there that must be good
_TRIALS = 60  # trials of random phases, for a low crest factor


class PoorResponse(ArmError):
    """The measurement is not good enough for a design."""


@dataclass(frozen=True, slots=True)
class Multisine:
    """One period, peak 1; `lines` are its harmonics, `silent` odd ones between them."""

    samples: Real
    lines: NDArray[np.int64]
    silent: NDArray[np.int64]
    rate_Hz: float


def multisine(period_s: float, rate_Hz: float, seed: int = 0) -> Multisine:
    """A signal with odd lines, about as many in every octave, up to a fifth of the sampling rate."""
    count = round(period_s * rate_Hz)
    highest = min(HIGHEST_Hz, 0.2 * rate_Hz) * period_s
    wanted = np.geomspace(max(1.0, LOWEST_Hz * period_s), highest, LINES)
    odd = np.unique(2 * np.floor(wanted / 2.0).astype(np.int64) + 1)
    lines = np.array([k for n, k in enumerate(odd) if k < 7 or n % 4 != 2], dtype=np.int64)
    silent = np.setdiff1d(odd, lines)
    random = np.random.default_rng(seed)
    t = np.arange(count) / count
    best: Real | None = None
    for _ in range(_TRIALS):
        phases = random.uniform(0.0, 2.0 * np.pi, len(lines))
        wave = np.cos(2.0 * np.pi * np.outer(t, lines) + phases).sum(axis=1)
        if best is None or np.abs(wave).max() < np.abs(best).max():
            best = wave
    if best is None:
        raise ArmError("tuning: no excitation signal was found")
    return Multisine(best / np.abs(best).max(), lines, silent, rate_Hz)


@dataclass(frozen=True, slots=True)
class MeasuredResponse:
    """A response, the loop in which it was measured (L = added / output - 1, by the loop's own output), and its quality."""

    response: Response
    loop: NDArray[np.complex128]
    distortion: float
    """Nonlinear share: the angle's amplitude at unexcited lines over that at excited lines."""
    noise: float
    """Relative noise of the response, from period to period."""
    span_rad: float


def evaluate(wave: Multisine, angle_rad: Real, output: Real, added: Real) -> MeasuredResponse:
    """Evaluate arrays (periods, samples); each row is a period and the start of the next. The joint may be in motion."""
    count = len(wave.samples)
    y, u, d = (np.fft.rfft(_level(rows, count), axis=1) for rows in (angle_rad, output, added))
    at = wave.lines
    y_mean, u_mean, d_mean = (spectrum.mean(axis=0) for spectrum in (y, u, d))
    plant = y_mean[at] / u_mean[at]
    omega = 2.0 * np.pi * at * wave.rate_Hz / count
    # The part of this period's angle that its output does not explain.
    unexplained = y[:, at] - plant * u[:, at]
    noise = np.sqrt((np.abs(unexplained) ** 2).mean(axis=0)) / np.abs(y_mean[at])
    odd = wave.silent
    between = _interpolated(omega, plant, 2.0 * np.pi * odd * wave.rate_Hz / count)
    stray = np.abs(y_mean[odd] - between * u_mean[odd])
    level = np.interp(at, odd, stray / np.abs(np.interp(odd, at, np.abs(y_mean[at]))))
    coherence = 1.0 / (1.0 + noise**2 / len(y) + level**2)
    return MeasuredResponse(
        Response(omega, plant, coherence),
        d_mean[at] / u_mean[at] - 1.0,
        float(np.sqrt(np.mean(level**2))),
        float(np.sqrt(np.mean(noise**2 / len(y)))),
        float(np.ptp(angle_rad)),
    )


def _level(rows: Real, count: int) -> Real:
    """Remove mean and steady motion from each period, the latter by the difference to the same sample one period later.

    A straight line by least squares would remove part of the response and leave a saw-tooth.
    """
    beyond = rows.shape[1] - count
    slope = (rows[:, count:].mean(axis=1) - rows[:, :beyond].mean(axis=1)) / count
    t = np.arange(count) - 0.5 * (count - 1)
    period = rows[:, :count]
    return np.asarray(period - period.mean(axis=1, keepdims=True) - slope[:, None] * t)


def _interpolated(omega: Real, plant: NDArray[np.complex128], wanted: Real) -> NDArray[np.complex128]:
    magnitude = np.interp(np.log(wanted), np.log(omega), np.log(np.abs(plant)))
    phase = np.interp(np.log(wanted), np.log(omega), np.unwrap(np.angle(plant)))
    return np.asarray(np.exp(magnitude + 1j * phase), dtype=np.complex128)


def usable(measured: MeasuredResponse, least_coherence: float) -> MeasuredResponse:
    """The measurement without frequencies of poor coherence. Raises PoorResponse if too few remain around crossover."""
    keep = measured.response.coherence >= least_coherence
    response = measured.response
    low, high = 2.0 * math.pi * LOW_Hz, 2.0 * math.pi * HIGH_Hz
    inside = (response.omega_rad_s >= low) & (response.omega_rad_s <= high)
    good = int((keep & inside).sum())
    if good < LEAST_SHARE * int(inside.sum()):
        raise PoorResponse(
            f"the response is poor: coherence reaches {least_coherence:g} at only {good} of {int(inside.sum())}"
            f" frequencies from {LOW_Hz:g} to {HIGH_Hz:g} Hz (noise {measured.noise:.1%}, nonlinear"
            f" {measured.distortion:.1%}): friction or backlash absorbs the signal, or somebody touches the arm; give"
            " a larger --amplitude, check for backlash"
        )
    return MeasuredResponse(
        Response(response.omega_rad_s[keep], response.plant[keep], response.coherence[keep]),
        measured.loop[keep],
        measured.distortion,
        measured.noise,
        measured.span_rad,
    )


# A probe between loop and boards: adds a known signal to one joint's output, and records commands and counts.
@dataclass(slots=True)
class Trace:
    """One joint, a value per cycle: time, count, commanded output (V or A), added signal."""

    t_s: list[float] = field(default_factory=list)
    count: list[int] = field(default_factory=list)
    output: list[float] = field(default_factory=list)
    added: list[float] = field(default_factory=list)


class Probe:
    """A `control.hardware.interface.Hardware` in front of another, which adds the signal."""

    def __init__(self, hardware: Hardware, clock: Clock) -> None:
        self.trace = Trace()
        self._hardware, self._clock = hardware, clock
        self._joint: int | None = None
        self._signal: Sequence[float] = (0.0,)
        self._limit = 0.0
        self._on_cycle: Callable[[int], None] = lambda cycle: None

    def watch(self, joint: int, signal: Sequence[float], limit: float, on_cycle: Callable[[int], None]) -> None:
        """Start a trace of a joint (0-based), with a signal applied once, clamped to the output limit.

        `on_cycle` is called at the end of each cycle with its number, from 0.
        """
        self.trace = Trace()
        self._joint, self._signal, self._limit, self._on_cycle = joint, signal, limit, on_cycle

    def rest(self) -> Trace:
        """End the trace."""
        self._joint = None
        return self.trace

    def write(self, wanted: Wanted, modes: Sequence[OutputMode], output: Sequence[float], feedforward_V: Sequence[float]) -> None:
        """As the hardware, with the signal added to one joint while the loop controls it."""
        joint = self._joint
        if joint is None:
            self._hardware.write(wanted, modes, output, feedforward_V)
            return
        trace = self.trace
        cycle = len(trace.t_s)
        added = self._signal[cycle] if cycle < len(self._signal) and modes[joint] is not OutputMode.OFF else 0.0
        outputs = list(output)
        outputs[joint] = min(max(outputs[joint] + added, -self._limit), self._limit)
        trace.t_s.append(self._clock.now_s())
        trace.count.append(self._hardware.feedback.count[joint])
        trace.output.append(outputs[joint])
        trace.added.append(outputs[joint] - output[joint])
        self._hardware.write(wanted, modes, outputs, feedforward_V)
        self._on_cycle(cycle)

    def __getattr__(self, name: str) -> Any:
        """All else as the hardware."""
        return getattr(self._hardware, name)


PASS_SPEED_rad_s = 0.22  # faster than the signal's motion, so that the joint never reverses
RAMP_S = 0.3
LEAD_S = 0.5  # from the start of a pass until transients have decayed
REST_S = 0.4
STEP_CYCLES = 300  # a slower loop answers a step more slowly by as much
LATE = 0.5  # of a cycle: a pass with a missed cycle is not evaluated


@dataclass(frozen=True, slots=True)
class StepResponse:
    """A set-point step below all limits: t_s from the step, angle over step height, and its figures."""

    t_s: tuple[float, ...]
    share: tuple[float, ...]
    overshoot: float
    settling_s: float
    """Time until it stays within 5 %, or two counts."""


@dataclass(frozen=True, slots=True)
class MoveResponse:
    """A jerk-limited move at the joint's own limits: t_s, set and measured angle; following error in rad."""

    t_s: tuple[float, ...]
    set_rad: tuple[float, ...]
    angle_rad: tuple[float, ...]
    peak_error_rad: float
    settling_s: float
    """Time after the end of the set-point's motion until the error stays within 0.5 mrad."""


class TuningSession:
    """A tuning session: connected, enabled and homed on entry; off on every exit."""

    def __init__(self, arm: Arm, clock: Clock) -> None:
        self.arm, self.clock = arm, clock
        self.period_s = 1.0 / arm.usual_rate_Hz
        self._connection = connect(arm, clock, self.period_s)
        self.probe = Probe(self._connection.hardware, clock)
        self._assembly = assemble(arm, cast(Hardware, self.probe), self.period_s)
        self._channel = InProcessChannel(self._assembly, clock)
        self.client = ArmClient(self._channel)

    def __enter__(self) -> Self:
        try:
            self.client.wait(0.05)
            self.client.enable()
            self.client.home()
        except BaseException:
            self._leave()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self._leave()

    def _leave(self) -> None:
        """Stop, hold, brake, off; if the runtime cannot, the boards are commanded to brake."""
        self.probe.rest()
        try:
            with contextlib.suppress(ArmError):
                self.client.off()
        finally:
            hardware = self._connection.hardware
            if hardware.is_any_enabled() and hardware.wanted is not Wanted.AS_FOUND:
                with contextlib.suppress(LinkError):
                    self._connection.hardware.emergency_stop()
            self._connection.close()

    def angles_rad(self) -> tuple[float, ...]:
        """The measured angles."""
        return tuple(self.client.status()["q_rad"])

    def _run(self, joint: int, points: Sequence[SetPoint], signal: Sequence[float]) -> Trace:
        """Send set-points to the holding loop, one per cycle, and a signal to a joint (1-based). ArmError if the arm faults."""
        runtime = self._assembly.runtime
        drive = self.arm.drive(joint)
        limit = drive.current_limit_A if drive.pid.mode == "current" else drive.supply_V

        def follow(cycle: int) -> None:
            if runtime.monitor.mode is Mode.HOLDING and cycle < len(points):
                runtime.set_point = points[cycle]

        self.probe.watch(joint - 1, signal, limit, follow)
        try:
            self.client.wait((len(points) + 1) * self.period_s)
        finally:
            trace = self.probe.rest()
        self.client.until(["HOLDING"], 0.1)
        return trace

    def excite(self, joint: int, wave: Multisine, amplitude: float) -> MeasuredResponse:
        """Passes back and forth around the present pose, with the signal on the joint."""
        centre = at_rest(self.angles_rad())
        cycle_s = self.period_s
        forth = _pass(centre, joint - 1, cycle_s)
        self.client.move_joints(forth[0].q_rad, 0.3)
        mapped = JointMap(self.arm.drive(joint))
        lead, count = round(LEAD_S / cycle_s), len(wave.samples)
        signal = [0.0] * lead + (amplitude * np.append(wave.samples, wave.samples[:BEYOND])).tolist()
        # The signal starts before the evaluated period, so that the response is periodic by then.
        early = round((LEAD_S - RAMP_S) / cycle_s)
        signal[lead - early : lead] = (amplitude * wave.samples[-early:]).tolist()
        rows: list[tuple[list[float], list[float], list[float]]] = []
        for number in range(PASSES):
            points = forth if number % 2 == 0 else _reversed(forth, cycle_s)
            trace = self._run(joint, points, signal)
            inside = slice(lead, lead + count + BEYOND)
            if _is_punctual(trace.t_s[inside], cycle_s):
                angle = [mapped.radians(k) for k in trace.count[inside]]
                rows.append((angle, trace.output[inside], trace.added[inside]))
        if len(rows) < 2:
            raise ArmError("tuning: this host missed cycles in nearly every pass: `armwright doctor` lists the rights it needs")
        angle_rad, output, added = (np.array([row[k] for row in rows]) for k in range(3))
        return evaluate(wave, angle_rad, output, added)

    def step(self, joint: int, height_rad: float) -> StepResponse:
        """A step forward and one back, averaged."""
        here = at_rest(self.angles_rad())
        there = SetPoint(_with(here.q_rad, joint - 1, height_rad), here.speed_rad_s, here.acceleration_rad_s2)
        hold, steps = round(REST_S / self.period_s), STEP_CYCLES
        mapped = JointMap(self.arm.drive(joint))
        shares = []
        for begin, end, sign in ((here, there, 1.0), (there, here, -1.0)):
            trace = self._run(joint, [begin] * hold + [end] * steps, ())
            angle = np.array([mapped.radians(k) for k in trace.count])
            before = angle[hold - 20 : hold].mean()
            shares.append(sign * (angle[hold + 1 : hold + steps] - before) / height_rad)
        share = np.mean(shares, axis=0)
        return _judged_step(share, abs(2.0 * mapped.radians_per_count / height_rad), self.period_s)

    def move(self, joint: int, distance_rad: float) -> MoveResponse:
        """A move forward; then the arm returns."""
        runtime, drive = self._assembly.runtime, self.arm.drive(joint)
        home = self.angles_rad()
        mapped = JointMap(drive)
        wanted: list[float] = []
        limit = drive.supply_V if drive.pid.mode != "current" else drive.current_limit_A
        self.probe.watch(joint - 1, (), limit, lambda cycle: wanted.append(runtime.set_point.q_rad[joint - 1]))
        try:
            self.client.move_joints(_with(home, joint - 1, distance_rad), 1.0)
            self.client.wait(REST_S)
        finally:
            trace = self.probe.rest()
        self.client.move_joints(home, 0.3)
        angle = np.array([mapped.radians(k) for k in trace.count])
        return _judged_move(np.array(wanted), angle, self.period_s)


def _pass(centre: SetPoint, j: int, cycle_s: float) -> list[SetPoint]:
    """Set-points of a pass around a pose: speed up, steady, slow down, rest."""
    ramp, steady = round(RAMP_S / cycle_s), round((LEAD_S - RAMP_S + PERIOD_S) / cycle_s) + BEYOND
    push = PASS_SPEED_rad_s / RAMP_S
    accelerations = [push] * ramp + [0.0] * steady + [-push] * ramp + [0.0] * round(REST_S / cycle_s)
    speed, way = 0.0, 0.0
    rows = []
    for acceleration in accelerations:
        way += (speed + 0.5 * acceleration * cycle_s) * cycle_s
        speed += acceleration * cycle_s
        rows.append((way, speed, acceleration))
    begin_rad = -0.5 * way
    points = [
        SetPoint(_with(centre.q_rad, j, begin_rad + at), _with(centre.speed_rad_s, j, v), _with(centre.acceleration_rad_s2, j, a))
        for at, v, a in rows
    ]
    return [at_rest(_with(centre.q_rad, j, begin_rad)), *points[:-1], at_rest(points[-1].q_rad)]


def _reversed(points: Sequence[SetPoint], cycle_s: float) -> list[SetPoint]:
    """The same pass in reverse; the rest comes last again."""
    rest = round(REST_S / cycle_s)
    moving = list(reversed(points[: len(points) - rest]))
    back = [SetPoint(p.q_rad, tuple(-v for v in p.speed_rad_s), p.acceleration_rad_s2) for p in moving]
    return [at_rest(points[-1].q_rad), *back[1:], *[at_rest(points[0].q_rad)] * rest]


def _with(values: Sequence[float], j: int, more: float) -> tuple[float, ...]:
    return tuple(value + more if k == j else value for k, value in enumerate(values))


def _is_punctual(t_s: Sequence[float], cycle_s: float) -> bool:
    steps = np.diff(t_s)
    return bool(steps.size and np.all(np.abs(steps - cycle_s) < LATE * cycle_s))


def _judged_step(share: "np.ndarray[tuple[int, ...], np.dtype[np.float64]]", two_counts: float, cycle_s: float) -> StepResponse:
    t_s = cycle_s * (1 + np.arange(len(share)))
    final = float(share[-50:].mean())
    band = max(0.05, two_counts)
    outside = np.flatnonzero(np.abs(share - final) > band)
    return StepResponse(
        tuple(t_s.tolist()), tuple(share.tolist()), float(share.max() - final), float(t_s[outside[-1]]) if outside.size else 0.0
    )


def _judged_move(
    wanted: "np.ndarray[tuple[int, ...], np.dtype[np.float64]]",
    angle: "np.ndarray[tuple[int, ...], np.dtype[np.float64]]",
    cycle_s: float,
) -> MoveResponse:
    n = min(len(wanted), len(angle))
    wanted, angle = wanted[:n], angle[:n]
    error = wanted - angle
    moving = np.flatnonzero(np.diff(wanted))
    end = int(moving[-1]) + 1 if moving.size else 0
    unsettled = np.flatnonzero(np.abs(error[end:]) > 5e-4)
    t_s = cycle_s * np.arange(n)
    return MoveResponse(
        tuple(t_s.tolist()),
        tuple(wanted.tolist()),
        tuple(angle.tolist()),
        float(np.abs(error).max()),
        float(cycle_s * (unsettled[-1] + 1)) if unsettled.size else 0.0,
    )
