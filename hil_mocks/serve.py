"""`python -m hil_mocks.serve`: a mock arm, or a cell of several, in real time as a separate process.

Prints one JSON line: encoder_urls, board_urls, can_interface, can_channel, can_options, camera_port, socket, pid; with --cell by
arm, under arms. Obeys JSON lines on that socket; an answer has ok, and error if false. Ends on SIGTERM, SIGINT, `quit` or the
end of its standard input, which happens when its parent dies. Requests, as `{"do": "seat", "point_m": [0.4, 0, 0.1]}`, with `arm`
of a cell:

    do             arguments          answer, or what happens
    truth                             time_s, tip_m, joint_rad
    seat           point_m            duration_s until the hand has the tip there
    let_go
    hand                              state (away, dragging, holding, cannot reach), residual_m, problem
    payload        mass_kg
    tool           name               mounts another of the arm's tools
    object         width_m, or null   between the gripper's fingers
    gripper                           opening_m, force_N on the object: the truth
    pin            name, level        on an input, from outside; a limit switch there changes by hand from then on
    pins                              levels at all named pins
    inject         fault              an object with the keys of [[fault]] of a scenario
    clear_faults
    scenario       name               a file or a shipped one: restarts the mock, another robot on the same wires
    status                            time_s, overruns, lost_s, worst_late_s
    quit
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import selectors
import signal
import socket
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import msgspec

from control.errors import ArmError
from control.model.cell import Cell, cell_of_one, load_cell
from control.model.description import load_arm
from hil_mocks.cell import MockCell
from hil_mocks.errors import MockError, RigError
from hil_mocks.scenario import FaultTable, load_scenario
from hil_mocks.wires import Pty, Wires, newest_of_each

_MOST_CATCH_UP_TICKS = 50  # beyond this lateness, the simulation drops the lost time
_PRIORITY = 60  # of SCHED_FIFO; the loop's is 80
_LOOKS_PER_TICK = 2  # so that a board answers a COMMAND within half a millisecond
_LATE_TICKS = 5  # later than any host's next question: real boards would have answered each


class Pacer:
    """Number of ticks due: simulated time follows a clock, but catches up only a bounded lateness."""

    def __init__(self, tick_s: float, now_s: float) -> None:
        self._tick_s, self._zero_s, self._done = tick_s, now_s, 0
        self.overruns = 0
        self.lost_s = 0.0
        self.worst_late_s = 0.0

    def due(self, now_s: float) -> int:
        """Ticks to run now; those beyond the bound are dropped and counted as one overrun."""
        behind = int((now_s - self._zero_s) / self._tick_s) - self._done
        self.worst_late_s = max(self.worst_late_s, (behind - 1) * self._tick_s)
        if behind > _MOST_CATCH_UP_TICKS:
            dropped_s = (behind - _MOST_CATCH_UP_TICKS) * self._tick_s
            self._zero_s += dropped_s
            self.lost_s += dropped_s
            self.overruns += 1
            behind = _MOST_CATCH_UP_TICKS
        self._done += behind
        return behind

    def ahead_s(self, now_s: float) -> float:
        """How long ago the last tick that was run was due."""
        return now_s - self._zero_s - self._done * self._tick_s


class MockServer:
    """The mock arms of a cell (one, or several), their wires and their socket."""

    def __init__(self, cell: Cell, scenario: str, can_channel: str, socket_path: Path) -> None:
        self._cell = cell
        self._mock = MockCell(cell, load_scenario(scenario))
        lines = [Pty() for _ in range(self._mock.serial_lines)]
        self._wires = Wires(lines, "udp_multicast", can_channel, self._mock.transports, self._mock.can_formats)
        self._channel, self._path = can_channel, socket_path
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.bind(str(socket_path))
        self._listener.listen()
        self._listener.setblocking(False)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ, None)
        self._selector.register(sys.stdin, selectors.EVENT_READ, "parent")
        self._unfinished: dict[socket.socket, bytes] = {}
        self._pacer = Pacer(self._mock.tick_s, time.monotonic())
        self._is_ending = False

    def announcement(self) -> dict[str, Any]:
        """The ports, as printed at the start."""
        paths = [wire.path for wire in self._wires.serial]
        cameras = dict(zip(self._mock.robots, self._wires.camera_ports, strict=True))
        arms = {
            name: {"encoder_urls": encoders, "board_urls": boards, "camera_port": cameras[name]}
            for name, encoders, boards in self._mock.ports(paths)
        }
        return {
            "arms": arms,
            **(next(iter(arms.values())) if len(arms) == 1 else {}),
            "can_interface": "udp_multicast",
            "can_channel": self._channel,
            "can_options": self._wires.can_options,
            "socket": str(self._path),
            "pid": os.getpid(),
        }

    def end(self) -> None:
        """End the loop at its next iteration."""
        self._is_ending = True

    def run(self) -> None:
        """Follow the clock until told to end."""
        self._pacer = Pacer(self._mock.tick_s, time.monotonic())
        while not self._is_ending:
            self._follow(self._pacer.due(time.monotonic()), time.time())
            self._look_at_sockets()
            time.sleep(self._idle_s(self._pacer.ahead_s(time.monotonic())))

    def _idle_s(self, ahead_s: float) -> float:
        """How long nothing is to be done, `ahead_s` after the last tick: until the next one, a look in between, or bytes.

        So a report arrives when its last bit has left the board, as a real one does, and not at one of the looks.
        """
        mock = self._mock
        look_s = mock.tick_s / _LOOKS_PER_TICK
        next_look_s = min((int(ahead_s / look_s) + 1) * look_s, mock.tick_s)
        return max(0.0, min(next_look_s, mock.serial_next_s - mock.now_s) - ahead_s)

    def _follow(self, ticks: int, now_s: float) -> None:
        """Run ticks up to now (seconds since 1970), with the host's frames between them as they came.

        A mock that was late thus moves as boards would have that were not. What they would have sent meanwhile leaves after
        it, the newest of each CAN id: a host that times frames by their arrival sees one long step, and none that is too fast.
        """
        mock, wires = self._mock, self._wires
        wires.collect()
        for left in range(ticks, 0, -1):
            wires.pass_frames(mock, now_s - left * mock.tick_s)
            mock.tick()
        wires.from_host(mock)
        if ticks > _LATE_TICKS:
            for frames in mock.outgoing.values():
                frames[:] = newest_of_each(frames)
        wires.to_host(mock, self._pacer.ahead_s(time.monotonic()))

    def close(self) -> None:
        """Remove everything that was created."""
        for connection in self._unfinished:
            connection.close()
        self._selector.close()
        self._listener.close()
        self._path.unlink(missing_ok=True)
        self._wires.close()

    def _look_at_sockets(self) -> None:
        for key, _ in self._selector.select(0.0):
            if key.data == "parent":
                if not os.read(sys.stdin.fileno(), 4096):
                    self.end()
            elif isinstance(key.fileobj, socket.socket):
                self._listen(key.fileobj)

    def _listen(self, source: socket.socket) -> None:
        if source is self._listener:
            with contextlib.suppress(OSError):  # it has left before it was let in
                connection, _ = source.accept()
                connection.setblocking(False)
                self._unfinished[connection] = b""
                self._selector.register(connection, selectors.EVENT_READ, "client")
            return
        try:
            received = source.recv(65536)
            *lines, self._unfinished[source] = (self._unfinished[source] + received).split(b"\n")
            for line in lines:
                source.sendall(json.dumps(self._answered(line)).encode() + b"\n")
        except OSError:
            received = b""
        if not received:  # it has left, or does not read its answers
            self._selector.unregister(source)
            del self._unfinished[source]
            source.close()

    def _answered(self, line: bytes) -> dict[str, Any]:
        try:
            request = json.loads(line)
            return {"ok": True, **self._done_to_all(request)}
        except (MockError, ValueError, KeyError, TypeError, msgspec.ValidationError) as error:
            return {"ok": False, "error": str(error) or type(error).__name__}

    def _done_to_all(self, request: dict[str, Any]) -> dict[str, Any]:
        """Requests that are of no arm; the others are of one."""
        match request["do"]:
            case "scenario":
                self._mock = MockCell(self._cell, load_scenario(request["name"]))
            case "status":
                return self._status()
            case "quit":
                self.end()
            case _:
                return self._done(request)
        return {}

    def _done(self, request: dict[str, Any]) -> dict[str, Any]:
        robot = self._mock.robot(request.get("arm"))
        hand = robot.hand
        match request["do"]:
            case "truth":
                return {"time_s": robot.now_s, "tip_m": robot.tip_m(), "joint_rad": robot.joint_rad()}
            case "seat":
                return {"duration_s": hand.seat(request["point_m"])}
            case "let_go":
                hand.let_go()
            case "hand":
                return {"state": hand.state, "residual_m": hand.residual_m(), "problem": hand.problem}
            case "payload":
                robot.plant.set_payload(float(request["mass_kg"]))
            case "tool":
                robot.set_tool(str(request["name"]))
            case "object":
                width_m = request["width_m"]
                robot.set_object(None if width_m is None else float(width_m))
            case "gripper":
                opening_m, force_N = robot.gripper_truth()
                return {"opening_m": opening_m, "force_N": force_N}
            case "pin":
                robot.pins.set_level(str(request["name"]), bool(request["level"]))
            case "pins":
                return {"levels": robot.pins.levels()}
            case "inject":
                robot.inject(msgspec.convert(request["fault"], FaultTable))
            case "clear_faults":
                robot.clear_faults()
            case unknown:
                raise RigError(f'mock arm: unknown request "{unknown}"; `python -m hil_mocks.serve --help` lists them.')
        return {}

    def _status(self) -> dict[str, Any]:
        """How well the mock keeps to real time."""
        pacer = self._pacer
        return {
            "time_s": self._mock.now_s,
            "overruns": pacer.overruns,
            "lost_s": pacer.lost_s,
            "worst_late_s": pacer.worst_late_s,
        }


def main(arguments: list[str] | None = None) -> int:
    """Serve until told to end; exit status 2 with one line on stderr if it cannot start."""
    parser = argparse.ArgumentParser(
        prog="python -m hil_mocks.serve", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--arm", default="right", help="arm.toml or the name of a shipped arm")
    parser.add_argument("--scenario", default="ideal", help="scenario file or the name of a shipped one")
    parser.add_argument("--can-channel", default="", help="multicast group of the CAN bus; default: a new one")
    parser.add_argument("--cell", default="", help="cell.toml or the name of a shipped cell, instead of --arm")
    chosen = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="armwright-mock-") as folder:
        try:
            cell = load_cell(chosen.cell) if chosen.cell else cell_of_one(load_arm(chosen.arm))
            server = MockServer(cell, chosen.scenario, chosen.can_channel or own_group(), Path(folder) / "mock.sock")
        except (ArmError, MockError) as error:
            print(error, file=sys.stderr)
            return 2
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: server.end())
        _be_punctual()
        print(json.dumps(server.announcement()), flush=True)
        try:
            server.run()
        finally:
            server.close()
    return 0


def _be_punctual() -> None:
    """Request a real-time class below the control loop's, if permitted, because real boards are punctual."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))


def own_group() -> str:
    """A multicast group of the site-local block (RFC 2365) that follows from the process's number."""
    number = os.getpid() & 0xFFFF
    return f"239.255.{number >> 8}.{number & 0xFF}"


if __name__ == "__main__":
    sys.exit(main())
