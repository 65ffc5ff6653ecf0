"""The systemd unit and the udev rules in the package: what they start is a command of this version."""

from __future__ import annotations

import configparser
import shlex

from console.main import parser
from tests.places import ROOT

SYSTEM = ROOT / "control" / "server" / "system"


def test_the_unit_starts_a_command_that_exists_and_lets_it_stop_the_arm() -> None:
    unit = configparser.ConfigParser(strict=False)
    unit.optionxform = str  # type: ignore[assignment,method-assign]
    unit.read_string((SYSTEM / "armwright.service").read_text())
    service = unit["Service"]
    program, *arguments = shlex.split(service["ExecStart"])
    assert program.endswith("/armwright")
    given = parser().parse_args(arguments)
    assert (given.arm, given.log) == ("/etc/armwright/arm.toml", "/var/log/armwright")
    assert int(service["LimitRTPRIO"]) >= 80
    assert service["LimitMEMLOCK"] == "infinity"
    assert service["Restart"] == "no", "a person looks at the arm first"
    assert int(service["TimeoutStopSec"]) >= 60, "of `off`, see control.server.client"


def test_every_udev_rule_matches_something_and_does_something() -> None:
    lines = (SYSTEM / "99-armwright.rules").read_text().splitlines()
    rules = [line for line in lines if line and not line.startswith("#")]
    assert rules
    for rule in rules:
        assert "==" in rule
        assert any(sign in rule for sign in ('="', '+="')), rule
