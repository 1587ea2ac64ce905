"""Errors of jobs as lines: one for each different error, with its jobs."""

from __future__ import annotations

import re
from collections.abc import Iterable

from lidarsim.base.words import listed

_NUMBER = re.compile(r"\bjob \d+: ")  # names the job in its error
_VALUES = "\nThe values of the job are "  # before the values of the job, in its error


def lines_of_errors(errors: Iterable[tuple[str, str]], max_jobs: int = 5) -> list[str]:
    """Return a line for each different error, with the jobs that have the error.

    Parameters
    ----------
    errors
        Words that name a job, and the message of its error. The number and the values of the job
        in the message make no difference.
    max_jobs
        Jobs that a line names; it counts the others.

    Examples
    --------
    >>> lines_of_errors([("0001", "job 1: no hall"), ("0004", "job 4: no hall"), ("0009", "no")])
    ['jobs 0001, 0004: no hall', 'job 0009: no']
    """
    values_by_job: dict[str, dict[str, str]] = {}  # {message: {job: its values}}
    for job, message in errors:
        reason, _, values = message.partition(_VALUES)
        values_by_job.setdefault(_NUMBER.sub("", reason, count=1), {})[job] = values
    lines = []
    for reason, jobs in values_by_job.items():
        of_job = next(iter(jobs.values())) if len(jobs) == 1 else ""
        line = f"{'jobs' if len(jobs) > 1 else 'job'} {listed([*jobs], max_jobs)}: {reason}"
        lines.append(f"{line}{_VALUES.replace(chr(10), ' ')}{of_job}" if of_job else line)
    return lines
