"""The arm and how it moves."""

from firmware_iface.installation import claim

claim()
