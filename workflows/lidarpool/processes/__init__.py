"""Support for processes on one machine, such as forking, shared memory, logs and tracing."""
