"""The test programmes on a mock arm in this process, on the stepped clock."""

from pathlib import Path

from control.model.arm import Arm
from control.progress import Advance
from procedures.iso9283.recording import Bench, Planned, record
from procedures.mock.saved_mock import saved_mock


def record_on_mock(
    arm: Arm, scenario: str, seed: int | None, planned: Planned, out: Path, speed: float, advance: Advance
) -> None:
    """Home a mock of `arm` and run the plan; its scenario is saved in `out`, its recordings in `out`/log."""
    advance("homing", 0.0)
    with saved_mock(arm, scenario, seed, out, speed) as (bench, client, recording):
        record(Bench(arm, client, recording, bench.rig.set_payload, speed), planned, out, advance)
