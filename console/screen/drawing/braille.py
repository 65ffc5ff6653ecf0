"""Lines, marks and letters in characters: each braille character is two dots wide and four high.

A character has the style of the last stroke through it. Letters are in front of all strokes.
"""

from itertools import groupby

from console.screen.drawing.rows import Row

_BITS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
_EMPTY = 0x2800


class Canvas:
    """A picture of `columns` by `rows` characters. Points are in dots, x to the right, y downwards; others are ignored."""

    def __init__(self, columns: int, rows: int) -> None:
        self.columns, self.rows = columns, rows
        self.width, self.height = 2 * columns, 4 * rows
        self._cells = [[0] * columns for _ in range(rows)]
        self._looks = [["plain"] * columns for _ in range(rows)]
        self._letters: dict[tuple[int, int], tuple[str, str]] = {}

    def dot(self, x: int, y: int, look: str = "plain") -> None:
        """Set one dot."""
        if 0 <= x < self.width and 0 <= y < self.height:
            self._cells[y // 4][x // 2] |= _BITS[y % 4][x % 2]
            self._looks[y // 4][x // 2] = look

    def line(self, x0: int, y0: int, x1: int, y1: int, look: str = "plain", every: int = 1) -> None:
        """Draw a straight line, dotted if `every` is more than 1."""
        steps = max(abs(x1 - x0), abs(y1 - y0), 1)
        if steps > 4 * (self.width + self.height):
            return
        for step in range(0, steps + 1, every):
            self.dot(round(x0 + (x1 - x0) * step / steps), round(y0 + (y1 - y0) * step / steps), look)

    def stroke(self, x0: int, y0: int, x1: int, y1: int, look: str = "plain", half: int = 1) -> None:
        """Draw a line of thickness 2 `half` + 1 dots."""
        is_steep = abs(y1 - y0) > abs(x1 - x0)
        for offset in range(-half, half + 1):
            dx, dy = (offset, 0) if is_steep else (0, offset)
            self.line(x0 + dx, y0 + dy, x1 + dx, y1 + dy, look)

    def letters(self, column: int, row: int, text: str, look: str = "plain") -> None:
        """Draw letters from a character on; `column`, `row` count characters."""
        for n, letter in enumerate(text):
            if 0 <= column + n < self.columns and 0 <= row < self.rows:
                self._letters[row, column + n] = (letter, look)

    def mark(self, x: int, y: int, sign: str, look: str = "plain") -> None:
        """Draw a sign on the character that contains a dot."""
        self.letters(x // 2, y // 4, sign, look)

    def lines(self) -> list[Row]:
        """The rows of the picture."""
        return [self._row(number) for number in range(self.rows)]

    def _row(self, number: int) -> Row:
        cells = [self._cell(number, column) for column in range(self.columns)]
        runs = groupby(cells, key=lambda cell: cell[1])
        return tuple(("".join(sign for sign, _ in run), look) for look, run in runs)

    def _cell(self, row: int, column: int) -> tuple[str, str]:
        if (letter := self._letters.get((row, column))) is not None:
            return letter
        cell = self._cells[row][column]
        return (chr(_EMPTY + cell), self._looks[row][column]) if cell else (" ", "plain")
