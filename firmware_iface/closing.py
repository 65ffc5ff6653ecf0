"""What is closed at the end of a `with`: links, files, mock arms."""

from abc import ABC, abstractmethod
from typing import Self


class Closing(ABC):
    """`with` gives the thing itself, and closes it however the block ends."""

    __slots__ = ()

    @abstractmethod
    def close(self) -> None:
        """Give back what it holds."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
