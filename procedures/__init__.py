"""Procedures that guide an operator through a job step by step: bring-up, tuning, sessions, recordings, verification, demos."""

from firmware_iface.installation import claim

claim()
