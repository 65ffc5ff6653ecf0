"""Drivers of bought boards: each opens its boards, and is listed in `control.hardware.connect`."""
