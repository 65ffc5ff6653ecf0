"""Simulated robot: plant, boards and camera."""

from firmware_iface.installation import claim

claim()
