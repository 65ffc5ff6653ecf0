"""The option --boards: boards that `armwright register` measured, as frames."""

from pathlib import Path

from calib.arm_problem.frames import Frame
from calib.boards.boards import read_boards


def board_frames(file: str | None) -> dict[str, Frame]:
    """Board poses by setup from boards.json; none without a file."""
    if file is None:
        return {}
    return {
        setup: Frame(f"table_{setup}", board.rotation, board.origin_m)
        for setup, board in read_boards(Path(file)).items()
    }
