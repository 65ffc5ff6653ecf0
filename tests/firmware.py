"""Whether this machine can run the firmware in C."""

import pytest

from hil_mocks.firmware import compiler

needs_compiler = pytest.mark.skipif(compiler() is None, reason="no C compiler: apt-get install gcc")
