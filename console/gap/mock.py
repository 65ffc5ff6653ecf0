"""The recordings on a mock arm in this process, on the stepped clock."""

from pathlib import Path

from calib.errors import CalibrationError
from calib.gap.plan.plan import RecordingPlan
from console.demo.bench import SteppedBench
from console.folders import free_folder
from console.gap.recording import Advance, Bench, note_plan, record
from console.scenario_file import seeded_scenario
from control.model.arm import Arm


def record_on_mock(
    arm: Arm, scenario: str, seed: int | None, plan: RecordingPlan, out: Path, advance: Advance
) -> None:
    """Home a mock of `arm` and record; its scenario is kept in `out`, the runtime's recordings in `out`/log."""
    can_home = all(drive.home is not None for drive in arm.drives)
    drawn = seeded_scenario(scenario, seed, was_homed=not can_home)
    note_plan(out, plan, arm)
    kept = out / "scenario.toml"
    if kept.exists() and kept.read_bytes() != drawn:
        raise CalibrationError(
            f"{kept}: the records here are of another mock arm: choose another folder with --out"
        )
    kept.write_bytes(drawn)
    log = free_folder(out / "log")
    bench = SteppedBench(arm, kept, log)
    try:
        advance("homing", 0.0)
        client = bench.start(arm)
        client.enable()
        client.home()
        recording = next(log.glob("*.armlog"))
        record(Bench(arm, client, recording, bench.rig.set_payload), plan, out, advance)
        if arm.rest is not None:
            client.move_joints(arm.rest.q_rad)
        bench.stop()
    finally:
        bench.close()
