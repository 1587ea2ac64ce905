"""Process utilities for a single machine, such as forking, shared memory, logs and tracing."""
