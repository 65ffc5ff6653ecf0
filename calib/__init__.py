"""Calibration: table sessions, identification of DH deviations, verification, report."""

from firmware_iface.installation import claim

claim()
