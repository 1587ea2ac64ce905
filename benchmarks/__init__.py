"""Measurements; each module runs with `python -m benchmarks.NAME` and prints what it read."""

import os

# Before NumPy is loaded. Threads of its products of matrices wait busily for the next product, and
# this waiting would count in the processor time of whatever is measured next.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
