"""Board poses from the records so far, and checks of new records."""

from __future__ import annotations

import datetime
from collections.abc import Generator
from importlib.metadata import version

from calib.arrays import norms
from calib.boards import Registration, markers_text, write_boards
from calib.errors import RegistrationError
from calib.points.points import STREAM_FRAME, Points
from calib.points.writer import Record, replace_file
from calib.session.boards_known import Boards, markers_of
from calib.session.conversation import Message, Saying, SessionCommand
from calib.session.folder import SessionFolder
from calib.session.moves import Vector
from calib.session.plan import FREE
from calib.session.residual_watch import ResidualWatch, TipObservation

MARKERS, BOARDS = "markers.csv", "boards.json"


class BoardSurvey:
    """Registers boards that the camera measures, and feeds the watch."""

    def __init__(self, folder: SessionFolder, boards: Boards, watch: ResidualWatch) -> None:
        self._folder, self._boards, self._watch = folder, boards, watch
        self._found: dict[str, Registration] = {}

    def resume(self) -> Generator[Saying, SessionCommand, None]:
        """Process the records of a resumed session."""
        points = self._folder.points()
        if points is None:
            return
        for key, observation in _observations(points, self._boards):
            self._watch.add(key, observation)
        for setup in dict.fromkeys(points.setup):
            yield from self.place(setup)

    def observation(self, record: Record) -> TipObservation:
        """A record as an observation for the watch."""
        if record.tip_m is not None:
            is_unplaced = self._folder.plan.pose_frame == STREAM_FRAME
            return TipObservation(record.setup, record.q_rad, record.tip_m, is_unplaced)
        return TipObservation(record.setup, record.q_rad, self._boards.cavities_m[record.point], True)

    def place(self, setup: str) -> Generator[Saying, SessionCommand, None]:
        """Register a board measured by the camera, and write its pose."""
        points = self._folder.points()
        if self._boards.kind != "measured" or setup == FREE or points is None:
            return
        replace_file(self._folder.path / MARKERS, markers_text(markers_of(points)).encode())
        is_last = not any(target.setup == setup for target in self._folder.state.left())
        try:
            found = self._boards.register(points, setup, is_last)
        except RegistrationError as error:
            yield Message(str(error), is_warning=True)
            return
        if found is None:
            return
        before = self._found.get(setup)
        self._found[setup] = found
        self._write()
        if before is None or before.outliers != found.outliers:
            yield Message(_described(setup, found), is_warning=bool(found.outliers))

    def _write(self) -> None:
        date = datetime.datetime.now(datetime.UTC).date().isoformat()
        arm = self._folder.plan.arm
        program = f"armwright {version('armwright')}"
        write_boards(self._folder.path / BOARDS, arm, self._found, {}, date, program)


def _observations(points: Points, boards: Boards) -> list[tuple[object, TipObservation]]:
    """The records of a file, by key, in order."""
    found: list[tuple[object, TipObservation]] = []
    for k in range(len(points)):
        setup, point, repeat = points.setup[k], points.point[k], points.repeat[k]
        x, y, z = points.tip_m[k].tolist()
        is_unknown = x != x
        place: Vector = boards.cavities_m[point] if is_unknown else (x, y, z)
        is_unplaced = is_unknown or points.in_camera_frame
        observation = TipObservation(setup, tuple(points.q_rad[k].tolist()), place, is_unplaced)
        found.append(((setup, point, repeat), observation))
    return found


def _described(setup: str, found: Registration) -> str:
    worst = max(zip(norms(found.residual_m), found.names, strict=True))
    text = (
        f"board {setup}: pose from {len(found.names)} cavities, residual {1e3 * found.noise_m:.2f} mm per axis,"
        f" largest {1e3 * float(worst[0]):.2f} mm at {worst[1]}"
    )
    if found.outliers:
        text += f"; not used: {', '.join(found.outliers)} (`redo` them)"
    return "; ".join((text, *found.notes))
