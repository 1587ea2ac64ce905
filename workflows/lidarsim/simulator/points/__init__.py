"""Points: the columns of returns, made on the host or on the CUDA device."""
