"""A mock arm in this process whose scenario is saved beside its recordings, so that a recording can be resumed."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from calib.errors import CalibrationError
from control.files import write_whole
from control.model.arm import Arm
from control.server.client import ArmClient
from procedures.folders import free_folder
from procedures.mock.bench import SteppedBench
from procedures.mock.scenario_file import seeded_scenario


@contextmanager
def saved_mock(
    arm: Arm, scenario: str, seed: int | None, out: Path, speed: float = 1.0
) -> Iterator[tuple[SteppedBench, ArmClient, Path]]:
    """A mock of `arm`, homed and holding: its bench, its client, the runtime's recording. Shut down on exit.

    scenario.toml and the recordings in log are saved in `out`. CalibrationError if it holds another scenario.
    """
    drawn = seeded_scenario(scenario, seed, was_homed=not arm.can_home)
    out.mkdir(parents=True, exist_ok=True)
    file = out / "scenario.toml"
    if file.exists() and file.read_bytes() != drawn:
        raise CalibrationError(
            f"{file}: contains the records of another mock arm: choose another folder with --out"
        )
    write_whole(file, drawn)
    log = free_folder(out / "log")
    bench = SteppedBench(arm, file, log)
    try:
        client = bench.start(arm)
        client.enable()
        client.home()
        yield bench, client, next(log.glob("*.armlog"))
        if arm.rest is not None:
            client.move_joints(arm.rest.q_rad, speed)
        bench.stop()
    finally:
        bench.close()
