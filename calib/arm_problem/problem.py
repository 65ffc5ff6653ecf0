"""Residuals of an arm and their analytic Jacobian in scaled unknowns.

An unknown x is a deviation divided by its scale (its bound, if it has one), so that the box is -1 .. 1 for
lengths and angles alike: in SI units a solver stops far from the optimum, because a radian moves the tip half a
metre and a metre moves it one.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calib.arm_problem.arm_model import ArmModel, Bounds, Parameter, dh_parameters, require_known_names
from calib.arm_problem.expansion import ALL, Expansion
from calib.arm_problem.observations import AXIS_UNITS, Frame, Observations, cross_matrix, left_jacobian, rotation_of
from calib.arrays import Array, frozen, norms
from calib.errors import CalibrationError
from control.kinematics.rotation import exponentials

TOOL_NAMES = ("tool_x", "tool_y", "tool_z")
SEATING_STEPS = 3  # Newton's, from millimetres to nanometres
SEATING_LIMIT_rad = 0.1  # of one such step
REACHABLE = 1e-2  # share of the strongest direction of the tip that joints must have to move it


@dataclass(frozen=True, slots=True)
class ModelValues:
    """Parameters at unknowns x: DH table (links, 4), tool (3,), frames, values of the corrections."""

    dh: Array
    tool_m: Array
    frames: tuple[Frame, ...]
    corrections: dict[str, float]


@dataclass(frozen=True, slots=True)
class Turns:
    """Orientations of r poses in the base frame: of the last link by the model, and as measured (r, 3, 3 each).

    `by_model`, `by_measured` (r, 3, k): how each turns with every scaled unknown, as angular velocities in the base frame.
    """

    model: Array
    measured: Array
    by_model: Array
    by_measured: Array


class ArmProblem:
    """Reference points of the tip against DH deviations (SpringerPlus 5:1771, eq. (4)), tool, frames, corrections."""

    def __init__(
        self,
        model: ArmModel,
        observed: Observations,
        *,
        bounds: Bounds | None = None,
        fixed: Collection[str] = (),
        is_tool_free: bool = False,
        tool_m: Array | None = None,
    ) -> None:
        """`fixed` names parameters that keep their start value; `tool_m` (3,) is the tool, by default nominal.

        Free frames start at their pose in `observed`. CalibrationError for an unknown name, or if nothing is
        left to identify.
        """
        self.model, self.observed = model, observed
        self._tool_m = frozen(model.nominal_tool_m if tool_m is None else tool_m)
        self._centres = _centres(observed)
        self._free = [k for k, frame in enumerate(observed.frames) if frame.is_free]
        self.references_m = _in_base(observed)
        self._tool_at = model.nominal_dh.size  # position of each part in the deviation vector
        self._frames_at = self._tool_at + 3 * is_tool_free
        self._corrections_at = self._frames_at + 6 * len(self._free)
        everything = self._every_parameter(bounds or Bounds(), is_tool_free)
        names = [parameter.name for parameter in everything]
        require_known_names({*fixed, *(bounds or Bounds()).own}, names)
        self._places = np.array([k for k, name in enumerate(names) if name not in fixed], dtype=np.intp)
        if not len(self._places):
            raise CalibrationError("every parameter is fixed: free at least one")
        self.parameters = tuple(everything[k] for k in self._places)
        self.everything = tuple(everything)  # those that are fixed, too
        self._scale = np.array([parameter.scale for parameter in self.parameters])
        self._start = np.array([c.nominal for c in observed.corrections])
        self._whole_size = len(everything)
        self._follows: tuple[Array, Array] | None = None

    def _every_parameter(self, bounds: Bounds, is_tool_free: bool) -> tuple[Parameter, ...]:
        """DH, tool, free frames, corrections: the order of the whole deviation vector."""
        parameters = list(dh_parameters(self.model, bounds))
        if is_tool_free:
            parameters += [
                Parameter(name, "m", float(value), bounds.of_free(name, "m"))
                for name, value in zip(TOOL_NAMES, self._tool_m, strict=True)
            ]
        for frame in self.free_frames:
            parameters += [
                Parameter(name, unit, 0.0, bounds.of_free(name, unit))
                for name, unit in zip(frame.parameter_names, AXIS_UNITS, strict=True)
            ]
        parameters += [
            Parameter(c.name, c.unit, c.nominal, bounds.own.get(c.name, c.bound), c.typical, c.sd, c.made - c.nominal)
            for c in self.observed.corrections
        ]
        return tuple(parameters)

    @property
    def free_frames(self) -> tuple[Frame, ...]:
        """Indices of the identified frames."""
        return tuple(frame for frame in self.observed.frames if frame.is_free)

    @property
    def scale(self) -> Array:
        """Scales of the unknowns, (k,): a deviation is x times this."""
        return self._scale

    def __len__(self) -> int:
        """How many poses."""
        return len(self.observed)

    def of_rows(self, rows: npt.ArrayLike | slice) -> ArmProblem:
        """The problem with the same unknowns for some of the poses (indices, a mask or a slice)."""
        subset = copy.copy(self)
        keep = np.arange(len(self))[rows if isinstance(rows, slice) else np.asarray(rows)]
        subset.observed, subset.references_m = self.observed.chosen(keep), self.references_m[keep]
        if self._follows is not None:
            subset._follows = self._follows[0][keep], self._follows[1]
        return subset

    def following(self, by_parameter: Mapping[str, Array], at: ModelValues) -> ArmProblem:
        """The problem where effects follow parameters of the arm: its loads, whose slopes are those at the solution `at`.

        `by_parameter`: how the tips (m, 3) follow, per parameter's own unit, besides what the slopes and the geometry do.
        """
        names = [parameter.name for parameter in self.everything]
        slope, place = np.zeros((len(self), 3, len(names))), np.zeros(len(names))
        for k, name in enumerate(names):
            slope[:, :, k] = by_parameter.get(name, 0.0)
        place[: self._tool_at] = (at.dh - self.model.nominal_dh).ravel()
        if self._frames_at > self._tool_at:
            place[self._tool_at : self._frames_at] = at.tool_m - self._tool_m
        values = [at.corrections.get(one.name, one.nominal) for one in self.observed.corrections]
        place[self._corrections_at :] = np.array(values) - self._start
        problem = copy.copy(self)
        problem._follows = slope, place
        return problem

    def solution(self, x: Array) -> ModelValues:
        """The parameters at unknowns x (k,)."""
        dh, tool, moves, values = self._parts(x)
        frames = list(self.observed.frames)
        for index, move in zip(self._free, moves, strict=True):
            frames[index] = frames[index].moved(self._centres[index], move)
        names = [correction.name for correction in self.observed.corrections]
        return ModelValues(frozen(dh), frozen(tool), tuple(frames), dict(zip(names, values.tolist(), strict=True)))

    def tips(self, solution: ModelValues) -> Array:
        """Tips of a solution at these poses, (m, 3), base frame, including corrections and flexure."""
        known = solution.corrections  # a part of a play that no other pose lies in is not among them
        values = np.array([known.get(one.name, one.nominal) for one in self.observed.corrections])
        joint_rad = self._joint_rad(values, ALL)
        return self._bent(self.model.tips(solution.dh, joint_rad, solution.tool_m), values, ALL)

    def _parts(self, x: Array) -> tuple[Array, Array, Array, Array]:
        """DH table, tool, deviations of the free frames (f, 6), values of the corrections, at unknowns x."""
        whole = np.zeros(self._whole_size)
        whole[self._places] = x * self._scale
        dh, tool, moves, values = np.split(whole, [self._tool_at, self._frames_at, self._corrections_at])
        tool = self._tool_m + tool if len(tool) else self._tool_m
        return self.model.nominal_dh + dh.reshape(-1, 4), tool, moves.reshape(-1, 6), self._start + values

    def _joint_rad(self, values: Array, rows: slice) -> Array:
        """Joint angles (m, n): encoders and corrections."""
        q = self.observed.q_rad[rows]
        for value, correction in zip(values, self.observed.corrections, strict=True):
            q = q + value * correction.slope_rad[rows]
        return q

    def _bent(self, tips: Array, values: Array, rows: slice) -> Array:
        """Tips (m, 3) with the displacement by flexure."""
        if self.observed.known_shift_m is not None:
            tips = tips + self.observed.known_shift_m[rows]
        for value, correction in zip(values, self.observed.corrections, strict=True):
            if correction.slope_m is not None:
                tips = tips + value * correction.slope_m[rows]
        return tips

    def residuals(self, x: Array, rows: slice = ALL) -> Array:
        """Reference minus modelled tip, (m, 3), base frame."""
        dh, tool, moves, values = self._parts(x)
        tips = self.model.tips(dh, self._joint_rad(values, rows), tool)
        return np.asarray(self._references(moves, rows)[0] - self._bent(tips, values, rows) - self._followed(x, rows))

    def _followed(self, x: Array, rows: slice) -> Array:
        """What effects do at unknowns x beyond their slopes, (m, 3) or 0."""
        if self._follows is None:
            return np.zeros(3)
        whole = np.zeros(self._whole_size)
        whole[self._places] = x * self._scale
        return np.asarray(self._follows[0][rows] @ (whole - self._follows[1]))

    def residuals_and_jacobian(self, x: Array, rows: slice = ALL) -> tuple[Array, Array]:
        """Residuals (m, 3) and their derivative with respect to x, (m, 3, k)."""
        expansion = self.expanded(x, rows)
        chosen = expansion.columns[self._places]
        chosen *= -self._scale[:, None, None]
        return expansion.residuals, chosen.transpose(2, 1, 0)

    def expanded(self, x: Array, rows: slice = ALL) -> Expansion:
        """Residuals, and sums of their first and second derivatives."""
        dh, tool, moves, values = self._parts(x)
        slopes = self.model.slopes(dh, self._joint_rad(values, rows), tool)
        references, arms = self._references(moves, rows)
        if self._whole_size == self._tool_at:
            columns = slopes.by_dh.transpose(2, 1, 0)
        else:
            columns = np.empty((self._whole_size, 3, len(references)))
            columns[: self._tool_at] = slopes.by_dh.transpose(2, 1, 0)
            if self._frames_at > self._tool_at:
                columns[self._tool_at : self._frames_at] = slopes.by_tool.transpose(2, 1, 0)
            self._frame_columns(columns[self._frames_at : self._corrections_at], moves, arms, rows)
            self._correction_columns(columns[self._corrections_at :], slopes.by_dh, rows)
        if self._follows is not None:
            columns = columns + self._follows[0][rows].transpose(2, 1, 0)
        return Expansion(
            residuals=references - self._bent(slopes.tips, values, rows) - self._followed(x, rows),
            columns=columns,
            places=self._places,
            scale=self._scale,
            chain_count=self._frames_at,
            is_modified=self.model.is_modified,
            frame_rows=tuple(np.flatnonzero(self.observed.frame[rows] == index) for index in self._free),
            frame_turns_rad=moves[:, 3:],
            arms=arms,
            theta_places=self.model.theta_places,
            corrections=tuple(correction.slope_rad[rows] for correction in self.observed.corrections),
        )

    def turns(self, x: Array, rows: npt.NDArray[np.intp]) -> Turns:
        """Orientations of these poses, whose orientation was measured, and their derivatives.

        A turn about an axis turns the last link about it; that axis is the derivative of the tip by the move along it.
        """
        dh, tool, moves, values = self._parts(x)
        q = self.observed.q_rad[rows]
        for value, correction in zip(values, self.observed.corrections, strict=True):
            q = q + value * correction.slope_rad[rows]
        slopes = self.model.slopes(dh, q, tool)
        by_model = np.zeros((len(rows), 3, self._whole_size))
        by_model[:, :, 1 : self._tool_at : 4] = slopes.by_dh[:, :, 0::4]
        by_model[:, :, 3 : self._tool_at : 4] = slopes.by_dh[:, :, 2::4]
        theta = list(self.model.theta_places)
        bent = np.zeros((len(rows), 3)) if self.observed.known_turn_rad is None else self.observed.known_turn_rad[rows]
        for place, correction in enumerate(self.observed.corrections, self._corrections_at):
            by_model[:, :, place] = np.einsum("rij,rj->ri", by_model[:, :, theta], correction.slope_rad[rows])
            if correction.turn_rad is not None:  # some mrad at most: turns add up
                by_model[:, :, place] += correction.turn_rad[rows]
                bent = bent + values[place - self._corrections_at] * correction.turn_rad[rows]
        measured, by_measured = self._measured_turns(moves, rows)
        scaled = [part[:, :, self._places] * self._scale for part in (by_model, by_measured)]
        model = exponentials(bent) @ slopes.by_tool if bent.any() else slopes.by_tool
        return Turns(model, measured, *scaled)

    def _measured_turns(self, moves: Array, rows: npt.NDArray[np.intp]) -> tuple[Array, Array]:
        """Measured orientations in the base frame, (r, 3, 3), and their derivatives by free frames (r, 3, K)."""
        if self.observed.rotation is None:
            raise CalibrationError("these points have no measured orientation")
        rotations, by_measured = self.observed.rotation[rows], np.zeros((len(rows), 3, self._whole_size))
        which, turns = self.observed.frame[rows], np.empty((len(rows), 3, 3))
        for index, frame in enumerate(self.observed.frames):
            here = np.flatnonzero(which == index)
            turn = frame.rotation
            if index in self._free:
                place = self._free.index(index)
                move = moves[place]
                turn = rotation_of(move[3:]) @ turn
                first = self._frames_at + 6 * place + 3
                by_measured[here, :, first : first + 3] = left_jacobian(move[3:])
            turns[here] = turn @ rotations[here]
        return turns, by_measured

    def sensitivity(self, x: Array, rows: slice = ALL) -> Array:
        """The Jacobian (m, 3, k) at poses near the measured ones whose tips are at their references.

        It shows what the points determine. Rotating arm and board together also rotates a residual r, so the Jacobian contains
        w x r as if that rotation were observable, although no distance changes. Zero residuals avoid this.
        If no board is free, it is the Jacobian at the measured poses.
        """
        seated = copy.copy(self) if rows == ALL else self.of_rows(rows)
        for _ in range(SEATING_STEPS if self._free else 0):
            expansion = seated.expanded(x)
            by_joint = expansion.columns[list(self.model.theta_places)].transpose(2, 1, 0)
            move = np.einsum("mnk,mk->mn", np.linalg.pinv(by_joint, rcond=REACHABLE), expansion.residuals)
            move *= np.minimum(1.0, SEATING_LIMIT_rad / np.maximum(norms(move), 1e-300))[:, None]
            seated.observed = dataclasses.replace(seated.observed, q_rad=seated.observed.q_rad + move)
        return seated.residuals_and_jacobian(x)[1]

    def _references(self, moves: Array, rows: slice) -> tuple[Array, Array]:
        """Reference points (m, 3) in the base frame, and their arms (m, 3) from the centre of their free frame."""
        references = self.references_m[rows]
        if not self._free:
            return references, references
        references, arms = references.copy(), np.zeros_like(references)
        which = self.observed.frame[rows]
        for index, move in zip(self._free, moves, strict=True):
            here, frame = which == index, self.observed.frames[index]
            anchor = frame.to_base(self._centres[index])
            arms[here] = (references[here] - anchor) @ rotation_of(move[3:]).T
            references[here] = anchor + move[:3] + arms[here]
        return references, arms

    def _frame_columns(self, columns: Array, moves: Array, arms: Array, rows: slice) -> None:
        """Minus the derivative of the references by each free frame's translation and rotation (the tip's have a plus)."""
        which = self.observed.frame[rows]
        for place, (index, move) in enumerate(zip(self._free, moves, strict=True)):
            here = np.flatnonzero(which == index)
            block = columns[6 * place : 6 * place + 6]
            block[:] = 0.0
            turns = left_jacobian(move[3:])
            for axis in range(3):
                block[axis, axis, here] = -1.0
                block[3 + axis][:, here] = -(cross_matrix(turns[:, axis]) @ arms[here].T)

    def _correction_columns(self, columns: Array, by_dh: Array, rows: slice) -> None:
        """Derivatives by the corrections: through the joints' angles, and of the tip itself."""
        theta = list(self.model.theta_places)
        for column, correction in zip(columns, self.observed.corrections, strict=True):
            column[:] = np.einsum("mij,mj->im", by_dh[:, :, theta], correction.slope_rad[rows])
            if correction.slope_m is not None:
                column += correction.slope_m[rows].T


def _centres(observed: Observations) -> list[Array]:
    """The centre of each frame's points, in the frame."""
    return [
        observed.position_m[observed.rows_of(k)].mean(axis=0) if (observed.frame == k).any() else np.zeros(3)
        for k in range(len(observed.frames))
    ]


def _in_base(observed: Observations) -> Array:
    """The reference points in the base frame by the prior frames, (m, 3)."""
    references = np.array(observed.position_m)
    for k, frame in enumerate(observed.frames):
        here = observed.rows_of(k)
        references[here] = frame.to_base(observed.position_m[here])
    return frozen(references)
