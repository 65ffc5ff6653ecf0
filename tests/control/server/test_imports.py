"""Nothing is imported after the arm is enabled: an import costs cycles, and fails for want of file descriptors or memory."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[3]
SESSION = """
import sys
from tests.cell import RIGHT, FRICTION, open_cell, scenario
from control.motion.plan import plan_path

def script(cell):
    client = cell.client
    client.enable()
    client.home()
    client.ask("home", again=True)
    cell.until(lambda: cell.mode.name == "HOLDING", 120.0)
    client.move_joints((0.2, -0.5, 0.3))
    client.move_joints(path.q_start_rad)
    client.ask("run_path", path=path.to_message())
    cell.run(0.3)
    client.pause()
    cell.run(0.5)
    client.resume()
    cell.run(0.2)
    client.stop()
    cell.run(0.5)
    client.jog(joint=1, by_rad=0.05)
    client.jog(axis="z", by_m=0.01)
    client.guide()
    cell.run(0.3)
    client.hold()
    client.average(0.1)
    client.status()
    cell.channel.request({"do": "nonsense"})
    cell.inject("over_temperature", "motor2")
    cell.until_fault(1.0)
    cell.rig.clear_faults()
    cell.run(0.3)
    cell.channel.request({"do": "fault_cycles"})
    client.acknowledge()
    client.enable()
    client.ask("off")
    cell.until(lambda: cell.mode.name == "OFF", 60.0)

path = plan_path(RIGHT, [(0.4, 0.0, 0.3), (0.35, 0.1, 0.3)], 0.1)
assert "ruckig" not in sys.modules, "a client's planning must not hide what the loop needs"
with open_cell(scenario(effect=FRICTION)) as cell:
    before = set(sys.modules)
    script(cell)
    late = {name for name in set(sys.modules) - before if name.partition(".")[0] not in ("hil_mocks", "mujoco")}
    print("imported late:", sorted(late))
"""


def test_nothing_is_imported_between_enabling_and_switching_off() -> None:
    ended = subprocess.run([sys.executable, "-c", SESSION], capture_output=True, text=True, cwd=ROOT, check=False, timeout=300)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.splitlines()[-1] == "imported late: []"
