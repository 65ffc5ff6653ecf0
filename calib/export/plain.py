"""Plain JSON: the DH table, its transforms, and everything in arm.toml."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from control.kinematics.chain import link_transforms, tips
from control.model.arm import Arm

FORMAT = "armwright-arm/1"
CONVENTIONS = {
    "standard": "parent_T_link = Tz(d) Rz(theta + q) Tx(L) Rx(alpha)",
    "modified": "parent_T_link = Rx(alpha) Tx(L) Rz(theta + q) Tz(d)",
}


def plain_text(arm: Arm) -> str:
    """The arm as JSON. SI units, radians; null for an infinite limit or an unknown mass."""
    content = {
        "format": FORMAT,
        "name": arm.name,
        "units": "SI, radians; a key ends in its unit",
        "dh_convention": arm.dh_convention,
        "chain": f"{CONVENTIONS[arm.dh_convention]}; base_T_tip = product of all, then the tool's position",
        "joints": arm.joint_count,
        "dh": _rows(arm),
        "tool_m": list(arm.tool.position_m),
        "at_zero": _at_zero(arm),
        "arm": _plain(arm),
    }
    return json.dumps(content, indent=2, allow_nan=False) + "\n"


def _rows(arm: Arm) -> list[dict[str, object]]:
    """The DH table, one object per link; `joint` (1-based) adds its angle to theta, null if the link is fixed."""
    rows: list[dict[str, object]] = []
    joint = 0
    for link in arm.links:
        joint += link.joint == "revolute"
        rows.append(
            {
                "joint": joint if link.joint == "revolute" else None,
                "d_m": link.d_m,
                "theta_rad": link.theta_rad,
                "L_m": link.L_m,
                "alpha_rad": link.alpha_rad,
            }
        )
    return rows


def _at_zero(arm: Arm) -> dict[str, object]:
    """Transforms at joint angles 0, for checking a reader."""
    q = np.zeros((1, arm.joint_count))
    frames = link_transforms(arm.dh, q, arm.joints, arm.dh_convention)[0]
    tip = tips(arm.dh, q, arm.joints, arm.dh_convention, arm.tool.position_m)[0]
    return {"base_T_link": [frame.tolist() for frame in frames[1:]], "tip_m": tip.tolist()}


def _plain(value: object) -> Any:
    """Dataclasses as objects with the keys of arm.toml; numbers that JSON cannot represent are null."""
    if dataclasses.is_dataclass(value):
        fields = [f for f in dataclasses.fields(value) if f.metadata.get("key") != ""]
        return {f.metadata.get("key", f.name): _plain(getattr(value, f.name)) for f in fields}
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
