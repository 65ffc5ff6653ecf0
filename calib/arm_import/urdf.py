"""Reads URDF (wiki.ros.org/urdf/XML): links, joints, limits, masses.

An angle such as 1.5708 is read as the quarter turn of which it is a rounding: DH rows with exactly perpendicular or parallel
axes are what the arm has, and closed forms of its inverse kinematics exist for them only.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final

import numpy as np

from calib.arm_import.safe_xml import Element, read_xml
from calib.arm_import.serial_arm import Kind, Mass, Tree, TreeJoint, TreeLink, possible_inertia
from calib.arrays import Array
from calib.errors import ImportedModelError
from control.model.rules import ANGLE, LENGTH, LIMIT, Rule

KINDS: Final[dict[str, Kind]] = {
    "revolute": "revolute",
    "continuous": "revolute",
    "prismatic": "prismatic",
    "fixed": "fixed",
    "floating": "other",
    "planar": "other",
}
MOST_LINKS: Final = 1000
ROUNDED_INERTIA: Final = 1e-3  # of the largest moment: what printing with few digits does
GRAVITY: Final = (0.0, 0.0, -9.81)  # a URDF has none; z of its root points up by convention (REP 103)
WORTH_SAYING_rad: Final = 1e-9  # below it nobody rounded but the computer that wrote the file
QUARTER_DIGITS, EIGHTH_DIGITS = 2, 4  # decimals from which 1.57 is a quarter turn, 0.7854 an eighth


def read_urdf(path: Path) -> Tree:
    """The tree of a URDF file; ImportedModelError names file, line and element."""
    return _Urdf(path).tree()


class _Urdf:
    """One file while it is read."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._rounded: set[str] = set()
        self._notes: list[str] = []

    def tree(self) -> Tree:
        root = read_xml(self._path, "URDF")
        self._require_plain(root)
        links = self._links(root)
        joints = self._joints(root, links)
        order = self._from_the_root(links, joints)
        tree_links = {
            name: TreeLink(
                name,
                joints[name][0] if name in joints else "",
                joints[name][1] if name in joints else np.eye(4),
                joints[name][2] if name in joints else None,
                self._mass(links[name]),
            )
            for name in order
        }
        notes = [*self._notes, f"a URDF has no gravity: {list(GRAVITY)} m/s^2 in the frame of link {order[0]}"]
        if self._rounded:
            few = ", ".join(sorted(self._rounded)[:3])
            notes.append(f"angles such as {few} were read as the parts of a turn of which they are roundings")
        return Tree(root.attributes.get("name", "arm"), str(self._path), tree_links, GRAVITY, tuple(notes))

    def _error(self, element: Element, what: str) -> ImportedModelError:
        return ImportedModelError(f"{self._path}, line {element.line}: {what}")

    def _require_plain(self, root: Element) -> None:
        for element in root.walk():
            macros = [v for v in element.attributes.values() if "${" in v or "$(" in v]
            if element.tag.startswith("xacro:") or macros:
                raise self._error(element, f"this is xacro, not URDF: run `xacro {self._path.name} > robot.urdf` first")
        if root.tag != "robot":
            hint = "; use --from-mjcf" if root.tag == "mujoco" else ""
            raise self._error(root, f"expected <robot>, got <{root.tag}>{hint}")

    def _links(self, root: Element) -> dict[str, Element]:
        links: dict[str, Element] = {}
        for element in root.all("link"):
            name = self._name(element)
            if name in links:
                raise self._error(element, f"a second link {name}")
            links[name] = element
        if not links:
            raise self._error(root, "expected at least one <link>")
        if len(links) > MOST_LINKS:
            raise self._error(root, f"more than {MOST_LINKS} links")
        return links

    def _joints(self, root: Element, links: dict[str, Element]) -> dict[str, tuple[str, Array, TreeJoint | None]]:
        """By child: its parent, its pose there, and the joint."""
        joints: dict[str, tuple[str, Array, TreeJoint | None]] = {}
        for element in root.all("joint"):
            name = self._name(element)
            parent, child = (self._end(element, name, which, links) for which in ("parent", "child"))
            if child in joints:
                raise self._error(element, f"joint {name}: link {child} has a second parent")
            joints[child] = (parent, self._pose(element), self._joint(element, name))
        return joints

    def _end(self, joint: Element, name: str, which: str, links: dict[str, Element]) -> str:
        element = joint.first(which)
        link = element.attributes.get("link", "") if element else ""
        if link not in links:
            raise self._error(joint, f"joint {name}: expected <{which} link=...> that names a link, got {link!r}")
        return link

    def _from_the_root(self, links: dict[str, Element], joints: dict[str, tuple[str, Array, TreeJoint | None]]) -> list[str]:
        roots = [name for name in links if name not in joints]
        if len(roots) != 1:
            got = "none: the joints form a loop" if not roots else ", ".join(roots[:6])
            raise ImportedModelError(f"{self._path}: expected one link without a parent, got {got}")
        behind: dict[str, list[str]] = {}
        for child, (parent, _, _) in joints.items():
            behind.setdefault(parent, []).append(child)
        order, at = roots, 0
        while at < len(order):
            order += behind.get(order[at], [])
            at += 1
        if len(order) != len(links):
            lost = ", ".join(sorted(set(links) - set(order))[:6])
            raise ImportedModelError(f"{self._path}: links that hang on each other and not on {roots[0]}: {lost}")
        return order

    def _joint(self, element: Element, name: str) -> TreeJoint | None:
        word = element.attributes.get("type", "")
        if word not in KINDS:
            raise self._error(element, f"joint {name}: expected type {', '.join(KINDS)}, got {word!r}")
        if KINDS[word] == "fixed":
            return None
        given = element.first("axis")
        axis = self._vector(given, "xyz", (1.0, 0.0, 0.0)) if given else np.array([1.0, 0.0, 0.0])
        length = float(np.linalg.norm(axis))
        if length == 0.0:
            raise self._error(element, f"joint {name}: expected an axis, got 0 0 0")
        limit, dynamics = element.first("limit"), element.first("dynamics")
        mimic = element.first("mimic")
        lower, upper = self._range(element, limit, word, name)
        return TreeJoint(
            name=name,
            kind=KINDS[word],
            word=word,
            axis=axis / length,
            anchor_m=np.zeros(3),
            lower_rad=lower,
            upper_rad=upper,
            torque_Nm=self._positive(limit, "effort"),
            speed_rad_s=self._positive(limit, "velocity"),
            viscous_Nm_s_rad=self._number(dynamics, "damping", 0.0),
            coulomb_Nm=self._number(dynamics, "friction", 0.0),
            follows=mimic.attributes.get("joint", "another") if mimic else "",
            lacks_limits=word == "revolute" and not math.isfinite(lower),
            where=f"line {(limit or element).line}, joint {name}",
        )

    def _range(self, joint: Element, limit: Element | None, word: str, name: str) -> tuple[float, float]:
        """Both ends; none for a continuous joint, and where the file gives none or no width."""
        if word == "continuous" or limit is None or not {"lower", "upper"} & set(limit.attributes):
            return -math.inf, math.inf
        is_angle = word == "revolute"
        lower, upper = (self._number(limit, end, 0.0, LIMIT if is_angle else None) for end in ("lower", "upper"))
        if lower > upper:
            raise self._error(joint, f"joint {name}: lower limit {lower:g} is above upper limit {upper:g}")
        return (lower, upper) if lower < upper else (-math.inf, math.inf)

    def _mass(self, link: Element) -> Mass | None:
        inertial = link.first("inertial")
        weighed = inertial.first("mass") if inertial else None
        mass = self._number(weighed, "value", 0.0)
        if inertial is None or weighed is None or mass <= 0.0:
            return None
        tensor = inertial.first("inertia")
        xx, yy, zz, xy, xz, yz = (self._number(tensor, key, 0.0) for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"))
        inertia, name = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), link.attributes["name"]
        possible = possible_inertia(inertia)
        if np.abs(possible - inertia).max() > ROUNDED_INERTIA * np.abs(inertia).max():
            line, moments = (tensor or inertial).line, ", ".join(f"{k:.3g}" for k in np.linalg.eigvalsh(inertia))
            nearest = ", ".join(f"{k:.3g}" for k in np.linalg.eigvalsh(possible))
            self._notes.append(
                f"{self._path}, line {line}, link {name}: no body has the moments {moments} kg m^2, since each is at most the sum"
                f" of the others: the nearest possible ones were taken ({nearest})"
            )
        where = f"line {weighed.line}, link {name}"
        return Mass(mass, np.zeros(3), possible, where).seen_from(self._pose(inertial))

    def _pose(self, element: Element) -> Array:
        origin = element.first("origin")
        pose = np.eye(4)
        if origin is not None:
            pose[:3, 3] = self._vector(origin, "xyz", (0.0, 0.0, 0.0), LENGTH)
            pose[:3, :3] = _rotation(*self._angles(origin))
        return pose

    def _angles(self, origin: Element) -> list[float]:
        texts = origin.attributes.get("rpy", "0 0 0").split()
        values = self._vector(origin, "rpy", (0.0, 0.0, 0.0), ANGLE).tolist()
        angles = []
        for text, value in zip(texts, values, strict=True):
            exact = unrounded(text, value)
            if abs(exact - value) > WORTH_SAYING_rad:
                self._rounded.add(text)
            angles.append(exact)
        return angles

    def _vector(self, element: Element, key: str, default: tuple[float, float, float], rule: Rule | None = None) -> Array:
        if key not in element.attributes:
            return np.array(default)
        parts = element.attributes[key].split()
        if len(parts) != 3:
            raise self._error(element, f"<{element.tag}> {key}: expected 3 numbers, got {len(parts)}")
        return np.array([self._finite(element, key, part, rule) for part in parts])

    def _name(self, element: Element) -> str:
        if not element.attributes.get("name"):
            raise self._error(element, f"a {element.tag} without name")
        return element.attributes["name"]

    def _number(self, element: Element | None, key: str, default: float, rule: Rule | None = None) -> float:
        if element is None or key not in element.attributes:
            return default
        return self._finite(element, key, element.attributes[key], rule)

    def _positive(self, element: Element | None, key: str) -> float:
        """Infinite where it is absent or 0, which files write for unknown."""
        value = self._number(element, key, math.inf) if element else math.inf
        return value if value > 0.0 else math.inf

    def _finite(self, element: Element, key: str, text: str, rule: Rule | None = None) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            remedy = " (decimals have a point, and spaces part the numbers)" if "," in text else ""
            raise self._error(element, f"<{element.tag}> {key}: expected a finite number, got {text[:40]!r}{remedy}")
        if rule is not None and not rule.holds(value):
            raise self._error(element, f"<{element.tag}> {key}: expected {rule.expected}, got {text[:40]} ({rule.remedy(value)})")
        return value


def unrounded(text: str, value: float) -> float:
    """The multiple of a quarter turn (or of an eighth) of which a decimal number is a rounding; else the number."""
    decimals = len(text.partition(".")[2]) if "e" not in text.lower() else 0
    for part, least in ((0.5 * math.pi, QUARTER_DIGITS), (0.25 * math.pi, EIGHTH_DIGITS)):
        exact = part * round(value / part)
        if exact != 0.0 and decimals >= least and abs(value - exact) <= 10.0**-decimals:
            return exact
    return value


def _rotation(roll: float, pitch: float, yaw: float) -> Array:
    """Fixed-axis angles: Rz(yaw) Ry(pitch) Rx(roll)."""
    (cr, cp, cy), (sr, sp, sy) = (
        [_exact(math.cos(a)) for a in (roll, pitch, yaw)],
        [_exact(math.sin(a)) for a in (roll, pitch, yaw)],
    )
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def _exact(value: float) -> float:
    """The cosine of a right angle is 0, not 6e-17."""
    return 0.0 if abs(value) < 1e-16 else value
