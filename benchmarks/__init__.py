"""Measured claims, compared with peers, in one run: `python -m benchmarks`."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # for us and for peers, as in console.main
