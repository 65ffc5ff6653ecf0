"""The operator's commands and screen."""

from firmware_iface.installation import claim

claim()
