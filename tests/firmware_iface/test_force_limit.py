"""A limit that a servo keeps is written until the servo has said that it has it, and after a restart again."""

from collections.abc import Callable
from typing import Any, cast

from firmware_iface.smart_servo import ForceLimit, ServoLine


class Line:
    def __init__(self) -> None:
        self.posted: list[int] = []

    def post(self, question: int) -> None:
        self.posted.append(question)


def test_a_limit_is_written_until_it_is_answered_and_when_it_changes_or_is_lost() -> None:
    line, confirmed = Line(), dict[int, Callable[[], None]]()

    def written(value: int, confirm: Callable[[], None]) -> Any:
        confirmed[value] = confirm
        return value

    limit = ForceLimit(cast(ServoLine, line), written)
    limit.keep(5)
    limit.keep(5)
    assert line.posted == [5, 5]
    confirmed[5]()
    limit.keep(5)
    assert line.posted == [5, 5]
    limit.keep(7)
    confirmed[7]()
    limit.forget()
    limit.keep(7)
    assert line.posted == [5, 5, 7, 7]
