"""What a real arm does beyond its geometry: the usual causes and smooth remainders, each of unknown size, as columns of the tip.

The identified geometry is never the whole truth. Kennedy and O'Hagan (Bayesian calibration of computer models, J. R. Stat.
Soc. B 63, 2001) put a Gaussian process beside the model for what it lacks. Here it has a term for each cause that parts of
arms are known for (scale, eccentricity, load, play, coupling, bending), so that it extrapolates as they do, and smooth ones
for the rest: functions of each joint's angle (Solin and Sarkka, Hilbert space methods for reduced-rank Gaussian process
regression, Stat. Comput. 30, 2020) and a field over the tip's place. Nothing is named: the sizes are estimated together
(`calib.trust.prediction`), and those that the poses do not need shrink.
"""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.joint_effects import known_corrections
from calib.arm_problem.link_bending import beams, bending_m, link_frames
from calib.arrays import Array, Mask
from calib.design.candidates import joint_box
from calib.points.points import Points
from control.dynamics.static_pose import (
    CURRENT_NOISE_A,
    GRAVITY_ERROR,
    LINK_SHARE_LEAST,
    RestingPose,
    ROUNDING_Nm,
    gravity_Nm,
    known_torque_per_A,
    resting,
)
from control.errors import MissingModel
from control.model.arm import Arm

# Usual sizes, at the joint in rad or at the tip in m: about a tenth of what a cause does where it is worth a name
# (docs/gap.md). Each size is estimated; these matter for what no pose tests.
ANGLE_rad: Final = 3e-4
COUPLING_rad: Final = 3e-4
LOAD_rad: Final = 3e-4
DIRECTION_rad: Final = 3e-4
FRICTION_rad: Final = 1e-4
AXIS_rad: Final = 1e-4
BENDING_m: Final = 5e-5
FIELD_m: Final = 3e-5
DEPARTURE: Final = 0.2  # of a law, as parts of arms keep theirs; the rest of its source shares its size
ANGLE_LENGTH_rad: Final = 0.7  # over which the rest of an angle's error is alike: up to three waves a turn pass
FIELD_LENGTH: Final = 0.4  # of the reach, over which the tip's error is alike
BEYOND: Final = 1.25  # the functions live on this many times the travel, so that its ends are free
FIELD_WAVES: Final = 16  # random Fourier features of the field, for each axis
SAMPLE: Final = 500  # poses over the travel that the columns are scaled on
SEED: Final = 20161771


@dataclass(frozen=True, slots=True)
class Conditions:
    """Poses at rest or on the way, and how each was reached.

    q_rad (m, n): joint angles; direction (m, n): sign of the last motion, 0 unknown; payload_kg (m,); current_A (m, n), or None;
    moving_Nm (m, n): what moving links need beyond gravity, or None at rest; flank (m, n): mean of where each gear lies, -1 .. 1,
    where poses have told it, or None.
    """

    q_rad: Array
    direction: Array
    payload_kg: Array
    current_A: Array | None = None
    moving_Nm: Array | None = None
    flank: Array | None = None

    @classmethod
    def of(cls, q_rad: Array, direction: float = 0.0, payload_kg: float = 0.0) -> Conditions:
        """Poses that all joints reach in one direction with one payload."""
        return cls(q_rad, np.full(q_rad.shape, direction), np.full(len(q_rad), payload_kg))

    @classmethod
    def recorded(cls, arm: Arm, points: Points) -> Conditions:
        """Those of recorded points: joint angles are the encoders', corrected by the effects that the arm's file has."""
        return cls(
            points.q_rad + known_corrections(arm, points),
            np.nan_to_num(points.direction),
            np.nan_to_num(points.payload_kg),
            points.current_A,
        )

    def __len__(self) -> int:
        """How many poses."""
        return len(self.q_rad)


@dataclass(frozen=True, slots=True)
class Source:
    """One cause of error: where, what it follows, its usual size [rad at the joint, m at the tip], and its columns."""

    where: str
    follows: str
    usual: float
    count: int

    @property
    def name(self) -> str:
        """Joint 2: load"""
        return f"{self.where}: {self.follows}"


Block = tuple[Source, Array]  # a source and its columns (m, 3, count) [m]


class Discrepancy:
    """The sources of an arm, and their columns at any pose."""

    def __init__(self, arm: Arm) -> None:
        """Load, play by gravity and bending need masses; an arm without them has the other sources."""
        self._arm, self._model = arm, ArmModel(arm)
        lower, upper = joint_box(arm, 0.0)
        self._centre, self._travel = 0.5 * (lower + upper), 0.5 * (upper - lower)
        rng = np.random.default_rng(SEED)
        sample = lower + (upper - lower) * rng.random((SAMPLE, len(lower)))
        self.odds = even_odds(arm.joint_count)
        self._load_Nm = _largest_load_Nm(arm, sample)
        self._bending = self._bending_scales(sample)
        self._waves, self._phases = _field_waves(arm, rng)
        blocks = list(self._blocks(Conditions.of(sample[:2]), arm.dh, self._model.nominal_tool_m))
        self.sources = tuple(source for source, _ in blocks)

    @property
    def slices(self) -> list[slice]:
        """The columns of each source."""
        ends = np.cumsum([0, *(source.count for source in self.sources)]).tolist()
        return [slice(a, b) for a, b in itertools.pairwise(ends)]

    def columns(self, at: Conditions, dh: Array, tool_m: Array) -> Array:
        """The tip's displacement by each column of weight 1 [m], (m, 3, columns); `dh` (links, 4), `tool_m` (3,)."""
        return np.concatenate([columns for _, columns in self._blocks(at, dh, tool_m)], axis=2)

    def _blocks(self, at: Conditions, dh: Array, tool_m: Array) -> Iterator[Block]:
        slopes = self._model.slopes(dh, at.q_rad, tool_m)
        by_joint = slopes.by_dh[:, :, list(self._model.theta_places)]
        load, flank = self._gears(at)
        for j in range(self._arm.joint_count):
            for follows, usual, values in self._laws(at, load, flank, j):
                source = Source(f"joint {j + 1}", follows, usual, values.shape[1])
                yield source, by_joint[:, :, j, None] * values[:, None, :]
        yield from self._wobbles(at.q_rad, dh, tool_m)
        for link, scale_m in self._bending.items():
            yield Source(f"link {link}", "bending", BENDING_m, 2), self._bent(at, link) / scale_m
        yield Source("the tip", "place", FIELD_m, 3 * len(self._phases)), self._field(slopes.tips)

    def _wobbles(self, q_rad: Array, dh: Array, tool_m: Array) -> Iterator[Block]:
        """Joints whose axis tilts as they turn: about both directions across it, with one and two waves a turn."""
        frames = link_frames(self._model, dh, q_rad, tool_m)
        turning = [k for k, turns in enumerate(self._model.joints) if turns]
        for j, k in enumerate(turning):
            at = k + 1 if self._model.is_modified else k
            axis, across = frames.axes[:, at, :, 2], frames.axes[:, k, :, 0]
            arm_m = frames.tip_m - frames.origin_m[:, at]
            tilts = np.stack([np.cross(turn, arm_m) for turn in (across, np.cross(axis, across))], axis=2)
            columns = tilts[:, :, :, None] * _waves(q_rad[:, j])[:, None, None, :]
            yield Source(f"joint {j + 1}", "its axis", AXIS_rad, 8), columns.reshape(len(q_rad), 3, 8)

    def _laws(self, at: Conditions, load: Array, flank: Array, j: int) -> Iterator[tuple[str, float, Array]]:
        """What a joint's angle may be off by: (m, columns) for each source, in its usual size.

        Scale and eccentricity share a size, per rad of either: over a short travel they are alike, and beyond it they are not.
        """
        q_rad, q, x = at.q_rad, at.q_rad[:, j], at.q_rad[:, j] - self._centre[j]
        travel = self._travel[j]
        rest = DEPARTURE * smooth_functions(x, BEYOND * travel)
        yield "angle", ANGLE_rad, np.column_stack((x, np.sin(q), np.cos(q), rest))
        for k in range(self._arm.joint_count):
            if k != j:
                straight = (q_rad[:, k] - self._centre[k]) / self._travel[k]
                yield (f"angle of joint {k + 1}", COUPLING_rad, np.column_stack((straight, DEPARTURE * _waves(q_rad[:, k]))))
        if self._load_Nm is not None and self._load_Nm[j] > 0.0:
            pull = load[:, j]
            curve = DEPARTURE * np.column_stack((np.abs(pull), pull * np.abs(pull)))
            yield "load", LOAD_rad, np.column_stack((pull, curve))
            wound = np.sign(at.direction[:, j, None])
            yield "friction", FRICTION_rad, wound * np.column_stack((np.ones(len(q)), np.abs(pull)))
        yield "direction", DIRECTION_rad, flank[:, j, None] * _play(q, load[:, j])

    def _bent(self, at: Conditions, link: int) -> Array:
        """The tip's displacement by a bending link, and how its payload's part departs: no link is an even beam, (m, 3, 2)."""
        whole, bare = (bending_m(self._arm, at.q_rad, kg, link) for kg in (at.payload_kg, 0.0 * at.payload_kg))
        return np.stack((whole, DEPARTURE * (whole - bare)), axis=2)

    def _gears(self, at: Conditions) -> tuple[Array, Array]:
        """Gravity torque over the largest, and the mean of the gear's flank, (m, n) each."""
        gears = self._at_rest(at)
        if gears is None:
            return np.zeros(at.q_rad.shape), np.sign(at.direction)
        flank = gears.expected() if at.flank is None else at.flank
        return self._loads(gears), flank

    def _loads(self, gears: Gears) -> Array:
        """Gravity torque over the largest (m, n), 0 of an upright axis."""
        largest_Nm = np.zeros(len(self._travel)) if self._load_Nm is None else self._load_Nm
        return np.asarray(gears.state.gravity_Nm / np.where(largest_Nm > 0.0, largest_Nm, np.inf))

    def _at_rest(self, at: Conditions) -> Gears | None:
        """The state of the gears; None without masses."""
        if self._load_Nm is None:
            return None
        arm, moving_Nm = self._arm, 0.0 if at.moving_Nm is None else at.moving_Nm
        state = resting(arm, at.q_rad, at.direction, at.current_A, at.payload_kg, moving_Nm)
        return Gears(state, self.odds, CURRENT_NOISE_A * np.nan_to_num(known_torque_per_A(arm)))

    def knowing(self, odds: Array) -> Discrepancy:
        """The same with these odds (n, SHARES) of each joint's share of friction on the link's side."""
        discrepancy = copy.copy(self)
        discrepancy.odds = odds
        return discrepancy

    def by_play(self, at: Conditions, dh: Array, tool_m: Array) -> Array:
        """The tip's displacement [m] by each joint's play, (m, 3, n)."""
        return self._model.slopes(dh, at.q_rad, tool_m).by_dh[:, :, list(self._model.theta_places)]

    def unclear(self, at: Conditions, dh: Array, tool_m: Array) -> Array:
        """The same (m, 3, n), by the standard deviation of where its gear lies."""
        return self.by_play(at, dh, tool_m) * np.sqrt(1.0 - self._gears(at)[1] ** 2)[:, None, :]

    def weighed(self, at: Conditions, left_m: Array, moves_m: Array, noise_m: float) -> tuple[Array, Array | None]:
        """Odds (n, SHARES) and flanks (m, n) by what is left (m, 3) at poses where play moves the tip by moves_m (m, 3, n)."""
        gears = self._at_rest(at)
        if gears is None:
            return self.odds, None
        mean = gears.expected() if at.flank is None else at.flank
        here_m = np.einsum("mij,mj->mi", moves_m, gears.is_open * mean)
        return gears.weighed(left_m + here_m, moves_m, mean, noise_m)

    def strayed(self, at: Conditions, count: int, rng: np.random.Generator) -> Array:
        """Draws of each gear's place between its flanks, -1 .. 1, beyond the mean, (count, m, n)."""
        gears = self._at_rest(at)
        if gears is None:
            return np.where(at.direction == 0.0, rng.uniform(-1.0, 1.0, (count, *at.q_rad.shape)), 0.0)
        return gears.drawn(count, rng) - gears.expected()

    def plays_rad(self, at: Conditions, weights: Array) -> Array:
        """Half the play of each joint at poses (..., m, n), by weights (..., columns) of the columns."""
        gears = self._at_rest(at)
        load = np.zeros(at.q_rad.shape) if gears is None else self._loads(gears)
        named = zip(self.sources, self.slices, strict=True)
        parts = [part for source, part in named if source.follows == "direction"]
        widths = [weights[..., part] @ _play(at.q_rad[:, j], load[:, j]).T for j, part in enumerate(parts)]
        return np.stack(widths, axis=-1)

    def _bending_scales(self, sample: Array) -> dict[int, float]:
        """For each link that can bend: its displacement of the tip for EI = 1, root mean square over the travel."""
        if self._load_Nm is None:
            return {}
        none_kg = np.zeros(len(sample))
        shifts = {k: bending_m(self._arm, sample, none_kg, k) for k in beams(self._arm)}
        scales = {k: math.sqrt(float(np.mean(np.sum(shift**2, axis=1)))) for k, shift in shifts.items()}
        return {k: scale for k, scale in scales.items() if scale > 0.0}

    def _field(self, tips_m: Array) -> Array:
        """Random Fourier features of the tip's place (Rahimi and Recht 2007), for each axis: (m, 3, 3 w)."""
        features = np.cos(tips_m @ self._waves.T + self._phases) * math.sqrt(2.0 / len(self._phases))
        return np.asarray(np.einsum("mw,ij->miwj", features, np.eye(3)).reshape(len(tips_m), 3, -1))


def _largest_load_Nm(arm: Arm, sample: Array) -> Array | None:
    """The largest gravity torque of each joint (n,) over the travel, 0 of an upright axis; None without masses."""
    try:
        largest = np.abs(gravity_Nm(arm, sample)).max(axis=0)
    except MissingModel:
        return None
    return np.where(largest > ROUNDING_Nm, largest, 0.0)


def _field_waves(arm: Arm, rng: np.random.Generator) -> tuple[Array, Array]:
    """Wave vectors (w, 3) [rad/m] and phases (w,) of the field."""
    reach_m = float(np.abs(arm.dh[:, (0, 2)]).sum()) + float(np.linalg.norm(arm.tool.position_m))
    waves = rng.standard_normal((FIELD_WAVES, 3)) / (FIELD_LENGTH * max(reach_m, 1e-3))
    return waves, rng.uniform(0.0, 2.0 * math.pi, FIELD_WAVES)


def _play(q_rad: Array, load: Array) -> Array:
    """Play of width 1, and how it departs: unevenly worn over the angle, wider under load, (m, 6)."""
    return np.column_stack((np.ones(len(q_rad)), DEPARTURE * np.column_stack((_waves(q_rad), np.abs(load)))))


def _waves(q_rad: Array) -> Array:
    """One and two waves a turn, (m, 4)."""
    return np.column_stack([wave(order * q_rad) for order in (1, 2) for wave in (np.sin, np.cos)])


def smooth_functions(x: Array, half_rad: float) -> Array:
    """Sines on -half .. half with the weights of a squared exponential of unit variance, (m, order).

    Enough of them for the length scale (Riutort-Mayol et al., Stat. Comput. 33, 2023: 1.75 half / length).
    """
    order = max(3, math.ceil(1.75 * half_rad / ANGLE_LENGTH_rad))
    roots = math.pi / (2.0 * half_rad) * np.arange(1, order + 1)
    spectrum = math.sqrt(2.0 * math.pi) * ANGLE_LENGTH_rad * np.exp(-0.5 * (roots * ANGLE_LENGTH_rad) ** 2)
    return np.asarray(np.sin((x[:, None] + half_rad) * roots) * np.sqrt(spectrum / half_rad))


# On which flank a gear with play lies where poses and currents leave it open: what recorded poses say about friction.
#
# A driven gear transmits g + s h: gravity torque g, and the share s of the friction h that acts on the link's side. Its sign is
# the flank. The share is a property of the joint, unknown but the same at every pose, so poses with visible play tell it for
# all.

SHARES: Final = np.linspace(LINK_SHARE_LEAST, 1.0, 33)
MISTAKE: Final = 1e-3  # probability of a flank that no model explains: no single pose decides
TINY_Nm: Final = 1e-12
SWEEPS: Final = 3  # over the joints, each time with what is then known of the others


def even_odds(joint_count: int) -> Array:
    """Of each joint's share (n, SHARES), before any pose says more."""
    return np.full((joint_count, len(SHARES)), 1.0 / len(SHARES))


@dataclass(frozen=True, slots=True)
class Gears:
    """Gears at rest (m, n), the odds of each joint's share (n, SHARES), and the noise of their motors' torque (n,) [N m]."""

    state: RestingPose
    odds: Array
    noise_Nm: Array

    @property
    def is_open(self) -> Mask:
        """Driven gears whose flank is unclear (m, n)."""
        return np.asarray((self.state.flank == 0.0) & ~self.state.is_led)

    def positive(self, share: float) -> Array:
        """Probability (m, n) of the positive flank."""
        from scipy.special import ndtr

        wrong_Nm = np.hypot(GRAVITY_ERROR * self.state.gravity_Nm, share * self.noise_Nm) + TINY_Nm
        return np.asarray(ndtr((self.state.gravity_Nm + share * self.state.held_Nm) / wrong_Nm))

    def expected(self) -> Array:
        """Mean of each gear's flank (m, n), -1 .. 1: its own where it is clear, 0 of a guided gear."""
        shares = zip(SHARES.tolist(), self.odds.T, strict=True)
        positive = sum((odd * self.positive(share) for share, odd in shares), np.zeros(self.state.flank.shape))
        return np.asarray(np.where(self.is_open, np.clip(2.0 * positive - 1.0, -1.0, 1.0), self.state.flank))

    def drawn(self, count: int, rng: np.random.Generator) -> Array:
        """Where each gear lies between its flanks, -1 .. 1, (count, m, n).

        Share and error of the modelled gravity are drawn once for all poses of a draw. A guided gear lies anywhere.
        """
        state, shape = self.state, (count, *self.state.flank.shape)
        share = np.column_stack([rng.choice(SHARES, count, p=one) for one in self.odds])[:, None, :]
        wrong = 1.0 + GRAVITY_ERROR * rng.standard_normal(share.shape)
        held_Nm = state.held_Nm + self.noise_Nm * rng.standard_normal(shape)
        pressed = np.sign(wrong * state.gravity_Nm + share * held_Nm)
        drawn = np.where(state.is_led, rng.uniform(-1.0, 1.0, shape), pressed)
        return np.asarray(np.where(state.flank != 0.0, state.flank, drawn))

    def weighed(self, left_m: Array, moves_m: Array, mean: Array, noise_m: float) -> tuple[Array, Array]:
        """Odds (n, SHARES), and mean flank of each gear (m, n), by `left_m` (m, 3): what open flanks and noise displaced.

        moves_m (m, 3, n): displacement to the positive flank, 0 where the pose does not count; mean (m, n): flanks so far.
        Every open gear lies on one flank or the other. Joint after joint, the others count as they are believed to lie, what
        is unclear of them as noise.
        """
        moves_m, odds = moves_m * self.is_open[:, None, :], self.odds.copy()
        mean = np.where(self.is_open, mean, 0.0)
        positive = np.array([self.positive(share) for share in SHARES.tolist()])
        logits = _logit(np.clip(positive, MISTAKE, 1.0 - MISTAKE))
        for j in np.flatnonzero(self.is_open.any(axis=0)).tolist() * SWEEPS:
            pulled = _pulled(left_m, moves_m, mean, j, noise_m)
            own = logits[:, :, j]
            told = np.logaddexp(pulled, -pulled - own) - np.logaddexp(0.0, -own)
            logs = told @ self.is_open[:, j]
            odds[j] = np.exp(logs - logs.max())
            odds[j] /= odds[j].sum()
            prior = _logit(np.clip(odds[j] @ positive[:, :, j], MISTAKE, 1.0 - MISTAKE))
            mean[:, j] = np.where(self.is_open[:, j], np.tanh(0.5 * prior + pulled), 0.0)
        return odds, np.where(self.is_open, mean, self.state.flank)


def _logit(probability: Array) -> Array:
    return np.asarray(np.log(probability) - np.log1p(-probability))


def _pulled(left_m: Array, moves_m: Array, mean: Array, joint: int, noise_m: float) -> Array:
    """Half the logarithm (m,) of how much likelier the positive flank of a joint is by what displaced the tip."""
    is_other = np.arange(mean.shape[1]) != joint
    loose_m = moves_m * np.sqrt(is_other * (1.0 - mean**2))[:, None, :]
    spread = np.einsum("mij,mkj->mik", loose_m, loose_m) + noise_m**2 * np.eye(3)
    rest = left_m - np.einsum("mij,mj->mi", moves_m, is_other * mean)
    return np.asarray(np.einsum("mi,mi->m", moves_m[:, :, joint], np.linalg.solve(spread, rest[:, :, None])[:, :, 0]))
