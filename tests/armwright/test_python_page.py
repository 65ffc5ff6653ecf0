"""The examples of docs/python.md, run as one program in the order of the page."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

PAGE = (Path(__file__).parents[2] / "docs" / "python.md").read_text("utf-8")
EXAMPLES = re.findall(r"^```python\n(.*?)^```", PAGE, re.M | re.S)


@pytest.mark.usefixtures("nobody_below")
def test_the_examples_do_what_the_page_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(EXAMPLES) == 6
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    for number, example in enumerate(EXAMPLES, 1):
        exec(compile(example, f"docs/python.md, example {number}", "exec"), names)
    np.testing.assert_allclose(names["joint_rad"], [0.1, -0.6, 0.9], atol=1e-9)
    np.testing.assert_allclose(names["samples"].tip_m[0], names["start_m"], atol=1e-9)
    assert names["status"].mode == "HOLDING"
    assert np.abs(names["error_m"]).max() < 1e-3
    assert np.abs(names["following_error_rad"][names["moving"]]).max() < 5e-3
    assert names["result"].is_good
    assert names["comparison"].after.mean_m < 0.1 * names["comparison"].before.mean_m
    assert "belt_coupling on joint 3" in names["gap"].named
    assert sorted(path.name for path in tmp_path.iterdir()) == ["calibrated", "gap", "log"]
