"""`armwright arm` checks and summarises an arm.toml; `armwright export-arm` converts it to other formats."""

import argparse
import json
import math
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from console.commands.progress import answer, say
from control.errors import ArmError
from control.model.arm import Arm
from control.model.description import load_arm, save_arm
from control.model.effects import place_of
from control.plain_text import aligned
from procedures.arm_sheet import missing, sheet, sheet_lines, warnings

LEROBOT, PYTHON = "lerobot", "python"


def run(args: argparse.Namespace) -> int:
    """Print a summary of the file, or the keys that it may have; write it in another format, or write one from another format."""
    if args.command == "arm" and args.keys is not None:
        return _keys(args.keys)
    if args.command == "arm" and (args.from_urdf or args.from_mjcf):
        return _imported(args)
    arm = load_arm(args.arm)
    if args.command == "export-arm":
        own = {LEROBOT: _given_back, PYTHON: _compensation}
        if args.served and args.export in own:
            raise ArmError(f"--served: expected --export urdf, mjcf or json, got {args.export}, which `serve` has no need of")
        return own[args.export](arm, args) if args.export in own else _export(arm, args)
    if args.lerobot:
        return _taken_over(arm, args)
    figures, absent = sheet(arm), missing(arm)
    content = {"figures": figures, "warnings": list(warnings(figures)), "missing": absent}
    answer(args, summary(arm) | content, "\n".join([described(arm), *sheet_lines(arm, figures, absent)]))
    return 0


def _keys(name: str) -> int:
    """Print the keys of an arm.toml, or of another file."""
    from calib.tolerances.making import TolerancesFile
    from control.model.cell import CellFile
    from control.model.reference import FileSection, Key, reference_text, sections
    from control.recording.mcap_schemas import TOPICS
    from hil_mocks.faults import fault_sections
    from hil_mocks.scenario import Scenario

    def scenario() -> list[FileSection]:
        return [*sections(Scenario), *fault_sections()]

    def columns() -> list[FileSection]:
        return [
            FileSection(topic, "", tuple(Key(field.column.format(1), field.unit, "", field.meaning) for field in fields))
            for topic, fields in TOPICS.items()
        ]

    others: dict[str, Callable[[], Sequence[FileSection]]] = {
        "cell": partial(sections, CellFile),
        "scenario": scenario,
        "tolerances.toml": partial(sections, TolerancesFile),
        "armlog": columns,
    }
    sys.stdout.write(reference_text(name, others))
    return 0


def _imported(args: argparse.Namespace) -> int:
    """An arm.toml from a model, with a default for all that the model does not hold."""
    from console.commands import new

    if not args.out:
        raise ArmError("--out: expected the arm.toml to write, got nothing")
    return new.run(argparse.Namespace(**{**vars(args), "yes": True, "name": None, "like": None}))


def _taken_over(arm: Arm, args: argparse.Namespace) -> int:
    """The arm with the zeros and ranges of LeRobot's calibration, as a new file."""
    from calib.arm_import.lerobot import read_calibration, taken_over

    if not args.out:
        raise ArmError("--out: expected the arm.toml to write, got nothing")
    changed, notes = taken_over(arm, read_calibration(Path(args.lerobot)))
    save_arm(changed, Path(args.out))
    return _told(f"{args.out}: arm {arm.name} with the zeros and ranges of {args.lerobot}", notes)


def _given_back(arm: Arm, args: argparse.Namespace) -> int:
    """LeRobot's calibration with the zeros with which its model comes nearest to this arm."""
    from calib.arm_import.lerobot import given_back, read_calibration
    from calib.export import write_new
    from calib.export.rigid import nearest_zeros

    if not args.lerobot:
        raise ArmError("--export lerobot: give the arm's present calibration with --lerobot: offsets and ids are kept")
    generic = load_arm(args.generic) if args.generic else arm
    calibration, rigid = read_calibration(Path(args.lerobot)), nearest_zeros(arm, generic)
    motors, notes = given_back(rigid.arm, calibration, generic)
    write_new(Path(args.out), f"{json.dumps(msgspec.to_builtins(motors), indent=4)}\n")
    return _told(f"{args.out}: arm {arm.name}, as LeRobot's calibration", (*notes, *rigid.notes))


def _compensation(arm: Arm, args: argparse.Namespace) -> int:
    """The function that makes a program that knows the published arm go where it wants."""
    from calib.export import write_new
    from calib.export.formats import CORRECTED, omitted, python_text
    from calib.export.rigid import nearest_rigid

    if not args.generic:
        raise ArmError("--export python: give the arm that the program plans with, such as --generic so101")
    published, rigid = load_arm(args.generic), nearest_rigid(arm, known=CORRECTED)
    write_new(Path(args.out), python_text(rigid.arm, published))
    notes = (*omitted(arm, published), *rigid.notes)
    return _told(f"{args.out}: arm {arm.name}, for programs that plan with {args.generic}", notes)


def _told(what: str, notes: Sequence[str]) -> int:
    say("\n  ".join((what, *notes)))
    return 0


def _export(arm: Arm, args: argparse.Namespace) -> int:
    """URDF, MJCF or JSON; prints what the format cannot represent."""
    from calib.export import export

    written = f"{args.out}: arm {arm.name}, {arm.joint_count} joints, as {args.export}"
    return _told(written, export(arm, args.export, Path(args.out), args.served))


def summary(arm: Arm) -> dict[str, Any]:
    """What the file holds, for programs."""
    return {
        "name": arm.name,
        "path": str(arm.path),
        "joints": arm.joint_count,
        "dh_convention": arm.dh_convention,
        "dh": arm.dh.tolist(),
        "drives": len(arm.drives),
        "table": arm.table is not None,
        "effects": [[effect.effect, effect.joint, dict(effect.parameters)] for effect in arm.effects],
        "calibrated_from": arm.calibration.source if arm.calibration else None,
    }


def described(arm: Arm) -> str:
    """Summary of the arm for people."""
    rows = [("link", "joint", "d [mm]", "theta [deg]", "L [mm]", "alpha [deg]")]
    for number, link in enumerate(arm.links, start=1):
        theta_deg, alpha_deg = math.degrees(link.theta_rad), math.degrees(link.alpha_rad)
        figures = (f"{1e3 * link.d_m:.3f}", f"{theta_deg:.4f}", f"{1e3 * link.L_m:.3f}", f"{alpha_deg:.4f}")
        rows.append((str(number), link.joint, *figures))
    drives = f"{arm.joint_count} joints, {len(arm.drives)} drives, {arm.dh_convention} DH"
    lines = [f"arm {arm.name} ({arm.path}): {drives}", aligned(rows, left=2)]
    for effect in arm.effects:
        where = "" if effect.joint is None else f" of {place_of(effect.effect)} {effect.joint}"
        values = ", ".join(f"{name} {value:.4g}" for name, value in effect.parameters.items())
        lines.append(f"effect {effect.effect}{where}: {values}")
    if arm.calibration:
        lines.append(f"calibrated from {arm.calibration.source} on {arm.calibration.date} ({arm.calibration.objective})")
    return "\n".join(lines)
