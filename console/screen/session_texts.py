"""Rows of the session's screen: the board with its cavities, and each record with its residuals."""

from collections.abc import Mapping, Sequence
from typing import Any

from console.screen.drawing import Row, Span, row

SIGNS: Mapping[str, Span] = {
    "done": ("#", "accent"), "partly": ("+", "accent"), "now": ("O", "chosen"), "left": (".", "plain"),
    "skipped": ("-", "warning"), "bad": ("x", "error"),
}  # fmt: skip
MEANINGS = {
    "done": "done",
    "partly": "some repeats",
    "now": "now",
    "left": "left",
    "skipped": "skipped",
    "bad": "bad",
}
ODD = 3.0  # standard deviations: a warning; the session itself decides what is suspect
HEADING = f"{'point':<12}{'model mm':>9}{'others mm':>11}{'in sd':>7}"


def legend_rows(width: int) -> list[Row]:
    """The legend of the board, wrapped."""
    rows: list[Row] = []
    taken = width
    for mark, meaning in MEANINGS.items():
        spans = row(SIGNS[mark], (f" {meaning}  ", "muted"))
        if taken + len(meaning) + 4 > width + 2:
            rows.append(())
            taken = 0
        rows[-1] += spans
        taken += len(meaning) + 4
    return rows


def board_rows(board: Sequence[Mapping[str, Any]], width: int, height: int) -> list[Row]:
    """The board from above, its x axis to the right, one character per cavity (twice as high as wide)."""
    if not board:
        return [row("no cavities in this setup")]
    xs, ys = [p["x_m"] for p in board], [p["y_m"] for p in board]
    span_m = max(max(xs) - min(xs), max(ys) - min(ys), 1e-3)
    columns = max(min(width, 61, 2 * height - 1) - 1, 8)
    rows = round(columns / 2 * (max(ys) - min(ys)) / span_m)
    grid: list[list[Span]] = [[(" ", "plain")] * (columns + 1) for _ in range(rows + 1)]
    for point in board:
        at_row = round((max(ys) - point["y_m"]) / span_m * columns / 2)
        column = round((point["x_m"] - min(xs)) / span_m * columns)
        grid[at_row][column] = SIGNS.get(str(point["mark"]), ("?", "plain"))
    return [tuple(spans) for spans in grid]


def record_text(message: Mapping[str, Any]) -> Span:
    """A record, the model's error, and its deviation from the other records; a suspect one with the remedy."""
    if message["is_suspect"]:
        return message["text"], "error"
    sd, deviation_mm, error_mm = message["deviation_sd"], message["deviation_mm"], message["error_mm"]
    text = f"{message['recorded']:<12}" + (f"{error_mm:9.2f}" if error_mm is not None else f"{'-':>9}")
    if sd is None or deviation_mm is None:
        return text, "plain"
    return (
        f"{text}{deviation_mm:11.2f}{sd:7.1f}{' ~' if sd > ODD else ''}",
        "warning" if sd > ODD else "plain",
    )
