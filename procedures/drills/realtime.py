"""Drills in real time: the loop's own process is killed or paused by a signal, mock arm and boards in another process."""

import os
import resource
import signal
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from control.errors import ArmError
from control.hardware.connect import connect
from control.kinematics.kinematics import ForwardKinematics
from control.model.description import load_arm
from control.recording.reading import RecordError, Recording
from control.server.channel import RuntimeGone
from control.server.client import ArmClient, RequestRefused
from firmware_iface.clock import MonotonicClock
from firmware_iface.errors import ConnectionFailed, PortInUse
from procedures.drills.promise import DrillOutcome, Promise, length_m, stood_s
from procedures.drills.stage import off_way_m
from procedures.mock import RealTimeBench, wired_to

FROM_rad, TO_rad = (-1.0, -0.6, 0.2), (1.2, -0.6, 0.2)
FAST_FROM_rad = -0.2  # joint 1 is at full speed from here on
LOOK_S = 0.005
SECTIONS = 500
WATCHED_S = 1.0
ARRIVES_S = 4.0
GONE = "runtime gone"


@dataclass(frozen=True, slots=True)
class RealTimeDrill(Promise):
    """The loop's process is paused for a while, or killed."""

    pause_s: float | None = None  # None: killed
    speed: float = 1.0  # of the limits

    def run(self) -> DrillOutcome:
        """Run it on a fresh mock arm."""
        with tempfile.TemporaryDirectory(prefix="armwright-drill-") as folder:
            scenario = Path(folder) / "scenario.toml"
            scenario.write_text(f'name = "drill"\n[start]\nq_rad = {list(FROM_rad)}\nhomed = true\n')
            bench = RealTimeBench("right", scenario, Path(folder) / "log")
            try:
                return self._played(bench)
            finally:
                bench.close()

    def _played(self, bench: RealTimeBench) -> DrillOutcome:
        arm = load_arm("right")
        client = bench.start(arm)
        client.enable()
        start = bench.rig.joint_rad()
        client.move_joints(TO_rad, self.speed, waits=False)
        end_s = time.monotonic() + ARRIVES_S
        while bench.rig.joint_rad()[0] < FAST_FROM_rad and time.monotonic() < end_s:
            time.sleep(LOOK_S)
        way, begun_s = [(time.monotonic(), bench.rig.tip_m())], time.monotonic()
        self._break(bench, client)
        found, message = self._found(client)
        noticed_s = time.monotonic() - begun_s
        while time.monotonic() - begun_s < (WATCHED_S if self.pause_s is None else ARRIVES_S):
            way.append((time.monotonic(), bench.rig.tip_m()))
            time.sleep(LOOK_S)
        if not found:
            found, message = self._found(client)
        tips = ForwardKinematics(arm)
        shares = [k / SECTIONS for k in range(SECTIONS + 1)]  # a joint move is a straight line of the joints
        asked = [
            tips.tip(*(a + share * (b - a) for a, b in zip(start, TO_rad, strict=True))) for share in shares
        ]
        return DrillOutcome(
            self,
            max(off_way_m(tip, asked) for _, tip in way[::4]) * 1e3,
            length_m(way) * 1e3,
            noticed_s if found else None,
            stood_s(way, way[0][0], looked=4),
            "the motion" if found else "nothing",
            (found,) if found else (),
            message,
            0.0,
            self._wrong_after(client),
        )

    def _wrong_after(self, client: ArmClient) -> str:
        """What is not as promised, as text."""
        return ""

    def _break(self, bench: RealTimeBench, client: ArmClient) -> None:
        if self.pause_s is None:
            os.kill(bench.runtime_pid, signal.SIGKILL)
            return
        os.kill(bench.runtime_pid, signal.SIGSTOP)
        time.sleep(self.pause_s)
        os.kill(bench.runtime_pid, signal.SIGCONT)

    @staticmethod
    def _found(client: ArmClient) -> tuple[str, str]:
        try:
            faults = client.status()["faults"]
        except (RuntimeGone, OSError) as gone:
            return GONE, str(gone)
        return (faults[0]["code"], faults[0]["message"]) if faults else ("", "")


@dataclass(frozen=True, slots=True)
class DiskDrill(RealTimeDrill):
    """The kernel refuses the recording's next byte: the motion ends by a controlled stop, and no other begins."""

    def _break(self, bench: RealTimeBench, client: ArmClient) -> None:
        path = Path(client.status()["recorder"]["file"])
        size = path.stat().st_size
        for writer in _descendants(bench.runtime_pid):
            resource.prlimit(writer, resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))

    def _wrong_after(self, client: ArmClient) -> str:
        if not client.status()["was_stopped"]:
            return "the motion was not stopped"
        try:
            client.move_joints(FROM_rad)
        except RequestRefused as refusal:
            return "" if "nothing is recorded" in str(refusal) else str(refusal)
        return "a motion began unrecorded"


@dataclass(frozen=True, slots=True)
class EmptiedDrill(RealTimeDrill):
    """Another program empties the recording: what is left and what follows can be read, and the loss is counted."""

    def _break(self, bench: RealTimeBench, client: ArmClient) -> None:
        end_s = time.monotonic() + ARRIVES_S
        while not (recorder := client.status()["recorder"])["written_bytes"] and time.monotonic() < end_s:
            time.sleep(LOOK_S)  # until the writer has begun
        os.truncate(recorder["file"], 0)

    def _wrong_after(self, client: ArmClient) -> str:
        recorder = client.status()["recorder"]
        parts = sorted(Path(recorder["file"]).parent.iterdir())
        try:
            rows = [Recording.open(part).row_count for part in parts]
        except RecordError as error:
            return str(error)
        if not (recorder["is_on"] and len(rows) == 2 and max(rows)):
            return f"the recording has not gone on: {rows} cycles in its files"
        return "" if recorder["lost_rows"] else "no loss was counted"


@dataclass(frozen=True, slots=True)
class LookedAtDrill(RealTimeDrill):
    """Another program connects to the boards, as `check`, `doctor` and another `serve` do."""

    def _break(self, bench: RealTimeBench, client: ArmClient) -> None:
        arm = wired_to(load_arm("right"), bench.rig)
        try:
            connect(arm, MonotonicClock(), client.status()["period_s"]).close()
        except ConnectionFailed as failed:
            if all(isinstance(failure, PortInUse) for failure in failed.failures):
                return
        raise ArmError("another program could connect to the boards of a running arm")


def _descendants(pid: int) -> list[int]:
    """The processes that a process has started, and theirs."""
    children = [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    return children + [grand for child in children for grand in _descendants(child)]
