"""Measured claims, beside peers, in one run: `python -m benchmarks`."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # for us and for peers, as console.main has it
