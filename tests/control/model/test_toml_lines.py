"""The locator finds the line of every key of a TOML document."""

import tomllib
from typing import Any

import pytest
import tomli_w
from hypothesis import given, settings
from hypothesis import strategies as st

from control.model.reader import Path, key_lines, nearest_line

DOCUMENT = '''# comment with [brackets] and = signs
name = "a # no comment"
a.b.c = 1
"quoted key" = 'literal # here'

[[link]]          # first
d_m = 0.1
[link.inner]
x = """
multi = 1
[not.a.table]
""" # end
[[link]]
d_m = 0.2
points = [
  [1, 2],  # a comment, with ] and "
  [3,
   4],
]
table = { one = 1, "two" = { three = [1, { four = 4 }] } }

[other]
last = 1'''


@pytest.mark.parametrize(
    ("path", "line"),
    [
        (("name",), 2),
        (("a", "b", "c"), 3),
        (("quoted key",), 4),
        (("link", 0), 6),
        (("link", 0, "d_m"), 7),
        (("link", 0, "inner", "x"), 9),
        (("link", 1), 13),
        (("link", 1, "d_m"), 14),
        (("link", 1, "points", 0, 1), 16),
        (("link", 1, "points", 1, 1), 18),
        (("link", 1, "table", "two", "three", 1, "four"), 20),
        (("other", "last"), 23),
    ],
)
def test_every_key_and_element_is_found_on_its_line(path: Path, line: int) -> None:
    assert tomllib.loads(DOCUMENT)
    assert key_lines(DOCUMENT)[path] == line


def test_a_missing_key_is_reported_at_the_table_that_lacks_it() -> None:
    lines = key_lines(DOCUMENT)
    assert nearest_line(lines, ("link", 1, "alpha_rad")) == 13
    assert nearest_line(lines, ("nowhere",)) is None


def test_a_document_of_comments_has_no_keys() -> None:
    assert key_lines("# nothing\n\n   # more") == {}


_KEYS = st.text("ab-_1. \"'#[]", max_size=4)
_VALUES = st.recursive(
    st.integers(0, 9) | st.booleans() | st.text("x'\"#[]{}=\n,", max_size=6),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(_KEYS, inner, max_size=3),
    max_leaves=8,
)


@settings(max_examples=200, deadline=None)
@given(st.dictionaries(_KEYS, _VALUES, max_size=4))
def test_any_document_is_scanned_to_its_end_and_no_key_is_left_out(document: dict[str, Any]) -> None:
    lines = key_lines(tomli_w.dumps(document))
    for path in _paths(document):
        assert path in lines


def _paths(thing: Any, path: Path = ()) -> list[Path]:
    if isinstance(thing, dict):
        inner = [p for key, value in thing.items() for p in _paths(value, (*path, key))]
    elif isinstance(thing, list):
        inner = [p for index, value in enumerate(thing) for p in _paths(value, (*path, index))]
    else:
        inner = []
    return inner + ([path] if path else [])
