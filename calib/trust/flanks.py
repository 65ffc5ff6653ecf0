"""On which flank a gear with play lies where poses and currents leave it open: what recorded poses say about friction.

A driven gear transmits g + s h: gravity torque g, and the share s of the friction h that acts on the link's side. Its sign is the
flank. The share is a property of the joint, unknown but the same at every pose, so poses with visible play tell it for all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.arrays import Array, Mask
from control.dynamics.static_pose import GRAVITY_ERROR, LINK_SHARE_LEAST, RestingPose

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
        positive = sum(
            (odd * self.positive(share) for share, odd in shares), np.zeros(self.state.flank.shape)
        )
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
    return np.asarray(
        np.einsum("mi,mi->m", moves_m[:, :, joint], np.linalg.solve(spread, rest[:, :, None])[:, :, 0])
    )
