"""The reference firmware in C (firmware_iface/firmware) on the mock's boards, as a shared library of this machine."""
