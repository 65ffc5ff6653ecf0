"""A session of two arms in contact: nothing moves unasked, both are led and held together, and a kill loses no record."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from calib.closed_chain.conduct import ContactWatch, PairStation, conduct, contact_plan
from calib.closed_chain.pair_problem import read_contacts
from calib.closed_chain.planning import Candidates, SharedRoom, base_of, contact_candidates
from calib.errors import SessionError
from calib.session.conversation import GO, Ask, Do, Message, Recorded, Saying, SessionCommand, SessionQuestion, SmallMove
from calib.session.folder import SessionFolder
from calib.session.moves import ArmGeometry, RestSample
from calib.session.plan import Mark, Seating, Target
from control.model.cell import load_cell

PAIR = load_cell("pair")
NAMES = ("left", "right")
ARMS = (PAIR.arms[0].arm, PAIR.arms[1].arm)
QUIT, REDO = SessionCommand(Do.QUIT), SessionCommand(Do.REDO)


@cache
def planned() -> Candidates:
    return contact_candidates(PAIR, NAMES, (0.0, 0.1), drawn=80).chosen(range(4))


class Arm:
    """Goes where it is told; writes down what it was told. Its clock runs when it is read."""

    def __init__(self, name: str, log: list[str], q_rad: Sequence[float]) -> None:
        self.name, self.log, self.q_rad, self.t_s = name, log, tuple(q_rad), 0.0

    def now_s(self) -> float:
        return self.t_s

    def move_to_q(self, q_rad: Sequence[float]) -> None:
        raise AssertionError("arms of a pair are led together")

    def creep_to_q(self, q_rad: Sequence[float]) -> None:
        self.log.append(f"creep {self.name}")
        self.q_rad = tuple(q_rad)

    def release(self) -> None:
        self.log.append(f"release {self.name}")

    def hold(self) -> None:
        self.log.append(f"hold {self.name}")

    def average(self, duration_s: float) -> RestSample:
        self.t_s += duration_s
        return RestSample(self.q_rad, (0.0,) * 3, (0.1,) * 3, (1, -1, 0), (25.0,) * 3)


class Bench:
    """Two scripted arms at their rest poses, and one folder."""

    def __init__(self, folder: Path, seat: Seating = "hand") -> None:
        self.folder = folder
        self.log: list[str] = []
        self.said: list[Saying] = []
        self.room = SharedRoom(PAIR, (PAIR.arms[0], PAIR.arms[1]))
        left_rad, right_rad = self.room.rest_rad
        self.arms = (Arm("left", self.log, left_rad), Arm("right", self.log, right_rad))
        self.plan = contact_plan(NAMES, "00", planned().contacts, seat)

    def together(self, poses_rad: Sequence[Sequence[float]], speed: float) -> None:
        assert self.room.is_way_clear([arm.q_rad for arm in self.arms], poses_rad) or speed < 1.0
        self.log.append("lead" if speed == 1.0 else "back off")
        for arm, q_rad in zip(self.arms, poses_rad, strict=True):
            arm.q_rad = tuple(q_rad)

    def run(self, answers: Iterable[SessionCommand]) -> list[Saying]:
        """What was said; every Ask is logged and answered in turn, then with QUIT."""
        answers, self.said = iter(answers), []
        geometry = (ArmGeometry(ARMS[0]), ArmGeometry(ARMS[1]))
        watch = ContactWatch(ARMS, base_of(PAIR, NAMES))
        with SessionFolder(self.folder, self.plan) as folder:
            talk = conduct(folder, PairStation(NAMES, self.arms, geometry, self.together, self.room, watch))
            saying = next(talk)
            try:
                while True:
                    self.said.append(saying)
                    if isinstance(saying, Ask):
                        self.log.append(f"{saying.question.name} {saying.arm}".strip())
                        if saying.question is SessionQuestion.SEATED and saying.arm:  # the hand does it
                            self.bring(saying.target)
                    saying = talk.send(next(answers, QUIT) if isinstance(saying, Ask) else GO)
            except StopIteration:
                pass
            self.marks = [*folder.state.marks.values()]
        return self.said

    def bring(self, target: Target | None) -> None:
        assert target is not None
        assert target.q_rad is not None
        q_rad = target.q_rad
        self.arms[0].q_rad, self.arms[1].q_rad = tuple(q_rad[:3]), tuple(q_rad[3:])


def test_both_arms_are_led_taken_and_held_in_turn_and_nothing_moves_unasked(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "s")
    bench.run([GO] * 5)
    took = ["TAKE left", "release left", "SEATED left", "hold left", "TAKE right", "release right", "SEATED right"]
    held = ["hold right", "hold left", "hold right"]
    first = bench.log[: bench.log.index("NEXT", 1)]
    assert [entry for entry in first if entry != "lead"] == ["NEXT", *took, *held]
    assert bench.log[-1] == "NEXT", "the next is asked for before the arms back off"
    bench.run([GO] * 99)
    assert bench.marks == [Mark.DONE] * 4
    assert bench.log[-2:] == ["DONE", "back off"]
    contacts, _ = read_contacts(tmp_path / "s" / "points.csv", ARMS)
    wanted = planned().contacts
    order = [wanted.keys.index(key) for key in contacts.keys]
    assert sorted(order) == [0, 1, 2, 3]
    assert contacts.distance_m == pytest.approx(wanted.distance_m[order])
    np.testing.assert_allclose(contacts.second_rad, wanted.second_rad[order], atol=1e-9)


def test_stopped_anywhere_both_arms_hold_and_the_session_goes_on_from_there(tmp_path: Path) -> None:
    for stop in range(1, 6):
        bench = Bench(tmp_path / str(stop))
        bench.run([GO] * stop)
        for name in NAMES:
            if f"release {name}" in bench.log:
                assert f"hold {name}" in bench.log[bench.log.index(f"release {name}") :]
        was_touching = "release left" in bench.log
        bench.log.clear()
        bench.run([GO] * 2)
        assert bench.log[:1] == ["NEXT"]
        assert (bench.log[1] == "back off") is was_touching


def test_a_record_is_redone_once_and_survives_the_next_start(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "s", seat="jog")
    bench.run([GO, GO, REDO, GO, GO, GO, GO])
    taken = [saying.record.take for saying in bench.said if isinstance(saying, Recorded)]
    assert taken[:2] == [1, 2]
    text = (tmp_path / "s" / "points.csv").read_text()
    bench.run([])
    assert (tmp_path / "s" / "points.csv").read_text() == text


def test_jogs_name_the_arm(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "s", seat="jog")
    steps = [
        SmallMove("z", -0.005, "right"),
        SmallMove("z", -0.005),
        SmallMove("z", 0.005, "middle"),
        SmallMove("z", 0.9, "left"),
    ]
    bench.run([GO, *(SessionCommand(Do.JOG, jog=jog) for jog in steps)])
    told = [saying.text for saying in bench.said if isinstance(saying, Message)]
    assert [entry for entry in bench.log if "creep" in entry] == ["creep right"]
    assert "expected one of left, right first" in told[0]
    assert "got middle" in told[1]
    assert "0.05 m at most" in told[2]


def test_a_contact_that_the_others_contradict_is_noticed_at_once() -> None:
    contacts = contact_candidates(PAIR, NAMES, (0.0, 0.1), drawn=400).contacts
    watch, q_rad = (ContactWatch(ARMS, base_of(PAIR, NAMES)), np.hstack((contacts.first_rad, contacts.second_rad)))
    rows = zip(q_rad.tolist(), contacts.distance_m.tolist(), strict=True)
    for number, (q, distance_m) in enumerate([*rows][:14]):
        assert not watch.judge(q, distance_m).is_suspect
        watch.add(number, q, distance_m)
    wrong = [*q_rad[15, :3], *q_rad[16, 3:]]
    assert watch.judge(wrong, float(contacts.distance_m[15])).is_suspect


def test_joined_tools_are_refused(tmp_path: Path) -> None:
    contacts = planned().contacts.chosen(range(2))
    object.__setattr__(contacts, "joined", ("clamp", "clamp"))
    with pytest.raises(SessionError, match="joined tools cannot"):
        contact_plan(NAMES, "00", contacts, "hand")
