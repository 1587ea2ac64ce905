"""Shards that divide a run into equal parts, so that independent clusters can each compute one."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass

from lidarsim.errors import LidarError

_SLURM = [f"SLURM_ARRAY_TASK_{name}" for name in ("ID", "MIN", "MAX", "STEP", "COUNT")]
_KUBERNETES = ["JOB_COMPLETION_INDEX"]


def describe_shard(text: str) -> str:
    """Return the name of a shard for use in messages.

    Examples
    --------
    >>> describe_shard("3/10"), describe_shard("1/1")
    ('shard 3/10', 'the whole run')
    """
    return "the whole run" if text == "1/1" else f"shard {text}"


@dataclass(frozen=True, order=True)
class Shard:
    """One of several equal parts of a run.

    Raise LidarError if the number is not between 1 and the total.
    """

    number: int  # number of this shard, starting at 1
    total: int  # number of shards

    def __post_init__(self) -> None:
        if not 1 <= self.number <= self.total:
            raise LidarError(
                f"Shard {self} does not exist. The shard number must be from 1 to {self.total}."
            )

    def __str__(self) -> str:
        return f"{self.number}/{self.total}"

    @classmethod
    def parse(cls, text: str, environment: Mapping[str, str] = os.environ) -> Shard:
        """Parse the value of `--shard`.

        Parameters
        ----------
        text
            ``3/10``, ``auto`` to use the index of the task in a Slurm job array, or ``auto/10`` to
            use the completion index of the pod in a Kubernetes job with 10 pods.
        environment
            Environment variables, which contain these indices.

        Raises
        ------
        LidarError
            If the text is invalid, the shard does not exist, or an index is not available.
        """
        if not (match := re.fullmatch(r"(?:(\d+)|auto)/(\d+)|auto", text, re.ASCII)):
            raise LidarError(
                f"Invalid shard {text!r}. Expected N/M (such as 3/10), auto/M or auto."
            )
        if match[1]:
            return cls(int(match[1]), int(match[2]))
        names = _KUBERNETES if match[2] else _SLURM
        try:
            index, *array = (int(environment[name]) for name in names)
            first, last, step, count = array or (0, int(match[2]) - 1, 1, int(match[2]))
            if last != first + step * (count - 1):
                raise ValueError("the array task IDs are not evenly spaced")
            return cls((index - first) // step + 1, count)
        except (LookupError, ValueError, ZeroDivisionError) as error:
            variables = ", ".join(f"{name}={environment.get(name, '')}" for name in names)
            raise LidarError(
                f"The shard {text!r} cannot be determined from {variables}. Pass N/M instead, "
                "such as 3/10."
            ) from error

    def jobs(self, count: int) -> range:
        """Return the job indices of this shard in a campaign with `count` jobs.

        Consecutive jobs belong to different shards.
        """
        return range(self.number - 1, count, self.total)

    def scans(self, count: int) -> range:
        """Return the consecutive scan indices of this shard in a survey with `count` scans."""
        return range(count * (self.number - 1) // self.total, count * self.number // self.total)


ALL = Shard(1, 1)
