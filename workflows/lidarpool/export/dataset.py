"""Data sets of many jobs: each job writes files of its own, `finish` those that all share."""

from __future__ import annotations

import io
import json
import re
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Literal, TypeVar

import numpy as np

from .._version import __version__
from ..base.errors import LidarpoolError, explained
from ..base.storage import Storage
from ..columns.cloud import CloudLike
from .boxes import Boxes
from .folder import local_folder
from .formats import Format
from .jobs import JobRow
from .nuscenes import merge
from .pieces import RANGE_PIECES, RANGE_POINTS, Entry, Pieces, Written, pieces_of
from .sweeps import MIXED_UP, SWEEPS_FILE, Sweeps
from .table import LAYOUTS

T = TypeVar("T")
U = TypeVar("U")

# {format of a data set: format of its jobs}
DATA_SETS = {
    "kitti": "kitti", "nuscenes": "nuscenes", "mcap": "mcap", "parquet": "parquet",
    "images": "images", "folder": "ply",
}  # fmt: skip
INDEX_FILE = "dataset.json"  # a data set with this file is finished
BOXES_FILE = "boxes.npz"
VERSION = 1  # of INDEX_FILE
_REQUESTS = 8  # to an object store at a time
# Files of jobs, in all formats, and that by which workers see whether they see the place.
OF_JOBS = re.compile(
    r"[0-9a-f]{16}-dataset|\.jobs/[^/]+\.json|(sweeps|boxes)/[^/]+\.npz|bags/[^/]+\.mcap|"
    r"jobs/[^/]+/(cloud\.ply|(sweeps|boxes)\.npz)|points/job=\d+/part-\d+\.parquet|"
    r"images/[^/]+/[^/]+/\d+\.npz|(samples|sweeps)/[^/]+/[^/]+/\d+\.pcd\.bin|poses/[^/]+\.txt|"
    r"sequences/[^/]+/((poses|times|calib)\.txt|(velodyne|labels|label_2)/\d+\.(bin|label|txt))"
)


def job_file(format: str, name: str, file: str) -> str:  # noqa: A002
    """Name of a job's SWEEPS_FILE or BOXES_FILE in a data set.

    Examples
    --------
    >>> job_file("kitti", "0417", "sweeps.npz"), job_file("folder", "0417", "sweeps.npz")
    ('sweeps/0417.npz', 'jobs/0417/sweeps.npz')
    """
    if format == "folder":  # where `read_cloud` finds them
        return f"jobs/{name}/{file}"
    stem, _, ending = file.partition(".")
    return f"{stem}/{name}.{ending}"


@dataclass(frozen=True)
class DataSet:
    """The files of many jobs in one place: small when pickled, any process writes a job.

    - kitti: `sequences/07` of job 7, of further sensors `sequences/07_NAME`
    - nuscenes: a scene for each job; `finish` writes the tables
    - mcap: `bags/NAME.mcap`
    - parquet: `points/job=7`, one table of Hive's partitions
    - images: `images/NAME/SENSOR/000000.npz`
    - folder: `jobs/NAME/cloud.ply`

    Beside these are `sweeps/NAME.npz` (`Sweeps`) and, where there are actors, `boxes/NAME.npz`,
    which `lidarpool.sweeps` reads; with `folder` they are in `jobs/NAME`. `.jobs/NAME.json` has
    what `finish` needs of a job, and is the last file that a job writes.

    Parameters
    ----------
    place
        A folder or URL. Without `durable` a power failure may lose jobs that were written.
    format
        kitti, nuscenes, mcap, parquet, images or folder.
    layout
        Of points in mcap: velodyne, autoware, ouster or images.
    """

    place: Storage
    format: Literal["kitti", "nuscenes", "mcap", "parquet", "images", "folder"]
    layout: Literal[tuple(LAYOUTS)] = "velodyne"  # type: ignore[valid-type]

    def __post_init__(self) -> None:
        if self.format not in DATA_SETS:
            raise LidarpoolError(
                f"format is {self.format!r}; that of a data set must be one of "
                f"{', '.join(DATA_SETS)}."
            )

    @property
    def _of_jobs(self) -> Format:
        return Format(DATA_SETS[self.format], self.layout)

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns that clouds of jobs must have."""
        return self._of_jobs.needs

    def check_installed(self) -> None:
        """Check that it can be written here; LidarpoolError if a package is missing."""
        self._of_jobs.check_installed()

    def write_job(self, number: int, name: str, cloud: CloudLike, sweeps: Sweeps) -> None:
        """Write the files of a job; whoever writes them again writes the same bytes.

        Points are read in order, a sweep at a time or, for Parquet, a million. Every file
        appears completely or not at all.

        Raises
        ------
        LidarpoolError
            If a package or column is missing, the cloud is not of these sweeps, or the place
            cannot be written to.
        """
        entry, one = Entry(number, name), self._of_jobs
        one.check_installed()
        one.check_columns(cloud)
        place = self.place
        with explained(f"Job {name} cannot be written to {place}"):
            if one.in_pieces:
                summary, made = _write_pieces(pieces_of(one.format, cloud, sweeps, entry), place)
            else:
                summary, made = {}, []
                path = f"jobs/{name}/{one.file}" if self.format == "folder" else f"bags/{name}.mcap"
                place.prepare(Path(path).parent)
                with local_folder(place.local() if place.is_local else place) as folder:
                    (folder / path).parent.mkdir(parents=True, exist_ok=True)
                    one.write(folder / path, cloud, sweeps, overwrite=True)
                    if not place.is_local:
                        place.put(folder / path, path)
            files = {job_file(self.format, name, SWEEPS_FILE): sweeps.packed()}
            if sweeps.actors:
                if len(made) != len(sweeps):  # the format is not of single sweeps
                    made = [
                        Boxes.of(sweeps, sweep, points)
                        for sweep, points in enumerate(sweeps.points(cloud))
                    ]
                files[job_file(self.format, name, BOXES_FILE)] = _packed(made)
            of_sensors = np.bincount(sweeps.sensor, minlength=len(sweeps.sensors)).tolist()
            summary |= {"sensors": [*zip(sweeps.sensors, of_sensors, strict=True)]}
            files[_summary_file(name)] = json.dumps(summary).encode()
            for file, data in files.items():
                place.prepare(Path(file).parent)
                place.write(file, data)

    def remove_job(self, number: int, name: str) -> None:
        """Remove the files of a job, as far as there are any; LidarpoolError if that fails."""
        place, own = self.place, f"{number:02}"
        with explained(f"Job {name} cannot be removed from {place}"):
            # First what says that it is there.
            place.remove([_summary_file(name)])
            if self.format == "kitti":
                for folder in ("sequences", "poses"):
                    for entry in place.below(folder).entries():
                        stem = entry.removesuffix(".txt")
                        if stem == own or stem.startswith(f"{own}_"):
                            place.discard(f"{folder}/{entry}", OF_JOBS)
            elif self.format == "nuscenes":
                for folder in ("samples", "sweeps"):
                    for channel in place.below(folder).entries():
                        place.discard(f"{folder}/{channel}/{name}", OF_JOBS)
            else:
                places = {
                    "mcap": f"bags/{name}.mcap",
                    "parquet": f"points/job={number}",
                    "images": f"images/{name}",
                    "folder": f"jobs/{name}",
                }
                place.discard(places[self.format], OF_JOBS)
            for file in (SWEEPS_FILE, BOXES_FILE):
                place.remove([job_file(self.format, name, file)])

    def finish(self, jobs: Iterable[JobRow]) -> None:
        """Write the files that hold all jobs, from those that are done, in their order.

        One job is in memory at a time, and its number of sweeps. No job may be written meanwhile.
        `dataset.json` is removed first and written last: it says that the data set is finished.

        Raises
        ------
        LidarpoolError
            If a job's files are not there, or the place cannot be written to.
        """
        with explained(f"{self.place} cannot be written"):
            self.place.remove([INDEX_FILE])
            self.place.tidy()
            with self.place.writing(INDEX_FILE) as file:
                head = {"lidarpool": __version__, "version": VERSION}
                head |= {"format": self.format, "layout": self.layout}
                file.write(f'{json.dumps(head)[:-1]}, "jobs": ['.encode())
                summaries = self._indexed(jobs, file)
                if self.format == "nuscenes":
                    merge(self.place, summaries)
                else:
                    deque(summaries, maxlen=0)
                file.write(b"\n]}\n")

    def _indexed(self, jobs: Iterable[JobRow], index: IO[bytes]) -> Iterator[dict[str, Any]]:
        """Yield what each job that is done has left, and add it to the index."""
        done = ((job.number, job.name) for job in jobs if job.done)
        comma = ""
        for (number, name), summary in _ahead(self._summary, done):
            row = {"number": number, "name": name, "sensors": summary["sensors"]}
            index.write(f"{comma}\n{json.dumps(row)}".encode())
            comma = ","
            yield summary

    def _summary(self, job: tuple[int, str]) -> dict[str, Any]:
        name = job[1]
        try:
            summary: dict[str, Any] = json.loads(self.place.read(_summary_file(name)))
        except (FileNotFoundError, ValueError) as error:
            raise LidarpoolError(
                f"Job {name} of {self.place} is not whole: its {_summary_file(name)} is missing or "
                "damaged. Make the job again."
            ) from error
        return summary


def _summary_file(name: str) -> str:
    return f".jobs/{name}.json"


def _write_pieces(pieces: Pieces, place: Storage) -> tuple[dict[str, Any], list[Any]]:
    """Write all pieces of a job; returns its summary, and what was made of the pieces."""
    for folder in pieces.folders:
        place.prepare(folder)
    if place.is_local:
        rows, made = pieces.write(place, 0, len(pieces))
    else:
        rows, made = _write_far(pieces, place)
    if rows != len(pieces.cloud):
        raise LidarpoolError(MIXED_UP)
    pieces.write_others(place, made)
    return pieces.summary(made), made


def _write_far(pieces: Pieces, place: Storage) -> Written:
    """Write pieces to where each file takes a request, several at a time."""
    count = len(pieces)
    by_points = RANGE_POINTS * count // max(1, len(pieces.cloud))
    size = max(1, min(RANGE_PIECES, by_points, count // _REQUESTS))
    spans = [(first, min(first + size, count)) for first in range(0, count, size)]
    with ThreadPoolExecutor(_REQUESTS, "write") as pool:
        written = [*pool.map(lambda span: pieces.write(place, *span), spans)]
    return sum(rows for rows, _ in written), [one for _, made in written for one in made]


def _packed(boxes: Sequence[Boxes]) -> bytes:
    """Boxes of all sweeps as a NumPy archive: float64 (n, a, 3), ... as the fields of `Boxes`."""
    memory = io.BytesIO()
    names = ("centres", "quaternions", "points", "there")  # sizes are those of the sweeps
    arrays: dict[str, Any] = {n: np.stack([getattr(one, n) for one in boxes]) for n in names}
    np.savez_compressed(memory, **arrays)
    return memory.getvalue()


def _ahead(function: Callable[[T], U], items: Iterable[T]) -> Iterator[tuple[T, U]]:
    """Yield items with their values in order, a few of which are asked for ahead."""
    with ThreadPoolExecutor(_REQUESTS, "read") as pool:
        waiting: deque[tuple[T, Future[U]]] = deque()
        try:
            for item in items:
                waiting.append((item, pool.submit(function, item)))
                if len(waiting) > 2 * _REQUESTS:
                    first, value = waiting.popleft()
                    yield first, value.result()
            while waiting:
                first, value = waiting.popleft()
                yield first, value.result()
        finally:
            pool.shutdown(cancel_futures=True)
