"""The documents: every link resolves, every command and option that they name exists, every page can be reached."""

import argparse
import functools
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from calib.gap.log import LOG
from calib.points.points import POINTS
from calib.tolerances.making import TolerancesFile
from console.main import parser
from control.model.arm import Arm
from control.model.board_kinds import KINDS
from control.model.cell import CellFile
from control.model.effects import EFFECTS, parameter_names
from control.model.reference import sections
from control.tables import documented
from firmware_iface.installation import PACKAGES
from hil_mocks.scenario import Scenario

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "docs").glob("*.md"))
DOCUMENTS = [*PAGES, *(ROOT / f"{name}.md" for name in ("README", "ARCHITECTURE", "CONTRIBUTING", "CHANGELOG"))]
LINK = re.compile(r"\]\(([^)\s]+)\)")
FILE_IN_TEXT = re.compile(r"\bdocs/[\w.-]+\.(?:md|png)\b")
CALL = re.compile(r"(?:^|\s|/)armwright ([a-z][a-z0-9-]*)\b(.*)")
CODE_SPAN = re.compile(r"`([^`]+)`")
OPTION = re.compile(r"--[a-z][a-z-]*")
OF_BENCHMARKS = {"--grid", "--save"}
OF_LEROBOT = {"--robot", "--teleop", "--dataset"}
CODE = tuple(f"{name}/" for name in (*PACKAGES, "benchmarks", "tests"))
TOP = "|".join(name.rstrip("/") for name in CODE)
PATH = re.compile(rf"(?<![\w./{{}}-])((?:{TOP}|docs)/[\w./{{}},-]*)")
DOTTED = re.compile(rf"(?<![\w./-])((?:{TOP})(?:\.[A-Za-z_]\w*)+)")
FILE_OF_CODE = re.compile(r"(?<![\w./{}<-])((?:\w+/)*\w+\.(?:py|dbc|tcss))\b")
FOLDER = re.compile(r"(?<![\w/{}<>-])((?:\w+/)+)(?=[\s`,;)]|$)", re.MULTILINE)
WORDS_OF_CODE = re.compile(r'""".*?"""|#[^\n]*', re.DOTALL)
OTHER_FILE = (".md", ".json", ".csv", ".toml", ".html")
SETUPTOOLS = {"setup.py"}  # a name that setuptools asks for; no such file is needed
MADE = {"so101_mine.py"}  # by a command of the page that names it
MAKE = re.compile(r"\bmake ([a-z][a-z-]+)\b")


@functools.cache
def subcommands() -> dict[str, argparse.ArgumentParser]:
    """The parser of each subcommand, by name."""
    (action,) = (a for a in parser()._actions if isinstance(a, argparse._SubParsersAction))
    return dict(action.choices)


def options_of(command: argparse.ArgumentParser) -> set[str]:
    """All that a subcommand takes, as `--name`."""
    return {word for action in command._actions for word in action.option_strings}


def anchor_of(heading: str) -> str:
    """The anchor that GitHub gives a heading."""
    kept = re.sub(r"[^\w\- ]", "", heading.replace("`", "").lower())
    return kept.strip().replace(" ", "-")


def anchors(page: Path) -> set[str]:
    """The anchors of a page."""
    lines = page.read_text(encoding="utf-8").splitlines()
    return {anchor_of(line.lstrip("#")) for line in lines if re.match(r"#{1,6} ", line)}


def links(page: Path) -> Iterator[tuple[str, Path, str]]:
    """What a page links to inside the repository: as written, the file, the anchor."""
    for target in LINK.findall(page.read_text(encoding="utf-8")):
        if not target.startswith(("http:", "https:")):
            name, _, anchor = target.partition("#")
            yield target, (page.parent / name).resolve() if name else page, anchor


def code_lines(text: str) -> Iterator[str]:
    """Indented lines, and what stands between backticks."""
    for line in text.splitlines():
        if line.startswith("    "):
            yield line.strip()
        else:
            yield from CODE_SPAN.findall(line)


def calls(text: str) -> Iterator[tuple[str, str]]:
    """Every `armwright COMMAND ...` of a text: the command and the rest of its line, without the remark."""
    for line in code_lines(text):
        if found := CALL.search(line.partition(" #")[0]):
            yield found[1], found[2]


@pytest.mark.parametrize("page", DOCUMENTS, ids=lambda page: page.name)
def test_every_link_and_anchor_resolves(page: Path) -> None:
    for target, file, anchor in links(page):
        assert file.exists(), f"{page.name}: {target}: no such file"
        assert not anchor or anchor in anchors(file), f"{page.name}: {target}: no such heading in {file.name}"


@pytest.mark.parametrize("page", DOCUMENTS, ids=lambda page: page.name)
def test_every_command_that_is_named_exists_with_its_options(page: Path) -> None:
    known = subcommands()
    for name, rest in calls(page.read_text(encoding="utf-8")):
        assert name in known, f"{page.name}: armwright {name}: no such command"
        strange = {word for word in OPTION.findall(rest) if word not in options_of(known[name])}
        assert not strange, f"{page.name}: armwright {name} has no {', '.join(sorted(strange))}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_option_in_a_page_is_one_of_some_command(page: Path) -> None:
    known = set.union(*(options_of(command) for command in subcommands().values())) | OF_BENCHMARKS | OF_LEROBOT
    text = "\n".join(code_lines(page.read_text(encoding="utf-8")))
    elsewhere = "\n".join(line for line in text.splitlines() if "python" not in line and "nc -UN" not in line)
    assert set(OPTION.findall(elsewhere)) <= known


@pytest.mark.parametrize("name", subcommands())
def test_help_says_of_every_option_what_it_is(name: str) -> None:
    """The pages leave to it what an option means, its unit and its default."""
    actions = [action for action in subcommands()[name]._actions if action.option_strings]
    assert [action.option_strings[-1] for action in actions if len((action.help or "").split()) < 2] == []


def test_every_page_is_reached_from_the_readme_or_the_commands() -> None:
    entries = (ROOT / "README.md", ROOT / "docs" / "commands.md")
    reached = {file for entry in entries for _, file, _ in links(entry)}
    assert [page.name for page in PAGES if page not in reached] == []


def test_every_command_is_in_the_list_of_commands() -> None:
    text = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
    assert [name for name in subcommands() if not re.search(rf"`(armwright )?{name}\b", text)] == []


POWER_ROWS = ["power-up", "ids", "line", "current", "brown-out", "its own error", "emergency stop", "the host is gone"]
OUTCOMES = ("refused", "told", "unchecked", "set at", "at `enable`", "not relied on", "too slow: refused")


def below(page: Path, heading: str) -> str:
    """What stands under a heading, up to the next one of its level."""
    return page.read_text(encoding="utf-8").partition(f"## {heading}\n")[2].partition("\n## ")[0]


def rows_of(page: Path, heading: str) -> list[list[str]]:
    """The cells of the table under a heading, without its first two lines."""
    table = [line for line in below(page, heading).splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table[2:]]


def power_rows(page: str) -> list[str]:
    """Of which moments a page says what happens."""
    return re.findall(r"^- ([^:]+): \S", below(ROOT / "docs" / f"{page}.md", "Power and faults"), re.MULTILINE)


def test_what_happens_without_torque_supply_or_host_is_said_of_every_kind_of_board() -> None:
    """For all on one page; that of a kind says, in the same order, what is otherwise there."""
    assert power_rows("boards") == POWER_ROWS
    assert {kind: [row for row in POWER_ROWS if row in power_rows(kind)] for kind in KINDS} == {
        kind: power_rows(kind) for kind in KINDS
    }
    done = rows_of(ROOT / "docs" / "boards.md", "What a board does")
    assert sorted(kind.strip("`") for kind, *_ in done) == sorted(KINDS)
    assert [row for row in done if "" in row] == []


def test_the_table_of_boards_has_what_each_kind_offers() -> None:
    text = (ROOT / "docs" / "boards.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| \[`(\w+)`\]\(\w+\.md\) \| (serial|CAN)[^|]*\| (\d) \| ([^|]+) \| (\w+)", text, re.MULTILINE)
    modes = {name: tuple(re.findall(r"voltage|current|position", words)) for name, _, _, words, _ in rows}
    assert modes == {name: kind.modes for name, kind in KINDS.items()}
    assert {name: (line.lower(), int(motors)) for name, line, motors, _, _ in rows} == {
        name: (kind.line, kind.motors) for name, kind in KINDS.items()
    }
    absolute = {name for name, kind in KINDS.items() if kind.is_absolute or kind.may_be_absolute}
    assert {name for name, *_, encoder in rows if encoder == "absolute"} == absolute


SECTIONS = [
    "Wiring",
    "Settings",
    "arm.toml",
    "What it does otherwise",
    "Power and faults",
    "Assumed of the board",
    "Limits and traps",
]


@pytest.mark.parametrize("kind", KINDS)
def test_every_bought_board_has_the_same_sections_and_table(kind: str) -> None:
    """For each assumption its source and what the connection does."""
    page = ROOT / "docs" / f"{kind}.md"
    text = page.read_text(encoding="utf-8")
    headings = re.findall(r"^## (.+)$", text, re.MULTILINE)
    assert headings == [section for section in SECTIONS if section in headings]
    assumed = rows_of(page, "Assumed of the board")
    cited = {number for *_, source, _ in assumed for number in source.split(", ") if number}
    sources = text.partition("Sources: ")[2].partition("\n#")[0]
    assert len(assumed) > 5
    assert [row for row in assumed if not row[-1].startswith(OUTCOMES)] == []
    assert sorted(cited) == [number for number in "1234" if re.search(rf"\b{number} [a-zA-Z]", sources)]


@functools.cache
def code_files() -> tuple[Path, ...]:
    """Every Python file of the repository."""
    return tuple(file for folder in CODE for file in (ROOT / folder).rglob("*.py"))


@functools.cache
def tails() -> frozenset[str]:
    """Every file and folder of the code as one may name it: with all of the folders above it, or with the last of them."""
    paths = [path.relative_to(ROOT).parts for folder in CODE for path in (ROOT / folder).rglob("*")]
    return frozenset(
        "/".join(parts[start:]) for parts in (*paths, *((name[:-1],) for name in CODE)) for start in range(len(parts))
    )


def spread(name: str) -> list[str]:
    """`a/{b,c}/d` as `a/b/d` and `a/c/d`."""
    found = re.search(r"{([\w,]+)}", name)
    return [name] if found is None else [one for word in found[1].split(",") for one in spread(name.replace(found[0], word, 1))]


def is_a_name(dotted: str) -> bool:
    """Whether a dotted name is a package, a module, or a name that stands in one."""
    parts = dotted.split(".")
    for count in range(len(parts), 0, -1):
        place = ROOT.joinpath(*parts[:count])
        source = place / "__init__.py" if place.is_dir() else place.with_suffix(".py")
        if source.exists():
            return count == len(parts) or bool(re.search(rf"\b{parts[count]}\b", source.read_text(encoding="utf-8")))
    return False


def strange_names(text: str) -> list[str]:
    """Paths, files and dotted names of a text that lead nowhere."""
    paths = [one for name in PATH.findall(text) for one in spread(name.rstrip(".,-"))]
    dotted = [name for name in DOTTED.findall(text) if not name.endswith(OTHER_FILE)]
    short = [one for name in FILE_OF_CODE.findall(text) for one in spread(name)]
    return [
        *(name for name in paths if not (ROOT / name).exists()),
        *(name for name in dotted if not is_a_name(name)),
        *(name for name in short if name not in tails() | SETUPTOOLS | MADE),
    ]


PLAIN = [*DOCUMENTS, ROOT / "Makefile", ROOT / "pyproject.toml", *(ROOT / "tests" / "real").rglob("*.md")]


@pytest.mark.parametrize("file", PLAIN, ids=lambda file: str(file.relative_to(ROOT)))
def test_every_path_and_module_that_a_document_names_exists(file: Path) -> None:
    assert strange_names(file.read_text(encoding="utf-8")) == []


def test_every_path_and_module_that_a_comment_or_docstring_names_exists() -> None:
    found = {
        f"{file.relative_to(ROOT)}: {name}"
        for file in code_files()
        for words in WORDS_OF_CODE.findall(file.read_text(encoding="utf-8"))
        for name in strange_names(words)
    }
    assert found == set()


def test_every_folder_that_the_architecture_names_exists() -> None:
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    named = {name.rstrip("/") for name in FOLDER.findall(text)}
    assert len(named) > 20
    assert named - tails() == set()


def test_names_of_the_architecture_below_a_room_exist() -> None:
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    named = re.findall(r"`((?:\w+/)+\w+\.[a-z_]\w*)`", text)
    names = [name.replace("/", ".") for name in named if not name.endswith((".py", *OTHER_FILE))]
    assert len(names) >= 4
    assert [name for name in names if not any(is_a_name(f"{room}.{name}") for room in PACKAGES)] == []


def test_code_and_documents_name_pages_that_exist() -> None:
    for file in (*code_files(), *DOCUMENTS):
        for name in FILE_IN_TEXT.findall(file.read_text(encoding="utf-8")):
            assert (ROOT / name).exists(), f"{file.relative_to(ROOT)}: {name}: no such file"


@pytest.mark.parametrize("page", DOCUMENTS, ids=lambda page: page.name)
def test_every_target_of_make_that_is_named_exists(page: Path) -> None:
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    lines = code_lines(page.read_text(encoding="utf-8"))
    assert [name for line in lines for name in MAKE.findall(line.partition(" #")[0]) if name not in targets] == []


def test_the_readme_fits_two_screens() -> None:
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 92
    assert [line for line in lines if len(line) > 140] == []


@pytest.mark.parametrize("name", EFFECTS)
def test_every_effect_and_its_parameters_are_in_the_formats(name: str) -> None:
    text = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8").replace("{i}", "<i>")
    (row,) = [line for line in text.splitlines() if line.startswith(f"| `{name}` |")]
    assert [parameter for parameter in parameter_names(EFFECTS[name]) if f"`{parameter}`" not in row] == []


def test_the_columns_of_points_and_logs_are_those_that_the_reader_obeys() -> None:
    text = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")
    assert documented(POINTS) in text
    assert documented(LOG) in text


@pytest.mark.parametrize("file", [Arm, CellFile, Scenario, TolerancesFile])
def test_every_key_and_table_of_a_toml_file_is_explained(file: type) -> None:
    found = sections(file)
    assert [section.header for section in found if not section.about] == []
    assert [(section.header, key.name) for section in found for key in section.keys if not key.text] == []
