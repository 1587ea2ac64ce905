"""Write data sets that consist of many jobs.

Each job writes its own files, and `DataSet.finish` writes the files that all jobs share.
"""

from __future__ import annotations

import json
import re
import zlib
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache, partial
from itertools import islice
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from lidarsim._version import __version__
from lidarsim.columns.cloud import CloudLike
from lidarsim.errors import LidarError, explain_os_errors
from lidarsim.io.archives import pack_arrays
from lidarsim.io.named_files import leads_outside
from lidarsim.io.storage import Storage
from lidarsim.schema.checks import check_fields
from lidarsim.schema.value_texts import one_line
from lidarsim.sweeps.sweeps import SWEEPS_FILE, Sweeps

from ..clouds.boxes import Boxes, summarize_boxes
from ..clouds.built_in_formats import DATA_SETS, LAYOUTS
from ..clouds.cloud_format import CloudFormat
from ..clouds.folder import local_folder
from ..clouds.format_table import load_format
from ..clouds.job_reader import Entry
from ..clouds.multi_file_format import MultiFileFormat
from ..clouds.writing import ExportSpec
from ..identity.sealed import SealedWriter
from .job_table import TABLE_FILE, JobRow, Tally

T = TypeVar("T")
R = TypeVar("R")

INDEX_FILE = "dataset.json"  # a data set with this file is finished
BOXES_FILE = "boxes.npz"
_MANIFESTS = ".jobs"
VERSION = 2  # version of INDEX_FILE
_REQUESTS = 8  # simultaneous requests to an object store
_AHEAD = 16  # number of jobs that are read in advance
_MAX_LISTED_FOLDERS = 32  # cached folder listings; many jobs share the same folders


def _name_pattern(cloud_format: type[CloudFormat]) -> str:
    """Return a regular expression that matches the names of a job's files in a format."""
    folder = re.escape(cloud_format.job_path)
    folder = folder.replace(r"\{name\}", "[^/]+").replace(r"\{number\}", r"\d+")
    files = cloud_format.file_pattern
    return "/".join(filter(None, (folder, files and f"({files})")))


# Names of the files that jobs write, in all formats.
JOB_FILES = re.compile(
    r"\.jobs/[^/]+\.json|jobs/[^/]+/(sweeps|boxes)\.npz|(sweeps|boxes)/[^/]+\.npz|"
    + "|".join(_name_pattern(load_format(name)) for name in DATA_SETS.values())
)


def job_file(format: str, name: str, file: str) -> str:  # noqa: A002
    """Return the name of a job's SWEEPS_FILE or BOXES_FILE in a data set.

    Examples
    --------
    >>> job_file("kitti", "0417", "sweeps.npz"), job_file("folder", "0417", "sweeps.npz")
    ('sweeps/0417.npz', 'jobs/0417/sweeps.npz')
    """
    if format == "folder":  # `read_cloud` expects these files beside the cloud
        return f"jobs/{name}/{file}"
    stem, _, ending = file.partition(".")
    return f"{stem}/{name}.{ending}"


@dataclass(frozen=True)
class DataSet:
    """Data set of many jobs in a folder or object store.

    The object is small when pickled, so that any process can write jobs. The files depend on the
    format:

    - kitti: `sequences/07` for job 7, and `sequences/07_NAME` for its further sensors
    - nuscenes: a scene for each job; `finish` writes the tables
    - webdataset: `shards/SPLIT/NAME-000000.tar`, and `offsets/NAME.npz` to read single sweeps
    - mcap: `bags/NAME.mcap`
    - parquet: `points/job=7`, a table with Hive partitions
    - images: `images/NAME/SENSOR/000000.npz`
    - folder: `jobs/NAME/cloud.ply`

    In addition, each job has a `sweeps/NAME.npz` file (`Sweeps`) and, if there are actors, a
    `boxes/NAME.npz` file. `lidarpool.sweeps` reads both. In the folder format, they are in
    `jobs/NAME`.

    The last file that a job writes is its manifest, `.jobs/NAME.json`. The manifest lists the job's
    files with their sizes and CRCs, and the input files of the job. It also contains the job's
    table row and the data that `finish` requires. The manifest of a failed job lists no files. Each
    manifest ends with its own CRC. The job table can be rebuilt from the manifests.

    Parameters
    ----------
    storage
        A folder or URL. Unless the storage is `durable`, a power failure may lose jobs that were
        written.
    format
        kitti, nuscenes, webdataset, mcap, parquet, images or folder.
    layout
        Layout of points in mcap files (see `lidarpool.save_cloud`).
    compensated
        Whether points in mcap files are in the sensor frame at the start of the sweep, without
        times. Otherwise, each point is in the sensor frame at its firing. If points are simulated
        in world coordinates, `lidarpool.sweeps` returns points in the frame at the start of the
        sweep in both cases.
    compensated_actors, pose_rate_hz
        See `lidarpool.save_cloud`.
    made_with
        Identity and software versions that determine the bytes of all jobs, as JSON values. They
        are stored in each manifest.
    """

    storage: Storage
    format: Literal[tuple(DATA_SETS)]  # type: ignore[valid-type]
    layout: Literal[tuple(LAYOUTS)] = "velodyne"  # type: ignore[valid-type]
    compensated: bool = False
    compensated_actors: bool = False
    pose_rate_hz: float | None = None
    made_with: Mapping[str, Any] = field(default_factory=dict)

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def spec(self) -> ExportSpec:
        """File format of each job's cloud, with its options."""
        return ExportSpec(
            DATA_SETS[self.format],
            self.layout,
            self.compensated,
            compensated_actors=self.compensated_actors,
            pose_rate_hz=self.pose_rate_hz,
        )

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns that each job computes for the files."""
        return self.spec.added

    def check_installed(self) -> None:
        """Raise LidarError if a package that the format requires is not installed."""
        self.spec.check_installed()

    def read_coordinates(self, job: str) -> str:
        """Return the frame of the points that a job simulates, "world" or "sensor".

        Raises LidarError if the file is missing or damaged.
        """
        name = job_file(self.format, job, SWEEPS_FILE)
        return Sweeps.load_coordinates(self.storage.path(name), partial(self.storage.read, name))

    def write_job(
        self,
        row: JobRow,
        cloud: CloudLike,
        sweeps: Sweeps,
        input_files: Sequence[Sequence[str]] = (),
        *,
        listing: Listing | None = None,
    ) -> JobRow:
        """Write the files of a job, and return its table row with point counts.

        The same job always writes the same bytes. Points are read in order, one sweep at a time, or
        a million at a time for Parquet. Each file is written atomically.

        Parameters
        ----------
        row
            Table row of the job, without point counts.
        cloud
            Points of all sweeps of the job.
        sweeps
            Sweeps of the job.
        input_files
            Names and hashes of the job's input files.
        listing
            Storage that records the written files, even if an error occurs.

        Raises
        ------
        LidarError
            If a package or column is missing, if the cloud does not belong to these sweeps, or if
            the storage is not writable.
        """
        name = row.name
        spec = self.spec
        entry = Entry(row.number, name, row.split, row.values)
        spec.check_installed()
        tally = Tally.from_cloud(cloud)
        row = replace(row, points=tally.points, sha256=tally.sha256, classes=tally.classes)
        spec.check_columns(cloud)
        storage = listing or Listing.from_storage(self.storage)
        boxes: list[Boxes] = []
        with explain_os_errors(f"Job {name} cannot be written to {storage}"):
            output = spec.cloud_format(cloud, spec.configure_sweeps(sweeps), entry)
            if isinstance(output, MultiFileFormat):
                details = _write_pieces(output, storage)
                manifest = output.summary(details)
                boxes = [detail for detail in details if isinstance(detail, Boxes)]
            else:
                manifest = {}
                path = output.path_of_job(entry)
                storage.prepare(Path(path).parent)
                with local_folder(storage.local() if storage.is_local else storage) as folder:
                    (folder / path).parent.mkdir(parents=True, exist_ok=True)
                    spec.write(folder / path, cloud, sweeps, overwrite=True)
                    storage.files[path] = Storage(str(folder)).checksum(path)
                    if not storage.is_local:
                        storage.put(folder / path, path)
            files = {job_file(self.format, name, SWEEPS_FILE): sweeps.to_bytes()}
            if sweeps.actors:
                boxes = boxes or [
                    Boxes.from_points(sweeps, sweep, points)
                    for sweep, points in enumerate(sweeps.points(cloud))
                ]
                files[job_file(self.format, name, BOXES_FILE)] = _packed(boxes)
                row = replace(row, boxes=summarize_boxes(boxes))
            for file, data in files.items():
                storage.write(file, data)
            sweeps_per_sensor = np.bincount(sweeps.sensor, minlength=len(sweeps.sensors)).tolist()
            manifest |= {"sensors": [*zip(sweeps.sensors, sweeps_per_sensor, strict=True)]}
            manifest |= {"classes": dict(sweeps.classes)} if sweeps.classes else {}
            manifest |= {"materials": sweeps.materials} if sweeps.materials else {}
            manifest |= {"made_of": input_files, "files": dict(sorted(storage.files.items()))}
            self._write_manifest(storage, row, manifest)
        return row

    def write_failed(self, rows: Iterable[JobRow]) -> None:
        """Write the manifests of the failed jobs among the rows.

        Raises LidarError if the storage is not writable.
        """
        with explain_os_errors(f"{self.storage} cannot be written"):
            storage = Listing.from_storage(self.storage)
            failed = (row for row in rows if not row.done)
            deque(
                read_ahead(lambda row: self._write_manifest(storage, row, {"files": {}}), failed), 0
            )

    def _write_manifest(self, storage: Listing, row: JobRow, manifest: dict[str, Any]) -> None:
        row_of_all_runs = asdict(replace(row, seconds=None))
        manifest |= {"made_with": dict(self.made_with), "row": row_of_all_runs}
        manifest["crc"] = _crc(manifest)
        storage.write(manifest_file(row.name), json.dumps(manifest).encode())

    def finish(self, jobs: Iterable[JobRow]) -> None:
        """Use the manifests of finished jobs to write the files that all jobs share.

        Jobs are processed in the given order, and only one manifest is in memory at a time. No jobs
        may be written in the meantime. `dataset.json` marks a finished data set, so it is removed
        first and written last.

        Raises
        ------
        LidarError
            If a job's files differ from its manifest, or if the storage is not writable.
        """
        with explain_os_errors(f"{self.storage} cannot be written"):
            self.storage.remove([INDEX_FILE])
            self.storage.remove_unfinished()
            with self.storage.writing(INDEX_FILE) as file:
                index = SealedWriter(file)
                head: dict[str, Any] = {"lidarpool": __version__, "version": VERSION}
                head |= {"format": self.format, "layout": self.layout}
                head |= {"compensated": self.compensated}
                with suppress(FileNotFoundError):
                    head["table"] = self.storage.checksum(TABLE_FILE)
                index.write(f'{json.dumps(head)[:-1]}, "jobs": [')
                manifests = self._indexed(jobs, index)
                merged = self.spec.cloud_format.merge_jobs(self.storage, manifests)
                for job, classes in merged.items():
                    self._renumber(job, classes)
                index.seal()

    def _renumber(self, job: str, classes: Sequence[int]) -> None:
        """Renumber the labels of a job to match the class numbers of the merged data set.

        The manifest is removed first, so that the job is repeated if this is interrupted.
        """
        manifest = self._manifest(job)
        self.storage.remove([manifest_file(job)])
        storage = Listing.from_storage(self.storage)
        for name in manifest["files"]:
            labels = self.spec.cloud_format.renumber_labels(
                name, self.storage.read, manifest["lidarseg"], classes
            )
            if labels is not None:
                storage.write(name, labels)
        manifest |= {"lidarseg": classes, "files": manifest["files"] | storage.files}
        manifest["crc"] = _crc(manifest)
        self.storage.write(manifest_file(job), json.dumps(manifest).encode())

    def _indexed(self, jobs: Iterable[JobRow], index: SealedWriter) -> Iterator[dict[str, Any]]:
        """Yield the manifests of finished jobs, adding each job to the index."""
        comma = ""
        named = dict[int, dict[str, None]]()  # {class number: distinct names in the jobs}
        for job, (manifest, damage) in self.check_jobs(jobs):
            if damage:
                message = f"Job {job.name} of {self.storage} is incomplete, because {damage}."
                raise LidarError(f"{message} Run the campaign again with `--resume`.")
            row = {"number": job.number, "name": job.name, "sensors": manifest["sensors"]}
            index.write(f"{comma}\n{json.dumps(row)}")
            comma = ","
            for number, name in manifest.get("classes", {}).items():
                named.setdefault(int(number), {})[name] = None
            yield manifest
        classes = {number: "; ".join(names) for number, names in named.items()}
        for name, content in self.spec.cloud_format.class_files(classes).items() if classes else ():
            self.storage.write(name, content)
        classes_field = f', "classes": {json.dumps(classes)}' if classes else ""
        index.write(f"\n]{classes_field}")

    def check_jobs(
        self, jobs: Iterable[JobRow], *, contents: bool = False
    ) -> Iterator[tuple[JobRow, tuple[dict[str, Any], str]]]:
        """Yield each finished job with its manifest and a description of any damage to its files.

        The description is a clause, which is empty if the files are intact. If the manifest itself
        is missing or damaged, it is an empty dictionary. By default, only file sizes are compared.
        With `contents`, the checksums are compared, too. Raises OSError if the storage cannot be
        read.
        """
        check_job = self._job_checker(contents)
        yield from read_ahead(lambda job: check_job(job.name), (job for job in jobs if job.done))

    def _job_checker(self, contents: bool = False) -> Callable[[str], tuple[dict[str, Any], str]]:
        """Return a function that checks a job given its name, as described in `check_jobs`."""
        sizes = lru_cache(_MAX_LISTED_FOLDERS)(lambda folder: self.storage.below(folder).sizes())

        def check_job(job: str) -> tuple[dict[str, Any], str]:
            manifest = self._manifest(job)
            if not manifest or "sensors" not in manifest:  # a failed job has no sensors
                return {}, f"{manifest_file(job)} is missing or damaged"
            for name, (size, crc) in manifest["files"].items():
                folder, _, file = name.rpartition("/")
                same_size = sizes(folder).get(file) == size
                if not same_size or (contents and self.storage.checksum(name) != [size, crc]):
                    return manifest, f"{name} is missing or damaged"
            return manifest, ""

        return check_job

    def copy_jobs(self, source: Storage, identity: str) -> Iterator[tuple[str, JobRow | None, str]]:
        """Copy the files of all jobs from another data set with the same format.

        Files that already exist in this data set are not copied again. A job that failed in the
        source does not replace the job in this data set.

        For each job with a manifest in the source, yields the job's name, its table row, and a
        path. The path is the first source file that is missing, damaged, or belongs to a job with a
        different `identity`, or an empty string if there is none. The row is None if the manifest
        itself is unusable. Raises OSError if a storage cannot be read or written.
        """
        check_job = self._job_checker()
        other_set = replace(self, storage=source)

        def copy_job(name: str) -> tuple[JobRow | None, str]:
            manifest = other_set._manifest(name)
            manifest_name = manifest_file(name)
            if not manifest or manifest["made_with"].get("identity") != identity:
                return None, source.path(manifest_name)
            row = JobRow.from_json(manifest["row"])
            if check_job(name) == (manifest, "") or (not row.done and self._manifest(name)):
                return row, ""
            for file, checksum in (manifest["files"] | {manifest_name: None}).items():
                # A manifest that lists files outside the data set is foreign or was edited.
                if leads_outside(file):
                    return row, source.path(manifest_name)
                with suppress(FileNotFoundError):
                    self.storage.prepare(Path(file).parent)
                    self.storage.copy_from(source, file, file)
                    if file == manifest_name or self.storage.checksum(file) == checksum:
                        continue
                    self.storage.remove([file])
                return row, source.path(file)
            return row, ""

        for name, (row, damaged_file) in read_ahead(copy_job, iter(other_set.manifests())):
            yield name, row, damaged_file

    def _manifest(self, name: str) -> dict[str, Any]:
        """Read the manifest of a job.

        Return an empty dictionary if the manifest is missing, damaged, or belongs to a different
        job.
        """
        try:
            manifest: dict[str, Any] = json.loads(self.storage.read(manifest_file(name)))
            valid = manifest.pop("crc") == _crc(manifest)
            valid &= JobRow.from_json(manifest["row"]).name == name
            valid &= isinstance(manifest["made_with"], dict)
            valid &= all(len(checksum) == 2 for checksum in manifest["files"].values())
        except (FileNotFoundError, ValueError, LookupError, TypeError, AttributeError):
            return {}
        return manifest if valid else {}

    def manifests(self) -> list[str]:
        """Return the names of the jobs that have a manifest.

        Names are sorted by length, then alphabetically.
        """
        files = self.storage.below(_MANIFESTS).sizes()
        names = [file.removesuffix(".json") for file in files if file.endswith(".json")]
        return sorted(names, key=lambda name: (len(name), name))

    def rows(self, known_names: Collection[str] = ()) -> Iterator[tuple[JobRow, Mapping[str, Any]]]:
        """Yield each job's table row with the identity and software that produced the job.

        Rows are read from the manifests. Jobs in `known_names` and jobs with a damaged manifest are
        skipped. Raises OSError if the storage cannot be read.
        """
        unknown = (name for name in self.manifests() if name not in known_names)
        for _, manifest in read_ahead(self._manifest, unknown):
            if manifest:
                yield JobRow.from_json(manifest["row"]), manifest["made_with"]


@dataclass(frozen=True)
class Listing(Storage):
    """Storage that records the size and CRC-32 of each file written to it."""

    files: dict[str, list[int]] = field(default_factory=dict)  # {name: [bytes, CRC-32]}

    @classmethod
    def from_storage(cls, storage: Storage) -> Listing:
        """Wrap a storage to record all files written from now on."""
        return cls(storage.url, storage.durable, storage.named)

    def write(self, name: str, data: Any) -> None:  # noqa: D102 - as in Storage
        self.prepare(Path(name).parent)
        super().write(name, data)
        self.files[name] = [len(data), zlib.crc32(data)]


def read_ahead(read: Callable[[T], R], items: Iterator[T]) -> Iterator[tuple[T, R]]:
    """Yield each item with the result of `read`.

    Background threads call `read` for the next items in advance.
    """
    with ThreadPoolExecutor(_REQUESTS, "read") as pool:
        while group := [*islice(items, _AHEAD)]:
            yield from zip(group, pool.map(read, group), strict=True)


def manifest_file(name: str) -> str:
    """Return the name of a job's manifest in a data set."""
    return f"{_MANIFESTS}/{name}.json"


def _crc(manifest: Mapping[str, Any]) -> int:
    return zlib.crc32(json.dumps(manifest).encode())


def _write_pieces(output: MultiFileFormat, storage: Storage) -> list[Any]:
    """Write all pieces of a job in parallel.

    Returns the details that the format provides for each piece.
    """
    # In an object store, each file requires a request, so files are written in parallel.
    spans = [(0, len(output))] if storage.is_local else output.spans(_REQUESTS)
    with ThreadPoolExecutor(_REQUESTS, "write") as pool:
        written = pool.map(lambda span: output.write_range(storage, *span), spans)
        return output.finish(storage, [*written])


def _packed(boxes: Sequence[Boxes]) -> bytes:
    """Encode the boxes of all sweeps as a NumPy archive with one array per field."""
    # The sizes of the boxes are stored with the sweeps.
    arrays = {
        "centers": np.stack([boxes_of_sweep.centers for boxes_of_sweep in boxes]),
        "quaternions": np.stack([boxes_of_sweep.quaternions for boxes_of_sweep in boxes]),
        "points": np.stack([boxes_of_sweep.points for boxes_of_sweep in boxes]),
        "there": np.stack([boxes_of_sweep.present for boxes_of_sweep in boxes]),
    }
    visibility = [box.visibility.arrays for box in boxes if box.visibility is not None]
    for name in visibility[0] if visibility else ():
        arrays[name] = np.stack([fields[name] for fields in visibility])
    return pack_arrays(arrays)
