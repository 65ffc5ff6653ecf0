"""Angles, speeds and direction of the last motion from counts; and averages at rest, for calibration points.

A request starts an average, every cycle adds to it, and the result is ready after its duration. Camera frames are averaged too.
Plain floats: this runs every cycle.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from control.model.drive import JointMap, Unwrapper
from control.model.effects import COUPLED, COUPLED_TO

# Enough to smooth steps of one count; each millisecond more costs 5 degrees of phase margin.
SPEED_FILTER_S = 0.001
LONGEST_GAP_S = 1.0  # between two reports; after a longer gap, or a step back in time, the speed filter is reset
SHORTEST_s = 1e-6  # between two counts
DIRECTION_STEP_rad = 2e-4  # a smaller motion is dither at a set-point, not an approach; nor is one count


class Measurement:
    """Joint angles in rad, speeds in rad/s and the sign of the last motion, joint by joint.

    `shifted_rad` is the change of angle in the last update that came from shifted counters, not from motion; `leap_rad`, one
    that no motor can make in the time between the reports (0: none), if `fastest_rad_s` gives the joints' greatest speeds.
    `has_lost_turns`: the last report came so late that the counter may have wrapped unseen. `count_rad`: a count of each encoder.
    """

    def __init__(
        self,
        maps: Sequence[JointMap],
        counter_bits: Sequence[int],
        fastest_rad_s: Sequence[float] = (),
        unseen_s: Sequence[float] = (),
    ) -> None:
        """`unseen_s`: for how long each counter cannot have wrapped unseen; none: for ever."""
        n = len(maps)
        self.q_rad = [0.0] * n
        self.speed_rad_s = [0.0] * n
        self.direction = [0] * n
        self.shifted_rad = [0.0] * n
        self.leap_rad = [0.0] * n
        self.has_lost_turns = [False] * n
        self._fastest_rad_s = tuple(fastest_rad_s) or (math.inf,) * n
        self._unseen_s = tuple(unseen_s) or (math.inf,) * n
        self._maps = maps
        self.count_rad = tuple(abs(mapped.radians(1) - mapped.radians(0)) for mapped in maps)
        self._dither_rad = tuple(max(DIRECTION_STEP_rad, 1.5 * count) for count in self.count_rad)
        self._counter_bits = tuple(counter_bits)
        self._unwrappers: list[Unwrapper] = []
        self._shifts = [0] * n
        self._on_time_s = (0.0,) * n
        self._late_s = [0.0] * n  # of the last counts, beyond what the filter smooths
        self._turning_point_rad = [0.0] * n
        self._last_s = [-math.inf] * n

    def update(
        self, counts: Sequence[int], shifts: Sequence[int], counted_at_s: Sequence[float], late_s: Sequence[float] = ()
    ) -> bool:
        """Process the counts of the newest reports; an old report changes nothing.

        `counted_at_s` is when each count was latched, by its board's own clock, so that delays of the line or the host
        do not look like speed; or up to `late_s` later (none: 0), where the board tells no time and its answer came later
        than it can. The motion then took between T - late, of the last count, and T + late: of the speeds that this leaves,
        the one nearest to that of before is taken, as far as the filter does not smooth the lateness. `shifts` are the counts
        added to each counter by request that this report includes. Returns whether a shift is new.
        """
        if not self._unwrappers:
            self._unwrappers = [Unwrapper(b, count) for b, count in zip(self._counter_bits, counts, strict=True)]
        is_shifted = self._follow_shifts(counts, shifts)
        late_s = late_s or self._on_time_s
        angles_rad, speeds_rad_s, lates_s, turned_rad = (self.q_rad, self.speed_rad_s, self._late_s, self._turning_point_rad)
        last_s = self._last_s
        joints = zip(counts, counted_at_s, late_s, self._maps, self._unwrappers, self._unseen_s, self._fastest_rad_s, strict=True)
        for joint, (count, made_s, at_most_s, count_map, unwrapper, unseen_s, fastest_rad_s) in enumerate(joints):
            elapsed_s = made_s - last_s[joint]
            if elapsed_s == 0.0:
                continue
            last_s[joint] = made_s
            self.has_lost_turns[joint] = unseen_s < elapsed_s < math.inf  # inf: the first report
            q = count_map.radians(unwrapper.update(count))
            if 0.0 < elapsed_s < LONGEST_GAP_S:
                moved_rad, before_rad_s = q - angles_rad[joint], speeds_rad_s[joint]
                if at_most_s > SPEED_FILTER_S or lates_s[joint] or elapsed_s < SHORTEST_s:
                    late = max(0.0, at_most_s - SPEED_FILTER_S)
                    slowest = moved_rad / (elapsed_s + late)
                    quickest = moved_rad / max(elapsed_s - lates_s[joint], SHORTEST_s)
                    lates_s[joint] = late
                    speed = min(max(before_rad_s, min(slowest, quickest)), max(slowest, quickest))
                else:  # the usual cycle, in which both are the same
                    speed = moved_rad / elapsed_s
                is_leap = not abs(moved_rad) <= fastest_rad_s * (elapsed_s + at_most_s)
                self.leap_rad[joint] = moved_rad if is_leap else 0.0
                gain = elapsed_s / (elapsed_s + SPEED_FILTER_S)
                speeds_rad_s[joint] = before_rad_s + gain * (speed - before_rad_s)
                off_rad, direction = q - turned_rad[joint], self.direction[joint]
                if off_rad * direction > 0.0:
                    turned_rad[joint] = q
                elif abs(off_rad) > self._dither_rad[joint]:
                    self.direction[joint] = 1 if off_rad > 0.0 else -1
                    turned_rad[joint] = q
            else:
                speeds_rad_s[joint] = 0.0
                turned_rad[joint] = q
            angles_rad[joint] = q
        return is_shifted

    def unwrapped_count(self, joint: int, count: int) -> int:
        """The unwrapped count of a raw one from near the present position."""
        half = 1 << (self._counter_bits[joint] - 1)
        present = self._unwrappers[joint].unwrapped_count
        return present + (count - present + half) % (2 * half) - half

    def _follow_shifts(self, counts: Sequence[int], shifts: Sequence[int]) -> bool:
        """Restart unwrapping at a counter that was set: turns counted before its zero was known are discarded."""
        if self._shifts == shifts:
            return False
        for joint, (count, shift) in enumerate(zip(counts, shifts, strict=True)):
            self.shifted_rad[joint] = 0.0
            if shift == self._shifts[joint]:
                continue
            mapped = self._maps[joint]
            before = self._unwrappers[joint].update(count - (shift - self._shifts[joint]))
            moved_rad = mapped.radians(count) - mapped.radians(before)
            self._unwrappers[joint] = Unwrapper(self._counter_bits[joint], count)
            self.shifted_rad[joint] = moved_rad
            self.q_rad[joint] += moved_rad
            self._turning_point_rad[joint] += moved_rad
            self._shifts[joint] = shift
        return True


class MotorLeads:
    """How far each motor is ahead of its joint, of joints with an encoder on both: play and springs, seen in operation.

    `lead_rad`: of the pair that came in this cycle, from 0 at the first one; NaN where none came, or there is one encoder.
    """

    def __init__(
        self, maps: Sequence[JointMap], motor_maps: Sequence[JointMap | None], bits: Sequence[int], belt_ratio: float = 0.0
    ) -> None:
        """`motor_maps`: of the motors' own encoders, None where a joint has no second one; `bits`: of the joints' counters.

        `belt_ratio`: of a known `belt_coupling`, whose motor turns back while the joint that it follows moves.
        """
        self.lead_rad = [math.nan] * len(maps)
        self._maps, self._motor_maps, self._bits = tuple(maps), tuple(motor_maps), tuple(bits)
        self._belt_ratio = belt_ratio
        self._seen: list[tuple[Unwrapper, Unwrapper, float] | None] = [None] * len(maps)

    def forget(self) -> None:
        """A board was off: what turned meanwhile is not known."""
        for joint in range(len(self._seen)):
            self._seen[joint] = None

    def update(self, pairs: Sequence[tuple[int, int, int]], q_rad: Sequence[float]) -> None:
        """Take the (joint, count, motor's count) of this cycle, in which the joints are at `q_rad`."""
        for joint, lead_rad in enumerate(self.lead_rad):
            if lead_rad == lead_rad:
                self.lead_rad[joint] = math.nan
        for joint, count, motor_count in pairs:
            motor, seen = self._motor_maps[joint], self._seen[joint]
            if motor is None:
                continue
            joints, motors, first_rad = seen or (Unwrapper(self._bits[joint], count), Unwrapper(32, motor_count), 0.0)
            lead_rad = motor.radians(motors.update(motor_count)) - self._maps[joint].radians(joints.update(count))
            if joint == COUPLED - 1:
                lead_rad += self._belt_ratio * q_rad[COUPLED_TO - 1]
            if seen is None:
                first_rad = lead_rad
                self._seen[joint] = joints, motors, first_rad
            self.lead_rad[joint] = lead_rad - first_rad


@dataclass(slots=True)
class RunningMean:
    """Mean, standard deviation and range of a stream of vectors, relative to the first to limit rounding errors."""

    count: int = 0
    first: tuple[float, ...] = ()
    total: list[float] = field(default_factory=list)
    squares: list[float] = field(default_factory=list)

    def add(self, values: Sequence[float]) -> None:
        """Add a vector."""
        if not self.count:
            self.first = tuple(values)
            zeros = [0.0] * len(values)
            self.total, self.squares = zeros[:], zeros[:]
        self.count += 1
        for i, value in enumerate(values):
            offset = value - self.first[i]
            self.total[i] += offset
            self.squares[i] += offset * offset

    def mean(self) -> tuple[float, ...]:
        """Mean of the vectors so far."""
        return tuple(f + t / self.count for f, t in zip(self.first, self.total, strict=True))

    def std(self) -> tuple[float, ...]:
        """Sample standard deviation; zero for a single vector."""
        n = self.count
        if n < 2:
            return tuple(0.0 for _ in self.first)
        return tuple(math.sqrt(max(0.0, s - t * t / n) / (n - 1)) for s, t in zip(self.squares, self.total, strict=True))


Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class MeanPose:
    """Mean pose of what the camera follows, in the camera's own frame, or in the base frame if its place there is known."""

    frames: int
    position_m: Vector
    std_m: Vector
    orientation: Quaternion | None  # w, x, y, z; None from a camera that measures positions


@dataclass(frozen=True, slots=True)
class Average:
    """Means at rest over `duration_s`; joint angles in rad, tip in the base frame in m.

    count_rad: what one count of each joint's encoder is at the joint.
    """

    duration_s: float
    samples: int
    q_rad: tuple[float, ...]
    q_std_rad: tuple[float, ...]
    current_A: tuple[float, ...]
    direction: tuple[int, ...]
    camera_frames: int
    tip_m: tuple[float, float, float] | None
    tip_std_m: tuple[float, float, float] | None
    count_rad: tuple[float, ...]
    t_s: float
    target: MeanPose | None = None


class Averaging:
    """Averages angles, currents and camera frames from `start_s` for `duration_s`."""

    def __init__(self, start_s: float, duration_s: float) -> None:
        self.result: Average | None = None
        self._start_s = start_s
        self._duration_s = duration_s
        self._q_rad = RunningMean()
        self._current_A = RunningMean()
        self._tip_m, self._orientation = RunningMean(), RunningMean()
        self._is_in_base = True

    def add(
        self,
        now_s: float,
        measured: Measurement,
        current_A: Sequence[float],
        seen: tuple[Vector, Quaternion | None] | None,
        is_in_base: bool = True,
    ) -> None:
        """Add one cycle, and a new sight of the tip if there is one; sets `result` after the last cycle."""
        if self.result is not None:
            return
        self._q_rad.add(measured.q_rad)
        self._current_A.add(current_A)
        if seen is not None:
            self._see(*seen)
            self._is_in_base = is_in_base
        if now_s - self._start_s >= self._duration_s:
            self.result = self._finish(measured.direction, measured.count_rad)

    def _see(self, tip_m: Vector, orientation: Quaternion | None) -> None:
        self._tip_m.add(tip_m)
        if orientation is None:
            return
        # q and -q are one orientation: all are taken on the side of the first
        first = self._orientation.first or orientation
        sign = math.copysign(1.0, sum(a * b for a, b in zip(first, orientation, strict=True)))
        self._orientation.add([sign * value for value in orientation])

    def _target(self) -> MeanPose | None:
        if not self._tip_m.count:
            return None
        orientation: Quaternion | None = None
        if self._orientation.count:
            mean = self._orientation.mean()
            w, x, y, z = (value / math.hypot(*mean) for value in mean)
            orientation = (w, x, y, z)
        return MeanPose(self._tip_m.count, _vector(self._tip_m.mean()), _vector(self._tip_m.std()), orientation)

    def _finish(self, direction: Sequence[int], count_rad: tuple[float, ...]) -> Average:
        target = self._target()
        in_base = target if self._is_in_base else None
        return Average(
            duration_s=self._duration_s,
            samples=self._q_rad.count,
            q_rad=self._q_rad.mean(),
            q_std_rad=self._q_rad.std(),
            current_A=self._current_A.mean(),
            direction=tuple(direction),
            camera_frames=in_base.frames if in_base is not None else 0,
            tip_m=in_base.position_m if in_base is not None else None,
            tip_std_m=in_base.std_m if in_base is not None else None,
            count_rad=count_rad,
            t_s=self._start_s,
            target=target,
        )


def _vector(values: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = values
    return x, y, z
