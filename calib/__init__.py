"""Measured against modelled: table sessions, identification of DH deviations, verification, report."""
