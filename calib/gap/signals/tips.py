"""What the camera sees: tips from angles, and what moves them without a joint."""

from __future__ import annotations

import numpy as np

from calib.arm_problem.frames import seen_less_far_m
from calib.arm_problem.link_bending import bending_m
from calib.arrays import Array
from calib.gap.signals.angles import joint_ahead
from calib.gap.signals.parts import ActingTerms
from calib.gap.signals.recording import EvenRun, RunSet
from calib.gap.signals.terms import Law
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm

BENDS_KEPT = 16


class SeenTips:
    """The tips of one recording."""

    def __init__(self, arm: Arm, recording: RunSet) -> None:
        self._arm, self._recording = arm, recording
        self._kinematics = ForwardKinematics(arm)
        self._rigid = [
            self._kinematics.tips(run.q_raw[run.frames]) if recording.has_tip else np.zeros((0, 3))
            for run in recording.runs
        ]
        self.jacobians = [
            self._kinematics.jacobians(run.q_raw[run.frames]) if recording.has_tip else np.zeros((0, 3, 0))
            for run in recording.runs
        ]
        self._dh: list[Array] | None = None
        self._bends: dict[tuple[int, float], list[Array]] = {}

    def beside_camera(self, parts: ActingTerms, run: EvenRun, k: int, offset: Array) -> Array:
        """Expected less seen tips (frames, 3) of run k, whose links are `offset` (m, n) beyond their encoders."""
        if not self._recording.has_tip:
            return np.zeros((0, 3))
        q = run.q_raw[run.frames]
        expected = self._rigid[k]
        if parts.elastic or parts.angles:
            turned = q + offset[run.frames]
            if parts.angles:
                turned += joint_ahead(parts.angles, q, run.t_s[run.frames])
            expected = self._kinematics.tips(turned)
        for term in parts.tip:
            expected = expected + self._shift(parts, term, k, run)
        return np.asarray(expected - run.tip_m)

    def _shift(self, parts: ActingTerms, term: Law, k: int, run: EvenRun) -> Array:
        if term.form.acts == "beam":
            return self._bent(term.name.joint or 1, parts.load.payload_kg)[k] * term.values[0]
        if term.form.acts == "geometry":
            if self._dh is None:
                self._dh = [
                    self._kinematics.identification_jacobian(r.q_raw[r.frames]) for r in self._recording.runs
                ]
            return np.asarray(self._dh[k] @ np.array(term.values))
        return seen_less_far_m(run.tip_m, np.array(term.values))

    def _bent(self, link: int, extra_kg: float) -> list[Array]:
        """How the tip moves per 1 / EI of a link as its loads hang on it and are thrown about, (frames, 3) of each run.

        The beam follows its loads at once: its resonance is far above what an arm is moved with.
        """
        key = (link, extra_kg)
        if key not in self._bends:
            if len(self._bends) > BENDS_KEPT:
                self._bends.clear()
            self._bends[key] = [self._bent_along(link, extra_kg, run) for run in self._recording.runs]
        return self._bends[key]

    def _bent_along(self, link: int, extra_kg: float, run: EvenRun) -> Array:
        payload = np.maximum(run.payload_kg + extra_kg, 0.0)

        def accelerated(place_m: Array) -> Array:
            return self._recording.filters.states(place_m)[2]

        return bending_m(self._arm, self._arm.dh, run.q_raw, payload, link, accelerated)[run.frames]
