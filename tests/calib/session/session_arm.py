"""An arm, a hand, a camera and a geometry for tests of sessions: they write down what they are told, and nothing moves."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.calibration.chains import REFERENCE, REFERENCE_DH
from calib.session.conduct import Boards, Station, conduct
from calib.session.conversation import GO, Ask, Do, Message, Recorded, SessionCommand, SessionQuestion
from calib.session.folder import SessionFolder
from calib.session.moves import ArmGeometry, RestSample, SeenTip
from calib.session.plan import SessionPlan, Target, board_targets
from calib.session.residual_watch import ResidualWatch
from calib.session.take import SessionSettings
from control.errors import ArmError
from control.model.description import load_arm
from control.model.table import cavities, table_of

RIGHT = load_arm("right")
GEOMETRY = ArmGeometry(RIGHT)
SEED = np.array([0.0, -1.0, 0.0])


class NumericGeometry(ArmGeometry):
    """The reference arm; the cavity named in `far` is out of reach."""

    def __init__(self, far: tuple[float, float, float] | None = None) -> None:
        super().__init__(RIGHT)
        self._far = far

    def nearest(self, point, q_near):
        if self._far is not None and math.dist(point, self._far) < 1e-9:
            raise ArmError("target is out of reach by 0.012 m")
        return super().nearest(point, q_near)


class ScriptedArm:
    """Writes down what it is told. Encoders tremble for `settle_s` after every motion, then stand."""

    def __init__(self, settle_s: float = 0.2) -> None:
        self.log: list[str] = []
        self.tips: list[np.ndarray] = []
        self.t_s, self.q_rad, self.settle_s, self.moved_s = 0.0, (0.0, -0.3, 0.3), settle_s, -10.0

    def now_s(self) -> float:
        return self.t_s

    def move_to_q(self, q_rad) -> None:
        self.q_rad, self.moved_s = tuple(q_rad), self.t_s + 1.0
        self.t_s += 1.0
        self.log.append("move")
        self.tips.append(REFERENCE.tips(REFERENCE_DH, np.array([q_rad]))[0])

    def creep_to_q(self, q_rad) -> None:
        self.move_to_q(q_rad)
        self.log[-1] = "creep"

    def release(self) -> None:
        self.log.append("release")

    def hold(self) -> None:
        self.log.append("hold")

    def grip(self) -> None:
        self.log.append("grip")

    def seat(self, point_m) -> None:
        self.moved_s = self.t_s
        self.q_rad = GEOMETRY.nearest(point_m, self.q_rad)
        self.log.append("seat")

    def let_go(self) -> None:
        self.log.append("let go")

    def average(self, duration_s: float) -> RestSample:
        self.t_s += duration_s
        shake = 1e-3 * math.cos(300.0 * self.t_s) if self.t_s - self.moved_s < self.settle_s else 0.0
        q_rad = tuple(q + shake for q in self.q_rad)
        return RestSample(q_rad, (1e-5,) * 3, (0.3, 1.5, 0.5), (1, -1, 1), (31.0, 40.5, 29.0))

    def measure(self, duration_s: float):
        """The camera: exactly where the tip is."""
        tip = REFERENCE.tips(REFERENCE_DH, np.array([self.q_rad]))[0]
        return SeenTip(tuple(tip.tolist()), (1e-4, 1e-4, 1e-4))


TABLE = table_of(RIGHT)
ALL = list(cavities(TABLE))
SKIP, REDO, BAD, QUIT = (SessionCommand(do) for do in (Do.SKIP, Do.REDO, Do.BAD, Do.QUIT))
NAMES = {
    SessionQuestion.BOARD: "board",
    SessionQuestion.NEXT: "next",
    SessionQuestion.TAKE: "take",
    SessionQuestion.SEATED: "seated",
    SessionQuestion.DONE: "done",
}


class CavityHand:
    """Seats the tip where the board really is; `beside` maps keys to how far beside the cavity it is put once."""

    def __init__(self, arm: ScriptedArm, beside: dict | None = None, moved=(0.0, 0.0, 0.0)) -> None:
        self._arm, self._beside, self._moved = arm, beside or {}, np.array(moved)

    def grip(self) -> None:
        self._arm.grip()

    def seat(self, target: Target) -> None:
        place = np.array(cavities(TABLE, target.setup)[target.point]) + self._moved
        self._arm.seat(tuple((place + self._beside.pop(target.key, 0.0)).tolist()))

    def let_go(self) -> None:
        self._arm.let_go()


@dataclass
class Bench:
    """A session in a folder, with a scripted arm. Each `run` is one start of the program."""

    folder: Path
    plan: SessionPlan
    arm: ScriptedArm
    hand: CavityHand | None = None
    geometry: NumericGeometry = field(default_factory=NumericGeometry)
    settings: SessionSettings = field(default_factory=SessionSettings)

    def run(self, answers: Iterable[SessionCommand]) -> list:
        """All that was said; questions are answered in turn, then with QUIT."""
        answers = iter(answers)
        self.said: list = []
        with SessionFolder(self.folder, self.plan) as session:
            camera = self.arm if self.plan.has_camera else None
            boards, watch = Boards(RIGHT, self.plan), ResidualWatch(RIGHT)
            station = Station(self.arm, self.geometry, boards, watch, self.hand, camera, None, self.settings)
            talk = conduct(session, station)
            try:
                saying = next(talk)
                while True:
                    self.said.append(saying)
                    if isinstance(saying, Ask):
                        self.arm.log.append(f"{NAMES[saying.question]} {saying.target.name if saying.target else ''}".strip())
                    saying = talk.send(next(answers, QUIT) if isinstance(saying, Ask) else GO)
            except StopIteration:
                pass
            finally:
                talk.close()
            self.marks = {key[:2] if key[2] == 1 else key: mark for key, mark in session.state.marks.items()}
        return self.said

    @property
    def told(self) -> list[str]:
        return [saying.text for saying in self.said if isinstance(saying, Message)]

    @property
    def kept(self) -> list[Recorded]:
        return [saying for saying in self.said if isinstance(saying, Recorded)]


def bench(tmp_path: Path, points=("1", "7"), setups=("normal",), has_hand=True, **plan) -> Bench:
    arm = plan.pop("arm", None) or ScriptedArm()
    targets = plan.pop("targets", None) or board_targets(setups, points)
    wanted = SessionPlan("right", "00", 3, targets, **plan)
    return Bench(tmp_path / "s", wanted, arm, CavityHand(arm) if has_hand else None)
