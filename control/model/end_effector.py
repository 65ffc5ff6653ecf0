"""What an arm.toml says about the end of the arm: its tools. A field's name is its key in the file."""

from dataclasses import dataclass
from typing import Annotated, Any

from control.model.reader import Rejected, read_table
from control.model.rules import NOT_NEGATIVE, WORD

Vector3 = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Tool:
    """What is mounted on the last link: its tip in the last frame, and whether that is known or to be identified.

    A file has one `[tool]`, or several `[[tool]]` with a `name` each; the first is the one that is on at the start. `mass_kg` is
    a point mass at `com_m` in the last frame (at the tip if it is not given), beyond the masses of the links.
    """

    position_m: Vector3 = (0.0, 0.0, 0.0)
    known: bool = True
    name: Annotated[str, WORD] = ""
    mass_kg: Annotated[float, NOT_NEGATIVE] = 0.0
    com_m: Vector3 | None = None

    @property
    def centre_m(self) -> Vector3:
        """The centre of its mass in the last frame."""
        return self.position_m if self.com_m is None else self.com_m


NO_TOOL = Tool()


def read_tools(document: dict[str, Any]) -> tuple[dict[str, Any], tuple[Tool, ...]]:
    """Read the `[[tool]]`s of a document: the rest of it, and the tools. There are none if it has one `[tool]`, or nothing."""
    tables = document.get("tool")
    if not isinstance(tables, list) or not tables:
        return document, ()
    tools = tuple(read_table(Tool, table, ("tool", index)) for index, table in enumerate(tables))
    seen: set[str] = set()
    for index, tool in enumerate(tools):
        path = ("tool", index, "name")
        if not tool.name:
            raise Rejected(path, "a name for every [[tool]]", "nothing", "`armwright tool NAME` chooses one")
        if tool.name in seen:
            raise Rejected(path, "a unique name for every [[tool]]", f"{tool.name} a second time")
        seen.add(tool.name)
    return {key: value for key, value in document.items() if key != "tool"}, tools
