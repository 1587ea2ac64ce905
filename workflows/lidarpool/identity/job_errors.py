"""Summaries of job errors, with one line for all jobs that have the same error."""

from __future__ import annotations

import re
from collections.abc import Iterable

from lidarsim.words import list_names

_NUMBER = re.compile(r"\bjob \d+: ")  # prefix with which an error message names its job
_VALUES = "\nThe values of the job are "  # text that introduces the varied values in a message


def summarize_errors(errors: Iterable[tuple[str, str]], max_jobs: int = 5) -> list[str]:
    """Return one line for each distinct error, listing the jobs that failed with it.

    Parameters
    ----------
    errors
        Name and error message of each failed job. Messages that differ only in the job number or
        in the values of the job are treated as the same error.
    max_jobs
        Number of jobs to list in a line. Further jobs are only counted.

    Examples
    --------
    >>> summarize_errors([("0001", "job 1: no hall"), ("0004", "job 4: no hall"), ("0009", "no")])
    ['jobs 0001, 0004: no hall', 'job 0009: no']
    """
    values_by_job: dict[str, dict[str, str]] = {}  # {message: {job: values of the job}}
    for job, message in errors:
        reason, _, values = message.partition(_VALUES)
        values_by_job.setdefault(_NUMBER.sub("", reason, count=1), {})[job] = values
    lines = []
    for reason, jobs in values_by_job.items():
        job_values = next(iter(jobs.values())) if len(jobs) == 1 else ""
        line = f"{'jobs' if len(jobs) > 1 else 'job'} {list_names([*jobs], max_jobs)}: {reason}"
        lines.append(f"{line}{_VALUES.replace(chr(10), ' ')}{job_values}" if job_values else line)
    return lines
