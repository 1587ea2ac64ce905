"""Compute the columns of points on the host or on a CUDA device."""
