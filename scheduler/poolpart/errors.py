"""What can go wrong with pools and pipes; a leaf module."""


class PoolError(RuntimeError):
    """A pool cannot be divided as asked, or lacks what a job needs."""


class PipeClosed(Exception):  # noqa: N818 - like StopIteration: an end, not an error
    """A pipe was closed and, for a consumer, everything in it was taken."""


class PipeFailed(RuntimeError):  # noqa: N818 - reads as what happened to the pipe
    """Somebody declared that a pipe's work has failed; the message is the reason."""
