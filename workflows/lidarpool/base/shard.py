"""Shards: equal shares of a run that several clusters do, each without the others."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass

from lidarsim.base.errors import LidarError

_SLURM = [f"SLURM_ARRAY_TASK_{name}" for name in ("ID", "MIN", "MAX", "STEP", "COUNT")]
_KUBERNETES = ["JOB_COMPLETION_INDEX"]


def shard_in_words(text: str) -> str:
    """Return a shard in words, of its text: «shard 3/10», or «the whole run»."""
    return "the whole run" if text == "1/1" else f"shard {text}"


@dataclass(frozen=True, order=True)
class Shard:
    """Share `number` of `of` shares, counted from 1; LidarError if there is no such share."""

    number: int
    of: int

    def __post_init__(self) -> None:
        if not 1 <= self.number <= self.of:
            raise LidarError(
                f"there is no shard {self}: they are 1/{self.of} to {self.of}/{self.of}."
            )

    def __str__(self) -> str:
        return f"{self.number}/{self.of}"

    @classmethod
    def parse(cls, text: str, environment: Mapping[str, str] = os.environ) -> Shard:
        """Read ``3/10``; ``auto``, the task of a Slurm array; or ``auto/10``, a pod's index.

        LidarError if it is none of them, or there is no such shard, array or index.
        """
        if not (found := re.fullmatch(r"(?:(\d+)|auto)/(\d+)|auto", text, re.ASCII)):
            raise LidarError(f"{text!r} is no shard: give 3/10, auto/10 or auto.")
        if found[1]:
            return cls(int(found[1]), int(found[2]))
        names = _KUBERNETES if found[2] else _SLURM
        try:
            index, *array = (int(environment[name]) for name in names)
            first, last, step, count = array or (0, int(found[2]) - 1, 1, int(found[2]))
            if last != first + step * (count - 1):
                raise ValueError("the tasks of the array are not evenly spaced")
            return cls((index - first) // step + 1, count)
        except (LookupError, ValueError, ZeroDivisionError) as error:
            told = ", ".join(f"{name}={environment.get(name, '')}" for name in names)
            raise LidarError(f"{text!r} finds no shard in {told}: give 3/10.") from error

    def jobs(self, count: int) -> range:
        """Return the jobs of the share, of so many: neighbouring jobs are in different shares."""
        return range(self.number - 1, count, self.of)

    def scans(self, count: int) -> range:
        """Return the scans of the share, of so many: they are consecutive."""
        return range(count * (self.number - 1) // self.of, count * self.number // self.of)


ALL = Shard(1, 1)
