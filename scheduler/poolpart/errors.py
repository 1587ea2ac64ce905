"""Errors of pools and pipes."""


class PoolError(RuntimeError):
    """Raised when the pool or a partition cannot be used as requested."""


class PipeClosed(Exception):  # noqa: N818 - like StopIteration: an end, not an error
    """Raised when the pipe is closed and, for a consumer, also empty."""


class PipeFailed(RuntimeError):  # noqa: N818 - reads as what happened to the pipe
    """Raised when the pipe has failed. The message contains the reason."""
