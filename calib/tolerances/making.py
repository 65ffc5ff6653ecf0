"""Draws arms as they are made: tolerances.toml says how exactly each part is, every tolerance is a factor of
its own.

In: tolerances.toml (docs/tolerances.md). Out: DH deviations, tools, and what joints and links do, as linear
terms of the tip.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np

from calib.arm_problem.arm_model import ArmModel, dh_names
from calib.arm_problem.link_bending import beams, bending_m
from calib.arm_problem.problem import TOOL_NAMES
from calib.arrays import Array
from calib.errors import CalibrationError
from calib.trust.discrepancy import Conditions
from calib.trust.prediction import encoder_steps_rad
from control.dynamics.static_pose import resting
from control.files import parsed_toml, read_text
from control.kinematics import chain
from control.model.arm import Arm
from control.model.drive import NonNegative
from control.model.effects import backlash_rad, compliance_rad
from control.model.reader import Rejected, read_table
from control.model.rules import Rule
from control.model.tolerances import AnyTable, JointTolerances, Spread, Tolerances, check_tolerances, spreads

# tolerances.toml: the tables of [tolerances] in arm.toml (control.model.tolerances), and how the arm will be calibrated.


class TolerancesFileError(CalibrationError):
    """An invalid tolerances.toml; the message names file and key."""


@dataclass(frozen=True, slots=True)
class CalibrationTable:
    """How the arm will be calibrated."""

    poses: Annotated[int, Rule("a whole number from 10 to 5000", lambda count: 10 <= count <= 5000), "that will be measured"] = 60
    noise_m: Annotated[NonNegative | None, "standard deviation of one axis of the measured tip", "that of [camera]"] = None


@dataclass(frozen=True, slots=True)
class TolerancesFile(Tolerances):
    """A tolerances.toml: how exactly parts are made. Without a tolerance a part is exact.

    A spread is { within = 2e-4 } (uniform, +-) or { sd = 1e-4 } (normal), both optionally with mean; or
    { from = 0.0, to = 1e-3 }.
    """

    name: Annotated[str, "for you"] = ""
    calibration: CalibrationTable = CalibrationTable()

    @property
    def poses(self) -> int:
        """That the calibration measures."""
        return self.calibration.poses

    @property
    def noise_m(self) -> float:
        """Standard deviation of one axis of a measured tip."""
        return self.calibration.noise_m or 0.0


OF_TRANSMISSION = ("gear_eccentricity_rad", "backlash_rad", "stiffness_Nm_rad")


def tolerances_text(path_or_name: str) -> str:
    """The text of a file, or of a supplied one by name. TolerancesFileError names the file."""
    supplied = Path(__file__).parent / f"{path_or_name}.toml"
    try:
        return supplied.read_text("utf-8") if supplied.is_file() else read_text(Path(path_or_name))
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise TolerancesFileError(f"{path_or_name}: cannot be read: {reason}") from None


def parse_tolerances(text: str, where: str, arm: Arm) -> TolerancesFile:
    """Tolerances from TOML text; `where` names it in errors."""
    try:
        made = read_table(TolerancesFile, parsed_toml(text))
        check_tolerances(made, len(arm.links), arm.joint_count, Rejected)
    except tomllib.TOMLDecodeError as error:
        raise TolerancesFileError(f"{where}: not valid TOML: {error}") from error
    except Rejected as error:
        hint = f" ({error.hint})" if error.hint else ""
        hint = ", such as { within = 2e-4 }" if error.expected == "a table" else hint
        place = ".".join(map(str, error.path))
        raise TolerancesFileError(f"{where}: {place}: expected {error.expected}, got {error.got}{hint}") from None
    return _usable(made, where, arm)


def own_tolerances(arm: Arm) -> TolerancesFile:
    """Those of [tolerances] in an arm's file. TolerancesFileError where it has none."""
    stated, where = arm.tolerances, str(arm.path or arm.name)
    if stated is None:
        raise TolerancesFileError(
            f"--design: give --tolerances, a file that says how exactly the parts are made; or write [tolerances] into {where}"
        )
    parts = {each.name: getattr(stated, each.name) for each in fields(Tolerances)}
    return _usable(TolerancesFile(**parts), where, arm)


def as_designed(arm: Arm) -> Arm:
    """The arm with the links that it was to have, where `calibrate` has written into its file those that it has."""
    return arm.with_dh(np.array(arm.tolerances.about)) if arm.tolerances is not None and arm.tolerances.about else arm


def _usable(made: TolerancesFile, where: str, arm: Arm) -> TolerancesFile:
    """With the camera's noise, if it states none."""
    tables: tuple[AnyTable, ...] = (made.every_link, made.every_joint, *made.link.values(), *made.joint.values(), made.tool)
    if not any(spreads(table) for table in tables):
        raise TolerancesFileError(
            f"{where}: no tolerance: expected some in [every_link], [every_joint], [link.2], [joint.1] or [tool]"
        )
    if made.calibration.noise_m is not None:
        return made
    if arm.camera is None:
        raise TolerancesFileError(
            f"{where}: noise_m is missing: expected the standard deviation of one axis of the measured tip in m, as"
            f" position_noise_m in [camera] of arm {arm.name}, or as noise_m in [calibration] of a file for --tolerances"
        )
    return replace(made, calibration=replace(made.calibration, noise_m=arm.camera.position_noise_m))


# The linear parameters of a made arm: DH deviations, the tool, and what joints and links do beside them;
# tips of many arms.
#
# An arm is a vector z of parameters; all arms of a study share the terms. Joint j turns by q + sum(z_k
# column_k(q)); links that bend add z_k shift_k(q) to the tip. The tip itself is that of the full forward
# kinematics.


Kind = Literal["scale", "sine", "cosine", "play", "compliance", "bending"]
BY_MASSES: Final = ("play", "compliance", "bending")  # laws of gravity: they need masses in arm.toml


@dataclass(frozen=True, slots=True)
class MakingTerm:
    """One parameter beyond geometry: its law, and the joint or link (1-based); `waves` per turn of the joint."""

    kind: Kind
    number: int
    waves: float = 1.0


class MadePoses:
    """Poses of arms that are made of the same terms; z (arms, 4 links + 3 + terms)."""

    def __init__(self, arm: Arm, terms: tuple[MakingTerm, ...], at: Conditions) -> None:
        """MissingModel if a term needs masses that the arm's file lacks."""
        self._arm, self._model, self.at = arm, ArmModel(arm), at
        self._dh_count = 4 * len(arm.links)
        self.names = (*dh_names(len(arm.links)), *TOOL_NAMES)
        self._flank, self._gravity_Nm = _gears(arm, terms, at)
        placed = list(enumerate(terms, start=len(self.names)))
        self._turning = [(k, term.number - 1, self._column(term)) for k, term in placed if term.kind != "bending"]
        self._bending = [
            (k, bending_m(arm, at.q_rad, at.payload_kg, term.number)) for k, term in placed if term.kind == "bending"
        ]
        self._plays = [(k, term.number - 1) for k, term in placed if term.kind == "play"]

    def tips(self, z: Array, turned_rad: Array | None = None) -> Array:
        """Tips (3, arms, m) of arms z (arms, k); `turned_rad` (n, arms, m) is added to the joints' angles."""
        q = [angle[None, :] for angle in self.at.q_rad.T]
        for k, j, column in self._turning:
            q[j] = q[j] + z[:, k, None] * column
        if turned_rad is not None:
            q = [angle + more for angle, more in zip(q, turned_rad, strict=True)]
        end = self._dh_count
        rows = (self._arm.dh.ravel() + z[:, :end]).T[:, :, None]
        dh = [list(rows[4 * i : 4 * i + 4]) for i in range(len(self._arm.links))]
        tool = (self._model.nominal_tool_m + z[:, end : end + 3]).T[:, :, None]
        parts = chain.tip(chain.steps(dh, self._arm.joints, self._arm.dh_convention), q, list(tool))
        tips = np.empty((3, len(z), len(self.at)))
        for i, part in enumerate(parts):
            tips[i] = part
        for k, shift_m in self._bending:
            tips += z[:, k, None] * shift_m.T[:, None, :]
        return tips

    def slopes(self, z: Array) -> Array:
        """Derivatives of the tips by z at one arm z (k,): (3, m, k)."""
        q = self.at.q_rad.copy()
        for k, j, column in self._turning:
            q[:, j] += z[k] * column
        end = self._dh_count
        dh, tool = self._arm.dh + z[:end].reshape(-1, 4), self._model.nominal_tool_m + z[end : end + 3]
        slopes = self._model.slopes(dh, q, tool)
        whole = np.zeros((len(q), 3, len(z)))
        whole[:, :, :end], whole[:, :, end : end + 3] = slopes.by_dh, slopes.by_tool
        for k, j, column in self._turning:
            whole[:, :, k] = slopes.by_dh[:, :, self._model.theta_places[j]] * column[:, None]
        for k, shift_m in self._bending:
            whole[:, :, k] = shift_m
        return np.ascontiguousarray(whole.transpose(1, 0, 2))

    def loose_rad(self, z: Array, places: Array) -> Array:
        """Angles of joints by gears at `places` (n, arms, m; -1 .. 1) of their play, where nothing presses them to a flank."""
        turned = np.zeros(places.shape)
        for k, j in self._plays:
            is_loose = self._flank[:, j] == 0.0
            if is_loose.any():
                turned[j] = 0.5 * z[:, k, None] * places[j] * is_loose
        return turned

    def _column(self, term: MakingTerm) -> Array:
        j = term.number - 1
        q = self.at.q_rad[:, j]
        if term.kind == "play":
            return np.asarray(backlash_rad(self._flank[:, j], 1.0))
        if term.kind == "compliance":
            return np.asarray(compliance_rad(self._gravity_Nm[:, j], 1.0))
        if term.kind == "scale":
            return q
        wave = np.sin if term.kind == "sine" else np.cos
        return np.asarray(wave(term.waves * q))


def _gears(arm: Arm, terms: tuple[MakingTerm, ...], at: Conditions) -> tuple[Array, Array]:
    """Flanks (0: nothing presses the gear) and gravity torques, (m, n) each."""
    if not any(one.kind in BY_MASSES for one in terms):
        return np.zeros(at.q_rad.shape), np.zeros(at.q_rad.shape)
    state = resting(arm, at.q_rad, at.direction, None, at.payload_kg)
    return state.flank, state.gravity_Nm


STEPS: Final = "encoder steps"
# Key of tolerances.toml, term, whether the term is its inverse; and the effect of arm.toml that is the same, with its parameter.
LAWS: Final[tuple[tuple[str, Kind, bool, str, str], ...]] = (
    ("encoder_scale", "scale", False, "encoder_scale", "scale"),
    ("backlash_rad", "play", False, "backlash", "width_rad"),
    ("stiffness_Nm_rad", "compliance", True, "joint_compliance", "stiffness_Nm_rad"),
    ("EI_Nm2", "bending", True, "link_flexure", "EI_Nm2"),
)
GEOMETRY: Final = ("d_m", "theta_rad", "L_m", "alpha_rad")
TOOL: Final = ("x_m", "y_m", "z_m")


@dataclass(frozen=True, slots=True)
class Factor:
    """One tolerance of one part, and the places in z that it sets: two, sine and cosine, for an eccentricity.

    is_deviation: added to what arm.toml says; else it is the part's value itself.
    """

    name: str
    spread: Spread
    places: tuple[int, ...]
    is_deviation: bool = False
    is_inverse: bool = False


class MadeArms:
    """The arms that a design and its tolerances allow, as vectors z of terms (`the terms below`)."""

    def __init__(self, arm: Arm, tolerances: Tolerances) -> None:
        """Links that are too short to bend have no bending."""
        self.arm = arm
        self._first = 4 * len(arm.links) + 3
        self._places: dict[MakingTerm, int] = {}
        self.factors = (*self._link_factors(tolerances), *self._joint_factors(tolerances))
        self.file_z = self._of_file()

    @property
    def terms(self) -> tuple[MakingTerm, ...]:
        """Beyond geometry and tool, in the order of z."""
        return tuple(self._places)

    @property
    def correctable(self) -> list[int]:
        """Places in z that a gap correction can hold: not waves that are no eccentricity of the joint."""
        return [place for term, place in self._places.items() if term.waves == 1.0]

    def drawn(self, rng: np.random.Generator, count: int, exact: str = "") -> Array:
        """Arms (count, k); the factor named `exact` is as arm.toml says. The others are the same whatever is exact."""
        z = np.tile(self.file_z, (count, 1))
        z[:, [place for factor in self.factors if not factor.is_deviation for place in factor.places]] = 0.0
        for factor in self.factors:
            values = self._values(factor, rng, count)
            if factor.name == exact:
                values = np.zeros_like(values) if factor.is_deviation else self.file_z[list(factor.places)]
            z[:, list(factor.places)] += values
        return z

    def scatter_rad(self, rng: np.random.Generator, poses: MadePoses, z: Array, exact: str = "") -> Array:
        """What joints (n, arms, m) are off by in one visit: gears loose in their play, encoder steps."""
        shape = (self.arm.joint_count, len(z), len(poses.at))
        turned = poses.loose_rad(z, rng.uniform(-1.0, 1.0, shape))
        steps = rng.uniform(-0.5, 0.5, shape) * encoder_steps_rad(self.arm)[:, None, None]
        return turned if exact == STEPS else turned + steps

    def _values(self, factor: Factor, rng: np.random.Generator, count: int) -> Array:
        """What it adds to its places, (count, places)."""
        values = factor.spread.draw(rng, count)
        if len(factor.places) == 1:
            return (1.0 / values if factor.is_inverse else values)[:, None]
        phase = rng.uniform(0.0, 2.0 * math.pi, count)
        return np.column_stack((values * np.cos(phase), values * np.sin(phase)))

    def _place(self, term: MakingTerm) -> int:
        return self._places.setdefault(term, self._first + len(self._places))

    def _link_factors(self, tolerances: Tolerances) -> Iterator[Factor]:
        bend = beams(self.arm)
        for number in range(1, len(self.arm.links) + 1):
            for key, spread in spreads(tolerances.of_link(number)):
                if key in GEOMETRY:
                    place = 4 * (number - 1) + GEOMETRY.index(key)
                    yield Factor(f"link {number}: {_words(key)}", spread, (place,), is_deviation=True)
                elif number in bend:
                    places = (self._place(MakingTerm("bending", number)),)
                    yield Factor(f"link {number}: bending", spread, places, is_inverse=True)
        for key, spread in spreads(tolerances.tool):
            place = self._first - 3 + TOOL.index(key)
            yield Factor(f"tool: {_words(key)}", spread, (place,), is_deviation=True)

    def _joint_factors(self, tolerances: Tolerances) -> Iterator[Factor]:
        thetas = ArmModel(self.arm).theta_places
        laws = {key: (kind, is_inverse) for key, kind, is_inverse, *_ in LAWS}
        for number in range(1, self.arm.joint_count + 1):
            table = tolerances.of_joint(number)
            for key, spread in spreads(table):
                if key in OF_TRANSMISSION and not self.arm.is_behind_encoder("backlash", number):
                    continue  # its encoder, on the joint, sees what the gear does
                name = f"joint {number}: {_words(key)}"
                if key == "encoder_zero_rad":
                    yield Factor(name, spread, (thetas[number - 1],), is_deviation=True)
                elif key in laws:
                    kind, is_inverse = laws[key]
                    yield Factor(name, spread, (self._place(MakingTerm(kind, number)),), is_inverse=is_inverse)
                else:
                    yield Factor(name, spread, self._wave(number, _waves(key, table)))

    def _wave(self, number: int, waves: float) -> tuple[int, ...]:
        kinds: tuple[Kind, ...] = ("sine", "cosine")
        return tuple(self._place(MakingTerm(kind, number, waves)) for kind in kinds)

    def _of_file(self) -> Array:
        """Z of arm.toml: no deviation, and its effects where a tolerance says how the part is made."""
        z = np.zeros(self._first + len(self._places))
        for effect in self.arm.effects:
            number, values = effect.joint or 0, effect.parameters
            for _, kind, is_inverse, name, parameter in LAWS:
                place = self._places.get(MakingTerm(kind, number))
                if effect.effect == name and place is not None:
                    z[place] = 1.0 / values[parameter] if is_inverse else values[parameter]
            sine, cosine = (self._places.get(MakingTerm(kind, number)) for kind in ("sine", "cosine"))
            if effect.effect == "encoder_eccentricity" and sine is not None and cosine is not None:
                z[sine] = values["amplitude_rad"] * math.cos(values["phase_rad"])
                z[cosine] = values["amplitude_rad"] * math.sin(values["phase_rad"])
        return z


def _waves(key: str, table: JointTolerances) -> float:
    return (table.gear_waves_per_turn or 1.0) if key == "gear_eccentricity_rad" else 1.0


def _words(key: str) -> str:
    """encoder_zero_rad: encoder zero."""
    quantity, _, unit = key.rpartition("_")
    return (quantity if unit in ("m", "rad", "Nm2") else key).removesuffix("_Nm").replace("_", " ")
