"""What the parts of a run's driver side share."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import count

from distributed import Client

from poolpart import Partition, trace


@dataclass(frozen=True)
class SurveyRun:
    """One run of a survey on one cluster.

    Parameters
    ----------
    id
        What its keys and pipes are told apart by from those of other runs.
    client
        Client of the cluster.
    gpu, lidar
        The partitions that it runs on.
    """

    id: str
    client: Client
    gpu: Partition
    lidar: Partition
    _numbers: Iterator[int] = field(default_factory=count, repr=False)

    def key(self, name: str, number: int | None = None) -> str:
        """Make a key of a task, or the name of a pipe."""
        return f"{name}-{self.id}" + ("" if number is None else f"-{number}")

    def new_key(self, name: str, number: int) -> str:
        """Make a key that was not used before."""
        return f"{self.key(name, number)}.{next(self._numbers)}"

    def trace(self, event: str, stage: str, scans: Iterable[int], **fields: object) -> None:
        """Tell of a point that the driver passes."""
        trace(f"driver.{event}", run=self.id, stage=stage, scans=list(scans), **fields)

    def trace_duplicates(self, stage: str, scans: Sequence[int]) -> None:
        """Tell of scans that came once more, if there are any."""
        if scans:
            self.trace("duplicate", stage, scans)
