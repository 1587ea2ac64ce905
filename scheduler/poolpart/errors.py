"""Exceptions that pools, partitions and pipes raise."""


class PoolError(RuntimeError):
    """Raised if a pool or a partition cannot be used as requested."""


class PipeClosed(Exception):  # noqa: N818 - not an error, like StopIteration
    """Raised by `put` if the pipe is closed, and by `get` if the pipe is closed and empty."""


class PipeFailed(RuntimeError):  # noqa: N818 - describes the state of the pipe
    """Raised by pipe methods if the pipe has failed. The message contains the reason."""


class TaskTimeoutError(PoolError):
    """Raised for a task that ran longer than its `timeout_s`."""
