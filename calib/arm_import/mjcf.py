"""Reads MJCF through MuJoCo itself: defaults, included files and inertia from shapes come out as MuJoCo has them.

Before MuJoCo sees a file, every file that it includes is read as XML without entities and within bounds. Meshes that are not
there are left out; the bodies that they would have weighed get no mass then.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np

from calib.arm_import.safe_xml import Element, read_xml
from calib.arm_import.serial_arm import Kind, Mass, Tree, TreeJoint, TreeLink
from calib.arrays import Array
from calib.errors import ImportedModelError

MOST_FILES: Final = 50
REPEATING: Final = ("replicate", "composite", "flexcomp")  # these make as many bodies as they are told to
UNKNOWN_KG: Final = 1.1e-6  # as much stands for an unknown mass: MuJoCo refuses none (docs/export.md)
_SHAPES: Final = ("geoms", "meshes", "textures", "materials", "hfields", "skins")


def read_mjcf(path: Path) -> Tree:
    """The tree of an MJCF file; ImportedModelError names the file."""
    _require_bounded(path)
    model, notes = _compiled(path)
    names = [_name(model, mujoco.mjtObj.mjOBJ_BODY, i, "body") for i in range(model.nbody)]
    links: dict[str, TreeLink] = {names[0]: TreeLink(names[0], "", np.eye(4), None, None)}
    for body in range(1, model.nbody):
        for link in _links_of(model, body, names):
            links[link.name] = link
    gravity = model.opt.gravity.tolist()
    title = read_xml(path, "MJCF").attributes.get("model", path.stem)
    return Tree(title, str(path), links, (gravity[0], gravity[1], gravity[2]), tuple(notes))


def _require_bounded(path: Path) -> None:
    """Each file once: the given one and what it includes, from beside it."""
    waiting, seen = [path], set[Path]()
    while waiting:
        file = waiting.pop()
        if file in seen:
            continue
        seen.add(file)
        if len(seen) > MOST_FILES:
            raise ImportedModelError(f"{path}: includes more than {MOST_FILES} files")
        root = read_xml(file, "MJCF")
        if file == path and root.tag != "mujoco":
            hint = "; use --from-urdf" if root.tag == "robot" else ""
            raise ImportedModelError(f"{path}, line {root.line}: expected <mujoco>, got <{root.tag}>{hint}")
        for element in root.walk():
            _require_plain(file, element)
            if element.tag == "include":
                waiting.append(file.parent / element.attributes.get("file", ""))


def _require_plain(file: Path, element: Element) -> None:
    if element.tag in REPEATING:
        raise ImportedModelError(f"{file}, line {element.line}: <{element.tag}> is not read: no arm has it")


def _compiled(path: Path) -> tuple[Any, list[str]]:
    """MuJoCo's model, without shapes if their files are missing."""
    try:
        spec = _parsed(path)
    except (ValueError, OSError) as error:
        raise ImportedModelError(f"{path}: MuJoCo cannot read it: {_one_line(error)}") from None
    spec.compiler.boundmass = max(spec.compiler.boundmass, 1e-6)
    spec.compiler.boundinertia = max(spec.compiler.boundinertia, 1e-12)
    try:
        return spec.compile(), []
    except (ValueError, OSError) as error:
        first = _one_line(error)
    for kind in _SHAPES:
        for one in list(getattr(spec, kind, ())):
            spec.delete(one)
    try:
        model = spec.compile()
    except (ValueError, OSError):
        raise ImportedModelError(f"{path}: MuJoCo cannot read it: {first}") from None
    return model, [f"read without its shapes ({first}): masses are those of <inertial> only"]


def _parsed(path: Path) -> Any:
    """MuJoCo chooses its reader by the suffix and knows no other than .xml."""
    if path.suffix == ".xml":
        return mujoco.MjSpec.from_file(str(path))
    spec = mujoco.MjSpec.from_string(path.read_text(encoding="utf-8"))
    spec.modelfiledir = str(path.parent)
    return spec


def _links_of(model: Any, body: int, names: list[str]) -> list[TreeLink]:
    """A body as a link; with several joints, a link without mass for each but the last."""
    parent = names[int(model.body_parentid[body])]
    pose = np.eye(4)
    pose[:3, :3] = _matrix(model.body_quat[body])
    pose[:3, 3] = model.body_pos[body]
    first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
    joints = [_joint(model, first + k) for k in range(count)]
    links = []
    for k, joint in enumerate(joints[:-1]):
        name = f"{names[body]}/{k + 1}"
        links.append(TreeLink(name, parent, pose @ _back(model, first + k, joint), joint, None))
        parent, pose = name, np.eye(4)
    if joints:
        pose = pose @ _back(model, first + count - 1, joints[-1])
    links.append(TreeLink(names[body], parent, pose, joints[-1] if joints else None, _mass(model, body)))
    return links


def _joint(model: Any, index: int) -> TreeJoint:
    kinds: dict[int, tuple[Kind, str]] = {
        int(mujoco.mjtJoint.mjJNT_HINGE): ("revolute", "hinge"),
        int(mujoco.mjtJoint.mjJNT_SLIDE): ("prismatic", "slide"),
        int(mujoco.mjtJoint.mjJNT_BALL): ("other", "ball"),
        int(mujoco.mjtJoint.mjJNT_FREE): ("other", "free"),
    }
    kind, word = kinds[int(model.jnt_type[index])]
    dof = int(model.jnt_dofadr[index])
    limited = bool(model.jnt_limited[index]) and kind == "revolute"
    lower, upper = model.jnt_range[index].tolist() if limited else (-math.inf, math.inf)
    return TreeJoint(
        name=_name(model, mujoco.mjtObj.mjOBJ_JOINT, index, "joint"),
        kind=kind,
        word=word,
        axis=np.array(model.jnt_axis[index]),
        anchor_m=np.array(model.jnt_pos[index]),
        lower_rad=lower,
        upper_rad=upper,
        torque_Nm=_torque_Nm(model, index),
        viscous_Nm_s_rad=float(np.ravel(model.dof_damping[dof])[0]),
        coulomb_Nm=float(model.dof_frictionloss[dof]),
        rotor_kg_m2=float(model.dof_armature[dof]),
        follows=_leader(model, index),
    )


def _torque_Nm(model: Any, joint: int) -> float:
    """What a motor at this joint may give; infinite if nothing says."""
    if bool(model.jnt_actfrclimited[joint]):
        return float(np.max(np.abs(model.jnt_actfrcrange[joint])))
    for i in range(model.nu):
        is_here = model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT and model.actuator_trnid[i][0] == joint
        if not is_here:
            continue
        gear = abs(float(model.actuator_gear[i][0]))
        if model.actuator_forcelimited[i]:
            return gear * float(np.max(np.abs(model.actuator_forcerange[i])))
        is_motor = model.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_FIXED
        is_motor &= model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_NONE
        if is_motor and model.actuator_ctrllimited[i]:
            gain = abs(float(model.actuator_gainprm[i][0]))
            return gear * gain * float(np.max(np.abs(model.actuator_ctrlrange[i])))
    return math.inf


def _leader(model: Any, joint: int) -> str:
    """The joint that an equality ties this one to, "" if none."""
    for i in range(model.neq):
        if model.eq_type[i] == mujoco.mjtEq.mjEQ_JOINT and model.eq_obj1id[i] == joint:
            other = int(model.eq_obj2id[i])
            return _name(model, mujoco.mjtObj.mjOBJ_JOINT, other, "joint") if other >= 0 else "a constant"
    return ""


def _back(model: Any, index: int, joint: TreeJoint) -> Array:
    """A body's pose in the file is that at the joint's reference angle: turned back by it."""
    pose = np.eye(4)
    angle = float(model.qpos0[int(model.jnt_qposadr[index])]) if joint.kind == "revolute" else 0.0
    if angle == 0.0:
        return pose
    quaternion = np.zeros(4)
    mujoco.mju_axisAngle2Quat(quaternion, joint.axis, -angle)
    turn = _matrix(quaternion)
    pose[:3, :3] = turn
    pose[:3, 3] = joint.anchor_m - turn @ joint.anchor_m
    return pose


def _mass(model: Any, body: int) -> Mass | None:
    mass = float(model.body_mass[body])
    if mass <= UNKNOWN_KG:
        return None
    turn = _matrix(model.body_iquat[body])
    inertia = turn @ np.diag(model.body_inertia[body]) @ turn.T
    return Mass(mass, np.array(model.body_ipos[body]), inertia)


def _matrix(quaternion: Array) -> Array:
    nine = np.zeros(9)
    mujoco.mju_quat2Mat(nine, np.asarray(quaternion, dtype=np.float64))
    return nine.reshape(3, 3)


def _name(model: Any, kind: Any, index: int, word: str) -> str:
    return mujoco.mj_id2name(model, kind, index) or f"{word}{index}"


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:300]
