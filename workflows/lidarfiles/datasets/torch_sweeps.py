"""PyTorch data sets that consist of sweeps.

This module is imported only when a `torch` method is called, because torch is an optional
dependency.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing
from typing import Any, Protocol, Self

import numpy as np
import torch
import torch.distributed
import torch.utils.data

from lidarsim.columns.sweep import Sweep
from lidarsim.errors import LidarError


class ReadSweeps(Protocol):
    """Protocol of sweeps that are read by index, such as the sweeps in a data set."""

    def __len__(self) -> int: ...

    def ahead(self, indices: Iterable[int]) -> Generator[Sweep]:
        """Yield the sweeps with the given indices in order, and prefetch the next ones."""
        ...


class JobStream(Protocol):
    """Protocol of a stream of a campaign's sweeps, ordered by job."""

    @property
    def numbers(self) -> Sequence[int]:
        """Numbers of all jobs in the stream."""
        ...

    def of_jobs(self, numbers: Sequence[int]) -> Self:
        """Return a stream that contains only the given jobs."""
        ...

    def __iter__(self) -> Generator[Sweep]: ...


class TorchSweeps(torch.utils.data.IterableDataset):
    """Iterable data set of stored sweeps, which are divided among ranks and workers."""

    def __init__(
        self, sweeps: ReadSweeps, transform: Callable[[Sweep], Any] | None, even: bool
    ) -> None:
        self.sweeps = sweeps
        self.transform = transform or tensors
        self.even = even
        self._rank: tuple[int, int] | None = None

    def __getstate__(self) -> dict[str, Any]:
        # Spawned workers do not know their rank, so it is stored when the object is pickled.
        return self.__dict__ | {"_rank": self._rank or _ranks()}

    def _share(self) -> range:
        rank, ranks = self._rank or _ranks()
        count = len(self.sweeps)
        return range(rank, count - count % ranks if self.even else count, ranks)

    def __iter__(self) -> Iterator[Any]:
        worker = torch.utils.data.get_worker_info()
        first, step = (0, 1) if worker is None else (worker.id, worker.num_workers)
        yield from map(self.transform, self.sweeps.ahead(self._share()[first::step]))


class TorchStream(torch.utils.data.IterableDataset):
    """Iterable data set of the sweeps in a `SweepStream`, with jobs divided among ranks."""

    def __init__(self, stream: JobStream, transform: Callable[[Sweep], Any] | None) -> None:
        self.stream = stream
        self.transform = transform or tensors

    def __iter__(self) -> Iterator[Any]:
        if torch.utils.data.get_worker_info() is not None:
            raise LidarError(
                "A stream can only be read in the training process, because the cluster "
                "prefetches sweeps. Set num_workers=0 for the DataLoader."
            )
        rank, ranks = _ranks()
        jobs = self.stream.numbers
        stream = self.stream.of_jobs(jobs[rank : len(jobs) - len(jobs) % ranks : ranks])
        with closing(iter(stream)) as sweeps:
            yield from map(self.transform, sweeps)


def _ranks() -> tuple[int, int]:
    distributed = torch.distributed
    if not (distributed.is_available() and distributed.is_initialized()):
        return 0, 1
    return distributed.get_rank(), distributed.get_world_size()


def tensors(sweep: Sweep) -> dict[str, Any]:
    """Convert a sweep to a dictionary of tensors, as `SavedSweeps.torch` describes."""
    boxes = sweep.boxes
    assert boxes is not None  # all sweeps of data sets have boxes
    arrays = {
        name: array.astype(np.int64) if array.dtype.kind in "iu" else array
        for name, array in sweep.columns.items()
    }
    arrays |= {"points": sweep.points, "pose": np.asarray(sweep.pose), "boxes": boxes.rows}
    arrays["box_objects"] = boxes.objects.astype(np.int64)
    arrays |= {f"box_{name}": values for name, values in boxes.visibility.items()}
    return {
        **{name: torch.from_numpy(np.ascontiguousarray(array)) for name, array in arrays.items()},
        "box_types": list(boxes.types),
        "job": sweep.job,
        "sensor": sweep.sensor,
        "number": sweep.number,
        "time_ns": sweep.time_ns,
    }
