"""The links of the command line: ports and CAN options that replace those of arm.toml."""

import argparse

from control.errors import ArmError
from control.hardware.connect import LinkOptions


def link_options(args: argparse.Namespace) -> LinkOptions:
    """The links of the command line."""
    options = dict(_option(text) for text in args.can_option or ())
    return LinkOptions(tuple(args.encoder or ()), args.can_interface, args.can_channel, options)


def _option(text: str) -> tuple[str, int | str]:
    key, equals, value = text.partition("=")
    if not (key and equals and value):
        raise ArmError(f"--can-option: expected KEY=VALUE, got {text!r}")
    return key, int(value) if value.lstrip("-").isdigit() else value
