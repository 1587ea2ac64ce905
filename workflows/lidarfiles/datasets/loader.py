"""Read the sweeps of data sets with many jobs, for example for training."""

from __future__ import annotations

import operator
import os
import threading
from bisect import bisect_right
from collections import OrderedDict, deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from itertools import islice, tee
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim.columns.cloud import Cloud
from lidarsim.columns.sweep import Sweep
from lidarsim.environment.extras import install_command
from lidarsim.errors import LidarError, as_sentence
from lidarsim.io.archives import open_archive
from lidarsim.io.storage import Storage
from lidarsim.schema.checks import check_list, check_number
from lidarsim.sweeps.sweeps import SWEEPS_FILE, Sweeps
from lidarsim.words import did_you_mean, join_names, plural

from ..clouds.boxes import Boxes, BoxVisibility
from ..clouds.built_in_formats import DATA_SETS
from ..clouds.folder import check_exists
from ..clouds.job_reader import Entry, JobReader
from ..identity.sealed import unseal_json
from .dataset import BOXES_FILE, INDEX_FILE, VERSION, DataSet, job_file
from .job_table import TABLE_FILE, WRITE_AGAIN, JobRow, read_table
from .sweep_data import is_compensated, sweep_of_job

_REQUESTS = 8  # number of sweeps read concurrently from a URL or disk
_OPEN_JOBS = 16  # number of jobs that each thread keeps open, with their poses, boxes and files


@dataclass(frozen=True)
class _Run:
    job: JobRow
    first: int
    count: int


class SavedSweeps:
    """Sequence of the sweeps in a data set. The function `sweeps` returns it.

    Items are read when they are accessed, and iteration prefetches the next items in background
    threads. Items can be accessed from several threads, from forked processes, and from processes
    with a pickled copy. `classes` contains the names of semantic classes as {number: name}.
    """

    classes: Mapping[int, str]

    def __init__(self, dataset: DataSet, runs: Sequence[_Run], shuffle: int | None) -> None:
        self._dataset = dataset
        self._runs = runs
        self._run_stops = np.cumsum([run.count for run in runs], dtype=np.int64)
        self._order = None  # int64 (n,): 8 bytes for each sweep
        if shuffle is not None:
            self._order = np.random.default_rng(shuffle).permutation(len(self))
        self._local = threading.local()

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "_local"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__ |= state | {"_local": threading.local()}

    def __repr__(self) -> str:
        return f"<{len(self):,} sweeps of {self._dataset.storage} ({self._dataset.format})>"

    def __len__(self) -> int:
        return int(self._run_stops[-1]) if len(self._run_stops) else 0

    def __iter__(self) -> Iterator[Sweep]:
        return self.ahead(range(len(self)))

    def ahead(self, indices: Iterable[int]) -> Generator[Sweep]:
        """Yield the sweeps with the given indices in order, and prefetch the next ones."""
        cloud_format = self._dataset.spec.cloud_format
        is_local = self._dataset.storage.is_local
        if is_local and cloud_format.raw_sweeps:
            # Passing such a sweep between threads would take as long as reading it.
            upcoming, current = tee(map(self._locate, indices))
            for job, number in islice(upcoming, _REQUESTS):
                job.prefetch(number)
            for job, number in current:
                for next_job, sweep in islice(upcoming, 1):
                    next_job.prefetch(sweep)
                yield job.read(number)
            return
        # Requests to a URL are slow, so they run in parallel. With a single thread, a job that
        # stores all its sweeps in one file is opened only once.
        threads = _REQUESTS if cloud_format.separate_sweeps and not is_local else 1
        coming: deque[Future[Sweep]] = deque()
        with ThreadPoolExecutor(threads, "sweeps") as pool:
            try:
                for index in indices:
                    coming.append(pool.submit(self.__getitem__, index))
                    if len(coming) > 2 * threads:
                        yield coming.popleft().result()
                while coming:
                    yield coming.popleft().result()
            finally:
                for task in coming:
                    task.cancel()
                with suppress(RuntimeError):  # the pool rejects tasks at interpreter shutdown
                    pool.submit(self._close)

    def __getitem__(self, index: int) -> Sweep:
        """Read a sweep.

        Raises LidarError if a file is missing or damaged, and IndexError if the sweep does not
        exist.
        """
        job, number = self._locate(index)
        return job.read(number)

    def fired(self, index: int) -> Sweep:
        """Read a sweep whose points are as fired, with its `firing_poses`.

        Raises the same errors as reading an item. The sweeps must have firing poses (see
        `have_firing_poses`).
        """
        job, number = self._locate(index)
        sweep = job.read(number)
        columns = dict(sweep.columns)
        # Range images have times, but no scans, which then only correct jumps of the clock.
        columns.setdefault("scan", np.full(len(sweep), job.sweeps.scans[number]))
        poses = job.sweeps.firing_poses(number, Cloud(sweep.points, columns))
        return sweep.replace(firing_poses=poses)

    def _locate(self, index: int) -> tuple[_OpenJob, int]:
        """Return the open job that contains a sweep, and the sweep's index in this job."""
        position = operator.index(index)
        position += len(self) if position < 0 else 0
        if not 0 <= position < len(self):
            raise IndexError(
                f"there is no sweep {index}, because the data set has {len(self)} sweeps"
            )
        if self._order is not None:
            position = int(self._order[position])
        run_index = bisect_right(self._run_stops, position)
        run = self._runs[run_index]
        number = run.first + position - (int(self._run_stops[run_index]) - run.count)
        return self._opened(run.job), number

    def are_compensated(self) -> bool | None:
        """Return whether the sweeps are motion-compensated, or None if it differs between jobs.

        Raises LidarError if a file is missing or damaged.
        """
        dataset = self._dataset
        if is_compensated(dataset.spec, "sensor"):
            return True
        stated = {
            is_compensated(dataset.spec, dataset.read_coordinates(job))
            for job in dict.fromkeys(run.job.name for run in self._runs)
        }
        return stated.pop() if len(stated) == 1 else None

    def have_firing_poses(self) -> bool:
        """Return whether the points of all sweeps are as fired, and their firing poses are known.

        They are unknown in bags, whose points have no times on the clock of the survey.
        """
        return self.are_compensated() is False and self._dataset.spec.cloud_format.frame == "cloud"

    def torch(self, transform: Callable[[Sweep], Any] | None = None, *, even: bool = True) -> Any:
        """Return the sweeps as a `torch.utils.data.IterableDataset`.

        The sweeps are divided among the workers of a DataLoader, and among the ranks of
        torch.distributed if it is initialized when the loader starts. Each sweep is read by a
        single worker.

        Parameters
        ----------
        transform
            Function that converts a sweep to an item. By default, an item is a dictionary with the
            tensors `points`, `pose`, the columns (integers as int64), `boxes` (shape (k, 7):
            center, length, width, height and yaw) and `box_objects`, and with `box_types`, `job`,
            `sensor`, `number` and `time_ns`.
        even
            Whether to omit the last sweeps, fewer than the number of ranks, so that all ranks have
            the same number of sweeps. If the numbers differ, training with DistributedDataParallel
            does not terminate.

        Raises
        ------
        LidarError
            If torch is not installed.
        """
        if find_spec("torch") is None:
            raise LidarError(f"This method requires PyTorch. Run {install_command('torch')}.")
        from .torch_sweeps import TorchSweeps

        return TorchSweeps(self, transform, even)

    def _close(self) -> None:
        for job in self._local.__dict__.pop("jobs", {}).values():
            job.reader.close()
        self._local.__dict__.clear()

    def _opened(self, job: JobRow) -> _OpenJob:
        """Return a job that is open in the current thread, using the cache if possible."""
        local = self._local
        if getattr(local, "process", None) != os.getpid():  # forked processes share file offsets
            local.process = os.getpid()
            local.jobs = OrderedDict()
        jobs: OrderedDict[int, _OpenJob] = local.jobs
        if job.number not in jobs:
            jobs[job.number] = _OpenJob(self._dataset, job, self.classes)
            if len(jobs) > _OPEN_JOBS:
                jobs.popitem(last=False)[1].reader.close()
        jobs.move_to_end(job.number)
        return jobs[job.number]


class _OpenJob:
    """Open job with its poses, its boxes and the reader of its files."""

    def __init__(self, dataset: DataSet, job: JobRow, classes: Mapping[int, str]) -> None:
        self.storage = storage = dataset.storage
        self.job = job
        self.spec = dataset.spec
        self.cloud_format = self.spec.cloud_format
        name = job_file(dataset.format, job.name, SWEEPS_FILE)
        self.sweeps = Sweeps.load(storage.path(name), partial(storage.read, name))
        self.boxes: Boxes | None = None
        if self.sweeps.actors:
            name = job_file(dataset.format, job.name, BOXES_FILE)
            with open_archive(storage.path(name), partial(storage.read, name)) as arrays:
                sizes = np.broadcast_to(
                    np.ptp(self.sweeps.actor_bounds, axis=1), arrays["centers"].shape
                )
                boxes = Boxes(
                    arrays["centers"],
                    arrays["quaternions"],
                    sizes,
                    arrays["points"],
                    present=arrays["there"],
                    visibility=BoxVisibility.from_arrays(arrays),
                )
                self.boxes = boxes.to_sensor_frame(self.sweeps.pose, slice(None))
        entry = Entry(job.number, job.name, job.split)
        self.reader = JobReader(storage, self.sweeps, entry, dataset.layout, classes)

    def prefetch(self, sweep: int) -> None:
        """Ask the operating system to load a sweep's files into its page cache."""
        self.reader.prefetch(self.cloud_format.sweep_files(self.reader, sweep))

    def read(self, sweep: int) -> Sweep:
        try:
            points = self.cloud_format.read_sweep(self.reader, sweep)
        except Exception as error:  # the libraries of five formats raise many types of errors
            file = self.reader.last_file or self.cloud_format.sweep_files(self.reader, sweep)[0]
            file = self.storage.path(file)
            raise _unreadable(file, error) from error
        compensated = is_compensated(self.spec, self.sweeps.coordinates)
        return sweep_of_job(
            self.job, self.sweeps, sweep, points, self.boxes, sweep, compensated=compensated
        )


def sweeps(
    location: str | Path,
    *,
    split: str | Sequence[str] | None = None,
    jobs: Sequence[int | str] | None = None,
    sensors: Sequence[str] | None = None,
    shuffle: int | None = None,
) -> SavedSweeps:
    """Open the sweeps of a data set that a campaign wrote.

    Parameters
    ----------
    location
        Folder or URL of the data set.
    split
        Name of a split, or several names. By default, the jobs of all splits are used.
    jobs
        Numbers or names of jobs. By default, all jobs are used.
    sensors
        Names of sensors. By default, all sensors are used.
    shuffle
        Seed for a random order of the sweeps of all jobs. By default, sweeps are ordered by job,
        sensor and time. Use a different seed for each epoch.

    Returns
    -------
    A sequence of `Sweep` objects, which are read on access. Iteration prefetches a few sweeps in
    background threads. The order is the same in each iteration. The sequence requires memory for
    one row per job, for the poses and boxes of 16 jobs in each thread and, if shuffled, for 8 bytes
    per sweep.

    Raises
    ------
    LidarError
        If the data set is missing, unfinished or damaged, if a package that its format requires is
        not installed, or if the split, job or sensor is unknown.
    """
    for name, names in (("jobs", jobs), ("sensors", sensors)):
        if names is not None:
            check_list(name, names)
    if shuffle is not None:
        check_number("shuffle", shuffle, whole=True, ge=0)
    storage = replace(Storage.at(location), named="")  # the user's own links may be followed
    head = read_index(storage)
    dataset = DataSet(storage, head["format"], head["layout"], head["compensated"])
    dataset.check_installed()
    sweep_counts = head["jobs"]
    table = read_table(storage, head["table"])
    rows = [job for job in table if job.number in sweep_counts]
    if len(rows) < len(sweep_counts):
        raise LidarError(
            f"{storage.path(TABLE_FILE)} does not contain all completed jobs. "
            f"{as_sentence(WRITE_AGAIN)}"
        )
    rows = _chosen(rows, split, jobs, storage)
    sensor_names = list(dict.fromkeys(name for job in rows for name in sweep_counts[job.number]))
    if sensors is not None:
        _check_known("sensor", sensors, sensor_names, storage)
    runs = []
    for job in rows:
        first = 0
        for name, count in sweep_counts[job.number].items():
            if count and (sensors is None or name in sensors):
                runs.append(_Run(job, first, count))
            first += count
    saved = SavedSweeps(dataset, runs, shuffle)
    saved.classes = {int(number): name for number, name in head.get("classes", {}).items()}
    return saved


def read_index(storage: Storage) -> dict[str, Any]:
    """Read the index of a data set.

    The field `jobs` of the index maps job numbers to sweep counts by sensor.

    Raises LidarError if the data set is missing, unfinished or damaged.
    """
    check_exists(storage, "specify the output folder of a campaign")
    try:
        head = unseal_json(storage.read(INDEX_FILE))
        if head["version"] != VERSION:
            raise ValueError(f"its version is {head['version']} instead of {VERSION}")
        if head["format"] not in DATA_SETS:
            raise ValueError(f"its format is {head['format']!r}")
        if "table" not in head:
            raise ValueError(f"it contains no checksum of {TABLE_FILE}")
        head["jobs"] = {row["number"]: dict(row["sensors"]) for row in head["jobs"]}
    except FileNotFoundError as error:
        if ".jobs" in storage.entries():
            raise LidarError(
                f"{storage} contains an unfinished data set. Complete it with `lidarpool run "
                f"CAMPAIGN --out {storage} --resume`."
            ) from error
        raise LidarError(
            f"{storage} is not a lidarpool data set, because {INDEX_FILE} is missing. Specify "
            "the output folder of a campaign. To create a data set from a single scenario, run a "
            "campaign file with the two lines `base: scenario.yaml` and `keep: kitti`."
        ) from error
    except OSError as error:
        raise _unreadable(storage.path(INDEX_FILE), error) from error
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise LidarError(
            f"{storage.path(INDEX_FILE)} is damaged or was written by another version of "
            f"lidarpool ({error}). Run the campaign again with `--resume`, or merge its "
            "shards again."
        ) from error
    return head


def _chosen(
    rows: list[JobRow],
    split: str | Sequence[str] | None,
    jobs: Sequence[int | str] | None,
    storage: Storage,
) -> list[JobRow]:
    """Return the rows of the jobs that belong to one of the given splits and are among `jobs`."""
    if split is not None:
        splits = [split] if isinstance(split, str) else list(split)
        _check_known("split", splits, dict.fromkeys(row.split for row in rows), storage)
        rows = [row for row in rows if row.split in splits]
    if jobs is not None:
        requested = {operator.index(job) if not isinstance(job, str) else job for job in jobs}
        available = {row.number for row in rows} | {row.name for row in rows}
        if missing := [job for job in jobs if job not in available]:
            by_name = isinstance(missing[0], str)
            names = [row.name if by_name else row.number for row in rows]
            has = plural(len(names), "job") + (f": {names[0]} to {names[-1]}" if names else "")
            where = "" if split is None else f" in split {split!r}"
            raise LidarError(
                f"{storage} has no completed job {missing[0]!r}{where} ({has}). All jobs are "
                "listed in jobs.csv, with their splits and errors."
            )
        rows = [row for row in rows if row.number in requested or row.name in requested]
    return rows


def _check_known(label: str, requested: Sequence[str], available: Any, storage: Storage) -> None:
    """Raise LidarError if a requested split or sensor does not exist."""
    names = [name for name in available if name]
    for name in requested:
        if name not in available:
            hint = (
                f" The {label}s are {join_names(names)}."
                if names
                else f" None of its {label}s has a name."
            )
            raise LidarError(
                f"{storage} has no {label} {name!r}.{did_you_mean(name, names) or hint}"
            )


def _unreadable(file: str, error: Exception) -> LidarError:
    """Return a one-line error for a missing or damaged file."""
    if isinstance(error, LidarError):
        return error
    # Errors of remote storages have a cause instead of `strerror`.
    if isinstance(error, OSError) and (error.strerror or error.__cause__):
        return LidarError(f"{file} cannot be read: {error.strerror or error}.")
    reason = (str(error).splitlines() or [type(error).__name__])[0].rstrip(". ")[:120]
    return LidarError(
        f"{file} is missing or damaged: {reason}. Download it again, or remove its job from "
        "the data set and run the campaign with `--resume`."
    )
