"""A task for tests of executors: a module's function, so that other processes can import it."""

import os
import signal

import numpy as np

from calib.studies import Results, task_rng


def drawn(shared: int, number: int) -> Results:
    """Random numbers of the task's own seed."""
    return {"values": task_rng(shared, number).standard_normal(5), "number": np.array([float(number)])}


def dies(shared: int, number: int) -> Results:
    """A process that is killed in its second task, as by a lack of memory."""
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return drawn(shared, number)
