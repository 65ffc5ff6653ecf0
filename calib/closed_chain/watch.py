"""Checks new contacts against earlier ones, to detect at once tips that did not touch, or joints of another contact.

As calib.session.residual_watch: from the earlier contacts, the most likely deviations of both arms are estimated (Gauss-Newton, a
normal prior of half the usual bounds), and from them the new contact and its covariance are predicted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arm_problem.frames import Frame
from calib.arrays import Array, frozen
from calib.closed_chain.contacts import Contacts
from calib.closed_chain.pair_problem import PairProblem
from calib.session.residual_watch import NOISE_m, RecordVerdict, weights_of
from control.model.arm import Arm

FEWEST = 6  # contacts before a verdict: they place the second base
PRIOR = 0.5  # of the bounds
PRIOR_BASE = 10.0  # the second base, in its own units: anywhere
STEPS = 3


@dataclass(frozen=True, slots=True)
class _Seen:
    q_rad: tuple[float, ...]
    distance_m: float


class ContactWatch:
    """Stores contacts and checks new ones; `base`: where the second base stands in the first, by the cell's file."""

    def __init__(self, arms: tuple[Arm, Arm], base: Frame) -> None:
        self._arms, self._base = arms, base
        self._seen: dict[object, _Seen] = {}

    def add(self, key: object, q_rad: Sequence[float], distance_m: float) -> None:
        """Add a contact: joint angles of the first arm, then of the second."""
        self._seen[key] = _Seen(tuple(q_rad), distance_m)

    def forget(self, key: object) -> None:
        """Remove a contact."""
        self._seen.pop(key, None)

    def judge(self, q_rad: Sequence[float], distance_m: float) -> RecordVerdict:
        """Compare a contact with the earlier ones. error_m: how far it is from closing by the files, along the first axis."""
        before = [*self._seen.values()]
        problem = PairProblem(
            self._arms, self._contacts([*before, _Seen(tuple(q_rad), distance_m)]), self._base
        )
        open_m = float(problem.errors_m(np.zeros(len(problem.parameters)))[-1])
        error_m = frozen(np.array([open_m, 0.0, 0.0]))
        if len(before) < FEWEST:
            return RecordVerdict(error_m)
        innovation_m, spread_m2 = _predicted(problem)
        off_sd = float(np.sqrt(innovation_m @ np.linalg.solve(spread_m2, innovation_m)))
        return RecordVerdict(error_m, float(np.linalg.norm(innovation_m)), off_sd)

    def _contacts(self, seen: Sequence[_Seen]) -> Contacts:
        count = self._arms[0].joint_count
        q_rad = np.array([one.q_rad for one in seen])
        names = tuple(str(k) for k in range(len(seen)))
        distance_m = np.array([one.distance_m for one in seen])
        return Contacts(names, names, frozen(q_rad[:, :count]), frozen(q_rad[:, count:]), frozen(distance_m))


def _predicted(problem: PairProblem) -> tuple[Array, Array]:
    """Of the last contact: its innovation (3,) [m] and covariance (3, 3) [m2], by all others."""
    prior = np.array([PRIOR if p.has_bound else PRIOR_BASE for p in problem.parameters]) ** -2.0
    x = np.zeros(len(prior))
    for _ in range(STEPS):
        residual, slopes = problem.of_contacts(x)
        weights = weights_of(residual[:-1], NOISE_m) / NOISE_m**2
        information = np.einsum("m,mik,mil->kl", weights, slopes[:-1], slopes[:-1]) + np.diag(prior)
        aim = slopes[:-1] @ x - residual[:-1]
        x = np.linalg.solve(information, np.einsum("m,mik,mi->k", weights, slopes[:-1], aim))
    residual, slopes = problem.of_contacts(x)
    covariance = slopes[-1] @ np.linalg.solve(information, slopes[-1].T)
    return residual[-1], covariance + NOISE_m**2 * np.eye(3)
