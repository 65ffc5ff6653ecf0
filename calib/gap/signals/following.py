"""The links behind elastic and loose gears, followed along every run; what was followed last is kept.

A fit asks for the same motion many times: with other friction elsewhere, with its slopes, with another tip.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib.arrays import Array
from calib.gap.signals.body import ActingTerms, BodyTorques, Load, sorted_terms
from calib.gap.signals.play import LinkDrive, LinkPlay, elastics, looses
from calib.gap.signals.recording import Flags, RunSet
from calib.gap.signals.terms import Law

SHORTEST_SPRING_rad_Nm = 1e-8
LEAST_INERTIA = 0.1  # of the nominal one
RESTING_rad_s = 0.002  # between link and motor: slower, a loose link lies on its flank
TERMS_KEPT = 48  # motions of elastic joints, some 1.5 MB each
MODELS_KEPT = 6
LOADS_KEPT = 24

Rubbed = tuple[tuple[Law, tuple[float, float]], ...]


class YieldingJoints:
    """The elastic and loose joints of one recording."""

    def __init__(self, recording: RunSet, body: BodyTorques) -> None:
        self._recording, self._body = recording, body
        self._moved: dict[tuple[Load, Rubbed], list[tuple[Array, Array]]] = {}
        self._follow: dict[tuple[Load, int], LinkDrive] = {}
        self._followed_terms: dict[tuple[Load, tuple[float, float], Law], LinkPlay] = {}

    def all(self, parts: ActingTerms) -> list[tuple[Array, Array]]:
        """Link torques and angles beyond the encoders', with the motion of elastic or loose joints in them."""
        key = (parts.load, tuple((term, parts.link_friction(term.index)) for term in parts.elastic))
        if key not in self._moved:
            if len(self._moved) > MODELS_KEPT:
                self._moved.pop(next(iter(self._moved)))
            self._moved[key] = self._follow_anew(parts)
        return self._moved[key]

    def _follow_anew(self, parts: ActingTerms) -> list[tuple[Array, Array]]:
        followed = {term.index: self._followed(parts, term) for term in parts.elastic}
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
        """Samples (m,) of each run at which a loose joint (0-based) of the model lies on neither flank or just lands."""
        parts = sorted_terms(model)
        found = {}
        for term in parts.elastic:
            if term.form.acts == "play":
                moving = np.abs(self._followed(parts, term).speed_rad_s) > RESTING_rad_s
                found[term.index] = [moving[: len(run), k] for k, run in enumerate(self._recording.runs)]
        return found

    def beyond(self, model: Sequence[Law]) -> tuple[list[Array], list[Array]]:
        """Angles and speeds of the links beyond their motors', (m, n) of each run."""
        parts = sorted_terms(model)
        angles = [np.zeros_like(run.q) for run in self._recording.runs]
        speeds = [np.zeros_like(run.q) for run in self._recording.runs]
        for term in parts.elastic:
            found = self._followed(parts, term)
            for k, run in enumerate(self._recording.runs):
                angles[k][:, term.index] = found.delta_rad[: len(run), k]
                speeds[k][:, term.index] = found.speed_rad_s[: len(run), k]
        return angles, speeds

    def foresee(self, model: Sequence[Law], variants: Sequence[Law]) -> None:
        """Follow one joint's elastic or loose gear with several values at once, for `predict` to find them done."""
        joint, form = variants[0].index, variants[0].form
        with_each = [sorted_terms((*model, law)).elastic for law in variants]
        gears = [next(g for g in own if (g.index, g.form) == (joint, form)) for own in with_each]
        self._foresee(sorted_terms(model), gears)

    def _foresee(self, parts: ActingTerms, variants: Sequence[Law]) -> None:
        link_friction = parts.link_friction(variants[0].index)
        missing = [term for term in variants if (parts.load, link_friction, term) not in self._followed_terms]
        if not missing:
            return
        of = replace(
            self._follower(parts.load, missing[0].index),
            coulomb_Nm=link_friction[0],
            viscous_Nm_s_rad=link_friction[1],
        )
        values = [t.values for t in missing]
        if missing[0].form.acts == "play":
            found = looses(of, [(max(w, 0.0), share) for w, share in values])
        else:
            springs = [(1.0 / max(c, SHORTEST_SPRING_rad_Nm), max(d, 0.0), share) for c, d, share in values]
            found = elastics(of, springs)
        while len(self._followed_terms) > TERMS_KEPT:
            self._followed_terms.pop(next(iter(self._followed_terms)))
        for term, one in zip(missing, found, strict=True):
            self._followed_terms[parts.load, link_friction, term] = one

    def _followed(self, parts: ActingTerms, term: Law) -> LinkPlay:
        key = parts.load, parts.link_friction(term.index), term
        if key not in self._followed_terms:
            # The slopes by its values are asked for next, and cost nothing beside it.
            self._foresee(parts, [term, *(neighbour for neighbour, _ in term.neighbours())])
        return self._followed_terms[key]

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


def _side_by_side(columns: list[Array]) -> Array:
    """Runs of different lengths as one array (longest, runs); the shorter ones stay at their last value."""
    longest = max(len(column) for column in columns)
    return np.stack([np.pad(column, (0, longest - len(column)), mode="edge") for column in columns], axis=1)
