"""Maps on the mock arm: the tip's error with what has no name unknown, and with the map that `gap --map` measured of it.

The mock hides friction, which is known, and one effect that is taken off the list, so that it has no name. Poses are recorded as
`gap --record` does it. Then the tip comes to rest at points over the workspace and runs a circle, without and with the map.
Run with `python -m benchmarks.gap.maps` (ten minutes); docs/corrections.md has the table.
"""

import dataclasses
import tempfile
from pathlib import Path

import tomli_w

from benchmarks.calibration.corrections import FRICTION, RIGHT, Case, case, run_as
from calib.gap.plan.plan import PlanRequest, recording_plan
from calib.gap.workflow import find_gap_in, read_recordings
from control.model.arm import Arm
from control.progress import silent
from procedures.gap.recording import record_on_mock

UNLISTED = (
    case("encoder_eccentricity", 2, amplitude_rad=0.005, phase_rad=0.7),
    case("joint_compliance", 2, stiffness_Nm_rad=2500.0),
    case("backlash", 1, width_rad=0.005),
)


def mapped(one: Case, folder: Path) -> tuple[Arm, Arm]:
    """The arm without and with the map of the case's effect."""
    knowing = dataclasses.replace(RIGHT, effects=FRICTION)
    tables = [
        {"effect": e.effect, "joint": e.joint or 0, "parameters": dict(e.parameters)}
        for e in (*FRICTION, *one.effects)
    ]
    scenario = folder / "hidden.toml"
    scenario.write_text(tomli_w.dumps({"seed": 7, "effect": tables, "plant": {"arm_effects": False}}))
    plan = recording_plan(knowing, PlanRequest(True, False, 0.0, True, None), 1.0)
    record_on_mock(knowing, str(scenario), 3, plan, folder, silent)
    recordings = read_recordings(knowing, [folder / "points.csv"], [])
    found = find_gap_in(knowing, recordings, [e.effect for e in one.effects], with_maps=True)
    assert found.mapped is not None
    return dataclasses.replace(knowing, maps=()), found.mapped


def main() -> None:
    """Print the table."""
    print("| effect, not in the list | at rest: unknown | mapped | circle: unknown | mapped |")
    print("| --- | --- | --- | --- | --- |")
    for one in UNLISTED:
        with tempfile.TemporaryDirectory() as folder:
            errors = [run_as(arm, (*FRICTION, *one.effects)) for arm in mapped(one, Path(folder))]
        rest = " | ".join(f"{1e3 * e.rest_m:.3f} ({1e3 * e.rest_most_m:.3f})" for e in errors)
        path = " | ".join(f"{1e3 * e.path_m:.3f} ({1e3 * e.path_most_m:.3f})" for e in errors)
        print(f"| {one.name} | {rest} | {path} |", flush=True)


if __name__ == "__main__":
    main()
