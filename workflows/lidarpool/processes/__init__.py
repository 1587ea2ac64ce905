"""Processes on a machine: forking, shared memory, output streams, logs and tracing."""
