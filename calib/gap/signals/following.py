"""The links behind elastic and loose gears, followed along every run; what was followed last is kept.

A fit asks for the same motion many times: with other friction elsewhere, with its slopes, with another tip.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib.arrays import Array
from calib.gap.signals.body import ActingTerms, BodyTorques, Load, share_behind, sorted_terms
from calib.gap.signals.play import LinkDrive, LinkPlay, elastics, looses
from calib.gap.signals.recording import Flags, RunSet
from calib.gap.signals.terms import Law

SHORTEST_SPRING_rad_Nm = 1e-8
LEAST_INERTIA = 0.1  # of the nominal one
RESTING_rad_s = 0.002  # between link and motor: slower, a loose link lies on its flank
TERMS_KEPT = 24  # motions of elastic joints, some 1.5 MB each
MODELS_KEPT = 6
LOADS_KEPT = 24

Gear = tuple[Law, ...]  # what is soft or loose in one joint's
Rubbed = tuple[tuple[Gear, tuple[float, float]], ...]


class YieldingJoints:
    """The elastic and loose joints of one recording."""

    def __init__(self, recording: RunSet, body: BodyTorques) -> None:
        self._recording, self._body = recording, body
        self._moved: dict[tuple[Load, Rubbed], list[tuple[Array, Array]]] = {}
        self._follow: dict[tuple[Load, int], LinkDrive] = {}
        self._followed_gears: dict[tuple[Load, tuple[float, float], Gear], LinkPlay] = {}

    def all(self, parts: ActingTerms) -> list[tuple[Array, Array]]:
        """Link torques and angles beyond the encoders', with the motion of elastic or loose joints in them."""
        key = (parts.load, tuple((gear, parts.link_friction(j)) for j, gear in parts.gears().items()))
        if key not in self._moved:
            if len(self._moved) > MODELS_KEPT:
                self._moved.pop(next(iter(self._moved)))
            self._moved[key] = self._follow_anew(parts)
        return self._moved[key]

    def _follow_anew(self, parts: ActingTerms) -> list[tuple[Array, Array]]:
        followed = {j: self._followed(parts, gear) for j, gear in parts.gears().items()}
        result = []
        for k, run in enumerate(self._recording.runs):
            q, speed, acceleration = np.array(run.q), np.array(run.speed), np.array(run.acceleration)
            offset = np.zeros_like(q)
            for j, found in followed.items():
                offset[:, j] = found.delta_rad[: len(run), k]
                q[:, j] += offset[:, j]
                speed[:, j] += found.speed_rad_s[: len(run), k]
                acceleration[:, j] += found.acceleration_rad_s2[: len(run), k]
            link = self._body.moved(parts.load, run, q, speed, acceleration)
            for j, found in followed.items():
                link[:, j] = found.transmitted_Nm[: len(run), k]
            result.append((link, offset))
        return result

    def flights(self, model: Sequence[Law]) -> dict[int, list[Flags]]:
        """Samples (m,) of each run at which a loose joint (0-based) of the model lies on neither flank, or on a hard one just
        lands.
        """
        parts = sorted_terms(model)
        found = {}
        for j, gear in parts.gears().items():
            if gear[-1].form.acts != "play":
                continue
            one = self._followed(parts, gear)
            if len(gear) == 1:
                moving = np.abs(one.speed_rad_s) > RESTING_rad_s
            else:
                moving = np.abs(one.delta_rad) < 0.5 * gear[-1].values[0]
            found[j] = [moving[: len(run), k] for k, run in enumerate(self._recording.runs)]
        return found

    def beyond(self, model: Sequence[Law]) -> tuple[list[Array], list[Array]]:
        """Angles and speeds of the links beyond their motors', (m, n) of each run."""
        parts = sorted_terms(model)
        angles = [np.zeros_like(run.q) for run in self._recording.runs]
        speeds = [np.zeros_like(run.q) for run in self._recording.runs]
        for j, gear in parts.gears().items():
            found = self._followed(parts, gear)
            for k, run in enumerate(self._recording.runs):
                angles[k][:, j] = found.delta_rad[: len(run), k]
                speeds[k][:, j] = found.speed_rad_s[: len(run), k]
        return angles, speeds

    def foresee(self, model: Sequence[Law], variants: Sequence[Law]) -> None:
        """Follow one joint's elastic or loose gear with several values at once, for `predict` to find them done."""
        joint = variants[0].index
        self._foresee(sorted_terms(model), [sorted_terms((*model, law)).gears()[joint] for law in variants])

    def _foresee(self, parts: ActingTerms, variants: Sequence[Gear]) -> None:
        joint = variants[0][0].index
        link_friction = parts.link_friction(joint)
        missing = [gear for gear in variants if (parts.load, link_friction, gear) not in self._followed_gears]
        if not missing:
            return
        of = replace(self._follower(parts.load, joint), coulomb_Nm=link_friction[0], viscous_Nm_s_rad=link_friction[1])
        if missing[0][0].form.acts == "play":
            found = looses(of, [(max(gear[0].values[0], 0.0), share_behind(gear)) for gear in missing])
        else:
            found = elastics(of, [_spring(gear) for gear in missing])
        while len(self._followed_gears) > TERMS_KEPT:
            self._followed_gears.pop(next(iter(self._followed_gears)))
        for gear, one in zip(missing, found, strict=True):
            self._followed_gears[parts.load, link_friction, gear] = one

    def _followed(self, parts: ActingTerms, gear: Gear) -> LinkPlay:
        key = parts.load, parts.link_friction(gear[0].index), gear
        if key not in self._followed_gears:
            # The slopes by its values are asked for next, and cost nothing beside it.
            neighbours = [
                (*gear[:place], near, *gear[place + 1 :]) for place, term in enumerate(gear) for near, _ in term.neighbours()
            ]
            self._foresee(parts, [gear, *neighbours])
        return self._followed_gears[key]

    def _follower(self, load: Load, j: int) -> LinkDrive:
        key = (load, j)
        if key not in self._follow:
            if len(self._follow) > LOADS_KEPT:
                self._follow.clear()
            torques = [part[:, j] for part in self._body.link_torques(load)]
            self._follow[key] = LinkDrive(
                _side_by_side(torques),
                _side_by_side(self._turned(load, j)),
                _side_by_side(self._body.gravity_slope(load, j)),
                1.0 / self._recording.filters.rate_Hz,
                _side_by_side([run.speed[:, j] for run in self._recording.runs]),
            )
        return self._follow[key]

    def _turned(self, load: Load, j: int) -> list[Array]:
        """The inertia that a joint turns; no load that is tried takes nearly all of it away: nothing could be followed then."""
        own, nominal = self._body.own_inertia(load, j), self._body.own_inertia(Load(), j)
        return [np.maximum(part, LEAST_INERTIA * known) for part, known in zip(own, nominal, strict=True)]


def _spring(gear: Gear) -> tuple[float, ...]:
    """Stiffness, damping, share of friction behind, and width of a soft gear, which may be loose as well."""
    compliance, damping, _ = gear[0].values
    width = max(gear[1].values[0], 0.0) if len(gear) > 1 else 0.0
    return 1.0 / max(compliance, SHORTEST_SPRING_rad_Nm), max(damping, 0.0), share_behind(gear), width


def _side_by_side(columns: list[Array]) -> Array:
    """Runs of different lengths as one array (longest, runs); the shorter ones stay at their last value."""
    longest = max(len(column) for column in columns)
    return np.stack([np.pad(column, (0, longest - len(column)), mode="edge") for column in columns], axis=1)
