"""XML of other people: read without entities or document types, bounded in size, depth and number of elements."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final
from xml.parsers import expat

from calib.errors import ImportedModelError
from control.errors import ArmError
from control.files import read_bytes

MOST_BYTES: Final = 16_000_000
MOST_ELEMENTS: Final = 200_000
DEEPEST: Final = 256
IN_UTF_8: Final = 'save the file as UTF-8, and write encoding="utf-8" in its first line, or none'
WRONG_ENCODINGS: Final = {
    expat.errors.codes[kind] for kind in (expat.errors.XML_ERROR_UNKNOWN_ENCODING, expat.errors.XML_ERROR_INCORRECT_ENCODING)
}


@dataclass(slots=True)
class Element:
    """An element: tag, attributes, children, and the line where it begins."""

    tag: str
    attributes: dict[str, str]
    line: int
    children: list[Element] = field(default_factory=list)

    def all(self, tag: str) -> Iterator[Element]:
        """The children with this tag."""
        return (child for child in self.children if child.tag == tag)

    def first(self, tag: str) -> Element | None:
        """The first child with this tag."""
        return next(self.all(tag), None)

    def walk(self) -> Iterator[Element]:
        """This element and all inside it, in the document's order."""
        waiting = [self]
        while waiting:
            element = waiting.pop()
            yield element
            waiting += reversed(element.children)


def read_xml(path: Path, form: str) -> Element:
    """The root of an XML file; ImportedModelError names file and line."""
    try:
        content = read_bytes(path, MOST_BYTES)
    except ArmError as error:
        raise ImportedModelError(str(error)) from None
    except OSError as error:
        raise ImportedModelError(f"{path}: cannot be read: {error.strerror or error}") from None
    return _Reader(path, form).root_of(content)


def _is_text(content: bytes) -> bool:
    """Whether these bytes are UTF-8."""
    try:
        content.decode("utf-8")
    except UnicodeDecodeError:
        return False
    return True


class _Reader:
    """Builds the tree from expat's events."""

    def __init__(self, path: Path, form: str) -> None:
        self._path, self._form = path, form
        self._open: list[Element] = []
        self._root: Element | None = None
        self._count = 0
        self._parser = expat.ParserCreate()
        self._parser.StartElementHandler = self._start
        self._parser.EndElementHandler = self._end
        self._parser.StartDoctypeDeclHandler = self._doctype

    def root_of(self, content: bytes) -> Element:
        try:
            self._parser.Parse(content, True)
        except expat.ExpatError as error:
            remedy = "" if _is_text(content) and error.code not in WRONG_ENCODINGS else f"; {IN_UTF_8}"
            raise self._error(f"expected {self._form}, which is XML: {error}{remedy}", error.lineno) from None
        except (LookupError, ValueError) as error:
            raise self._error(f"expected {self._form}, which is XML: {error}; {IN_UTF_8}", 1) from None
        if self._root is None:
            raise self._error(f"expected {self._form}, got an empty file", 1)
        return self._root

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        line = self._parser.CurrentLineNumber
        self._count += 1
        if self._count > MOST_ELEMENTS:
            raise self._error(f"more than {MOST_ELEMENTS} elements", line)
        if len(self._open) >= DEEPEST:
            raise self._error(f"elements nested more than {DEEPEST} deep", line)
        element = Element(tag, attributes, line)
        if self._open:
            self._open[-1].children.append(element)
        else:
            self._root = element
        self._open.append(element)

    def _end(self, _tag: str) -> None:
        self._open.pop()

    def _doctype(self, *_: object) -> None:
        line = self._parser.CurrentLineNumber
        raise self._error(f"{self._form} has no <!DOCTYPE ...>; entities are not read: remove it", line)

    def _error(self, what: str, line: int) -> ImportedModelError:
        return ImportedModelError(f"{self._path}, line {line}: {what}")
