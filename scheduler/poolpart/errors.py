"""Errors of pools and pipes."""


class PoolError(RuntimeError):
    """A pool cannot be divided as requested, or lacks workers or slots that a job needs."""


class PipeClosed(Exception):  # noqa: N818 - like StopIteration: an end, not an error
    """A pipe is closed and, for a consumer, empty."""


class PipeFailed(RuntimeError):  # noqa: N818 - reads as what happened to the pipe
    """A pipe was failed with `Pipe.fail`, whose reason is the message."""
