"""Shards: equal shares of a run that several clusters do, each without the others."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass

from .errors import LidarpoolError

_SLURM = [f"SLURM_ARRAY_TASK_{name}" for name in ("ID", "MIN", "STEP", "COUNT")]
_KUBERNETES = "JOB_COMPLETION_INDEX"


@dataclass(frozen=True)
class Shard:
    """Share `number` of `of` shares, counted from 1; by default all.

    LidarpoolError if there is no such share.

    Examples
    --------
    >>> [*Shard(3, 10).jobs(25)], [*Shard(3, 10).scans(25)]
    ([2, 12, 22], [5, 6])
    """

    number: int = 1
    of: int = 1

    def __post_init__(self) -> None:
        if not 1 <= self.number <= self.of:
            raise LidarpoolError(
                f"there is no shard {self}: shards are counted from 1, as 1/10 to 10/10."
            )

    def __str__(self) -> str:
        return f"{self.number}/{self.of}"

    @classmethod
    def parse(cls, text: str, environment: Mapping[str, str] = os.environ) -> Shard:
        """Read ``3/10``; ``auto``, the task of a Slurm array; or ``auto/10``, a pod's index.

        Raises
        ------
        LidarpoolError
            If it is none of them, there is no such shard, or no such array or index.

        Examples
        --------
        >>> Shard.parse("auto/10", {"JOB_COMPLETION_INDEX": "2"})
        Shard(number=3, of=10)
        """
        if not (found := re.fullmatch(r"(?:(\d+)|auto)/(\d+)|auto", text, re.ASCII)):
            raise LidarpoolError(f"{text!r} is no shard: give 3/10, auto/10 or auto.")
        number, of = found[1], found[2]
        if number:
            return cls(int(number), int(of))
        wanted = [_KUBERNETES] if of else _SLURM
        try:
            index, *array = (int(environment[name]) for name in wanted)
        except (KeyError, ValueError) as error:
            what = "the index of a Kubernetes job" if of else "the task of a Slurm array"
            raise LidarpoolError(
                f"--shard {text} takes {what} from {', '.join(wanted)}, which are not all set to "
                "whole numbers: give the shard as 3/10."
            ) from error
        if of:
            return cls(index + 1, int(of))
        first, step, count = array
        number, rest = divmod(index - first, max(1, step))
        if rest:
            raise LidarpoolError(f"the tasks of the Slurm array are not {step} apart: give 3/10.")
        return cls(number + 1, count)

    def jobs(self, count: int) -> range:
        """Return the jobs of the share, of so many: neighbouring jobs are in different shares."""
        return range(self.number - 1, count, self.of)

    def scans(self, count: int) -> range:
        """Return the scans of the share, of so many: they are consecutive."""
        return range(count * (self.number - 1) // self.of, count * self.number // self.of)


ALL = Shard()  # of which there is one
