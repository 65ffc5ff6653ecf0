"""Lines and dots in characters: each braille character is two dots wide and four high."""

_BITS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
_EMPTY = 0x2800


class Canvas:
    """A picture of `columns` by `rows` characters. Points are in dots, x to the right, y downwards; outside is nothing."""

    def __init__(self, columns: int, rows: int) -> None:
        self.width, self.height = 2 * columns, 4 * rows
        self._cells = [[0] * columns for _ in range(rows)]

    def dot(self, x: int, y: int) -> None:
        """Set one dot."""
        if 0 <= x < self.width and 0 <= y < self.height:
            self._cells[y // 4][x // 2] |= _BITS[y % 4][x % 2]

    def line(self, x0: int, y0: int, x1: int, y1: int, every: int = 1) -> None:
        """A straight line, dotted where `every` is more than 1."""
        steps = max(abs(x1 - x0), abs(y1 - y0), 1)
        if steps > 4 * (self.width + self.height):
            return
        for step in range(0, steps + 1, every):
            self.dot(round(x0 + (x1 - x0) * step / steps), round(y0 + (y1 - y0) * step / steps))

    def lines(self) -> list[str]:
        """The picture as text, a line a row."""
        return ["".join(chr(_EMPTY + cell) if cell else " " for cell in row) for row in self._cells]
