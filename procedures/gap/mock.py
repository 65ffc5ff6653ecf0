"""The recordings on a mock arm in this process, on the stepped clock."""

from pathlib import Path

from calib.gap.plan.plan import RecordingPlan
from control.model.arm import Arm
from control.progress import Advance
from procedures.gap.recording import Bench, note_plan, record
from procedures.mock import saved_mock


def record_on_mock(
    arm: Arm, scenario: str, seed: int | None, plan: RecordingPlan, out: Path, advance: Advance
) -> None:
    """Home a mock of `arm` and record; its scenario is saved in `out`, the runtime's recordings in `out`/log."""
    note_plan(out, plan, arm)
    advance("homing", 0.0)
    with saved_mock(arm, scenario, seed, out) as (bench, client, recording):
        record(Bench(arm, client, recording, bench.rig.set_payload), plan, out, advance)
