"""Scenario and campaign files, and the jobs that are created from these files."""

from lidarsim.environment.lazy_names import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        ".job": "Job",
        ".plan": "Plan Planning",
    },
)
