"""`python -m armwright`: the command `armwright`."""

import sys

from firmware_iface.interrupts import run_command

if __name__ == "__main__":
    sys.exit(run_command())
