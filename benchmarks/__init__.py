"""Benchmarks, each of which runs with `python -m benchmarks.NAME` and prints its results."""

import os

# Before NumPy is loaded. Threads of its products of matrices wait busily for the next product, and
# this waiting would count in the processor time of whatever is measured next.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
