"""Data sets of many jobs: each job writes its own files, `finish` the files that all jobs share."""

from __future__ import annotations

import json
import re
import zlib
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from lidarsim._version import __version__
from lidarsim.base.archives import packed
from lidarsim.base.checks import check_fields
from lidarsim.base.errors import LidarError, explained
from lidarsim.base.named_files import leads_outside
from lidarsim.base.storage import Storage
from lidarsim.base.value_texts import one_line
from lidarsim.columns.cloud import CloudLike
from lidarsim.sweeps.sweeps import SWEEPS_FILE, Sweeps

from ..base.sealed import SealedWriter
from ..clouds.boxes import Boxes
from ..clouds.cloud_format import CloudFormat, Entry
from ..clouds.folder import local_folder
from ..clouds.format_table import DATA_SETS, LAYOUTS, load_format
from ..clouds.multi_file_format import MultiFileFormat
from ..clouds.writing import ExportSpec
from .job_table import TABLE_FILE, JobRow, Tally

T = TypeVar("T")
R = TypeVar("R")

INDEX_FILE = "dataset.json"  # a data set with this file is finished
BOXES_FILE = "boxes.npz"
_MANIFESTS = ".jobs"
VERSION = 2  # version of INDEX_FILE
_REQUESTS = 8  # simultaneous requests to an object store
_AHEAD = 16  # jobs that are checked ahead
_MAX_LISTED_FOLDERS = 32  # folders whose listings are cached; all jobs share some folders


def _name_pattern(cloud_format: type[CloudFormat]) -> str:
    """Return a pattern of the names of files of jobs in a format."""
    folder = re.escape(cloud_format.job_path)
    folder = folder.replace(r"\{name\}", "[^/]+").replace(r"\{number\}", r"\d+")
    files = cloud_format.file_pattern
    return "/".join(filter(None, (folder, files and f"({files})")))


# Names of files of jobs, in all formats.
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
    if format == "folder":  # `read_cloud` reads them from this folder
        return f"jobs/{name}/{file}"
    stem, _, ending = file.partition(".")
    return f"{stem}/{name}.{ending}"


@dataclass(frozen=True)
class DataSet:
    """The files of many jobs in a folder or storage.

    The object is small when pickled. Any process writes jobs.

    - kitti: `sequences/07` of job 7, of further sensors `sequences/07_NAME`
    - nuscenes: a scene for each job; `finish` writes the tables
    - webdataset: `shards/SPLIT/NAME-000000.tar`, and `offsets/NAME.npz` for single sweeps
    - mcap: `bags/NAME.mcap`
    - parquet: `points/job=7`, one table of Hive's partitions
    - images: `images/NAME/SENSOR/000000.npz`
    - folder: `jobs/NAME/cloud.ply`

    In addition there are `sweeps/NAME.npz` (`Sweeps`) and, where there are actors,
    `boxes/NAME.npz`, which `lidarpool.sweeps` reads; with `folder` they are in `jobs/NAME`.
    `.jobs/NAME.json`, the job's manifest, is the last file that a job writes: it lists the job's
    files with bytes and CRC, and the input files of the job, and has the job's row and data for
    `finish`. The manifest of a job that has failed lists no files. Each manifest ends with its own
    CRC; the table of jobs follows from the manifests.

    Parameters
    ----------
    storage
        A folder or URL. Without `durable` a power failure may lose jobs that were written.
    format
        kitti, nuscenes, webdataset, mcap, parquet, images or folder.
    layout
        Layout of points in mcap (`lidarpool.save_cloud`).
    compensated
        Points in mcap are in the sensor frame at the start of the sweep, and have no times; else at
        their firing. `lidarpool.sweeps` gives both at the start of the sweep.
    compensated_actors, pose_rate_hz
        As of `lidarpool.save_cloud`.
    made_with
        Identity and software that determine the bytes of all jobs, for JSON; part of each manifest.
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
        """Format of the files of a job, with its options."""
        return ExportSpec(
            DATA_SETS[self.format],
            self.layout,
            self.compensated,
            compensated_actors=self.compensated_actors,
            pose_rate_hz=self.pose_rate_hz,
        )

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns that clouds of jobs must have."""
        return self.spec.needs

    def check_installed(self) -> None:
        """Raise LidarError if a package that writes the format is missing in this environment."""
        self.spec.check_installed()

    def write_job(
        self,
        row: JobRow,
        cloud: CloudLike,
        sweeps: Sweeps,
        made_of: Sequence[Sequence[str]] = (),
        *,
        listing: Listing | None = None,
    ) -> JobRow:
        """Write the files of a job, always the same bytes.

        Returns its row with counts of points.

        Points are read in order, a sweep at a time or, for Parquet, a million. Every file appears
        completely or not at all. `made_of` has names and hashes of the input files of the job;
        `listing` gets the written files, also after an error.

        Raises
        ------
        LidarError
            If a package or column is missing, the cloud is not of these sweeps, or the storage
            cannot be written to.
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
        with explained(f"Job {name} cannot be written to {storage}"):
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
            files = {job_file(self.format, name, SWEEPS_FILE): sweeps.packed()}
            if sweeps.actors:
                boxes = boxes or [
                    Boxes.from_points(sweeps, sweep, points)
                    for sweep, points in enumerate(sweeps.points(cloud))
                ]
                files[job_file(self.format, name, BOXES_FILE)] = _packed(boxes)
            for file, data in files.items():
                storage.write(file, data)
            sweeps_per_sensor = np.bincount(sweeps.sensor, minlength=len(sweeps.sensors)).tolist()
            manifest |= {"sensors": [*zip(sweeps.sensors, sweeps_per_sensor, strict=True)]}
            manifest |= {"classes": dict(sweeps.classes)} if sweeps.classes else {}
            manifest |= {"materials": sweeps.materials} if sweeps.materials else {}
            manifest |= {"made_of": made_of, "files": dict(sorted(storage.files.items()))}
            self._write_manifest(storage, row, manifest)
        return row

    def write_failed(self, rows: Iterable[JobRow]) -> None:
        """Write the manifests of jobs that have failed.

        Raises LidarError on failure.
        """
        with explained(f"{self.storage} cannot be written"):
            storage = Listing.from_storage(self.storage)
            failed = (row for row in rows if not row.done)
            deque(
                read_ahead(lambda row: self._write_manifest(storage, row, {"files": {}}), failed), 0
            )

    def _write_manifest(self, storage: Listing, row: JobRow, manifest: dict[str, Any]) -> None:
        """Write the manifest of a job, with the part of its row that is the same in every run."""
        row_of_all_runs = asdict(replace(row, seconds=None))
        manifest |= {"made_with": dict(self.made_with), "row": row_of_all_runs}
        manifest["crc"] = _crc(manifest)
        storage.write(manifest_file(row.name), json.dumps(manifest).encode())

    def finish(self, jobs: Iterable[JobRow]) -> None:
        """Write the shared files from the finished jobs, in their order.

        A single job's manifest is in memory at a time. No job may be written meanwhile.
        `dataset.json` is removed first and written last: it marks a finished data set.

        Raises
        ------
        LidarError
            If a job's files differ from its manifest, or the storage cannot be written to.
        """
        with explained(f"{self.storage} cannot be written"):
            self.storage.remove([INDEX_FILE])
            self.storage.tidy()
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
        """Write the labels of a job again, so that they number other classes.

        The manifest is removed first: if this is interrupted, the job is made again.
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
        """Yield the manifests of finished jobs, and write their names and sensors to the index."""
        comma = ""
        named = dict[int, dict[str, None]]()  # {class: its names in the jobs, in order}
        for job, (manifest, damage) in self.look(jobs):
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

    def look(
        self, jobs: Iterable[JobRow], *, contents: bool = False
    ) -> Iterator[tuple[JobRow, tuple[dict[str, Any], str]]]:
        """Yield the finished jobs with their manifests and a description of damage to their files.

        The description is a clause, or empty without damage; the manifest may be empty, too. Sizes
        are compared, and with `contents` every byte is read. OSError if the storage cannot be read.
        """
        look_at = self._job_checker(contents)
        yield from read_ahead(lambda job: look_at(job.name), (job for job in jobs if job.done))

    def _job_checker(self, contents: bool = False) -> Callable[[str], tuple[dict[str, Any], str]]:
        """Return a function that checks a job by its name (`look`)."""
        sizes = lru_cache(_MAX_LISTED_FOLDERS)(lambda folder: self.storage.below(folder).sizes())

        def look_at(job: str) -> tuple[dict[str, Any], str]:
            manifest = self._manifest(job)
            if not manifest or "sensors" not in manifest:  # a failed job has no sensors
                return {}, f"{manifest_file(job)} is missing or damaged"
            for name, (size, crc) in manifest["files"].items():
                folder, _, file = name.rpartition("/")
                same_size = sizes(folder).get(file) == size
                if not same_size or (contents and self.storage.checksum(name) != [size, crc]):
                    return manifest, f"{name} is missing or damaged"
            return manifest, ""

        return look_at

    def take(self, source: Storage, identity: str) -> Iterator[tuple[str, JobRow | None, str]]:
        """Copy the files of jobs from another data set of this format, in `source`.

        Files that exist in this data set are not read again. A job that has failed in the source
        stays as it is in this data set. Yields the name of each job with a manifest, the row of the
        manifest, and the first file in the source that is missing, damaged or of jobs of another
        `identity`, else "". OSError if a storage cannot be read or written to.
        """
        look_at = self._job_checker()
        other_set = replace(self, storage=source)

        def take(name: str) -> tuple[JobRow | None, str]:
            manifest = other_set._manifest(name)
            manifest_name = manifest_file(name)
            if not manifest or manifest["made_with"].get("identity") != identity:
                return None, source.path(manifest_name)
            row = JobRow.from_json(manifest["row"])
            if look_at(name) == (manifest, "") or (not row.done and self._manifest(name)):
                return row, ""
            for file, checksum in (manifest["files"] | {manifest_name: None}).items():
                # No file of a data set: the manifest is foreign or edited.
                if leads_outside(file):
                    return row, source.path(manifest_name)
                with suppress(FileNotFoundError):
                    self.storage.prepare(Path(file).parent)
                    self.storage.take(source, file, file)
                    if file == manifest_name or self.storage.checksum(file) == checksum:
                        continue
                    self.storage.remove([file])
                return row, source.path(file)
            return row, ""

        for name, (row, damaged_file) in read_ahead(take, iter(other_set.manifests())):
            yield name, row, damaged_file

    def _manifest(self, name: str) -> dict[str, Any]:
        """Read the manifest of a job.

        The manifest is empty if missing, damaged or of another job.
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
        """Return the names of the jobs that have a manifest, by length and letters."""
        files = self.storage.below(_MANIFESTS).sizes()
        names = [file.removesuffix(".json") for file in files if file.endswith(".json")]
        return sorted(names, key=lambda name: (len(name), name))

    def rows(self, known_names: Collection[str] = ()) -> Iterator[tuple[JobRow, Mapping[str, Any]]]:
        """Yield the rows of jobs from their manifests, and the identity and software of the jobs.

        Jobs in `known_names` and damaged manifests are left out. OSError if the storage cannot be
        read.
        """
        unknown = (name for name in self.manifests() if name not in known_names)
        for _, manifest in read_ahead(self._manifest, unknown):
            if manifest:
                yield JobRow.from_json(manifest["row"]), manifest["made_with"]


@dataclass(frozen=True)
class Listing(Storage):
    """A storage that lists the written files, {name: [bytes, CRC-32]}."""

    files: dict[str, list[int]] = field(default_factory=dict)

    @classmethod
    def from_storage(cls, storage: Storage) -> Listing:
        """Return a storage that lists the files written from now on."""
        return cls(storage.url, storage.durable, storage.named)

    def write(self, name: str, data: Any) -> None:  # noqa: D102 - as in Storage
        self.prepare(Path(name).parent)
        super().write(name, data)
        self.files[name] = [len(data), zlib.crc32(data)]


def read_ahead(read: Callable[[T], R], items: Iterator[T]) -> Iterator[tuple[T, R]]:
    """Yield items with the results of `read`, which runs ahead in threads."""
    with ThreadPoolExecutor(_REQUESTS, "read") as pool:
        while group := [*islice(items, _AHEAD)]:
            yield from zip(group, pool.map(read, group), strict=True)


def manifest_file(name: str) -> str:
    """Return the name of the manifest of a job in a data set."""
    return f"{_MANIFESTS}/{name}.json"


def _crc(manifest: Mapping[str, Any]) -> int:
    return zlib.crc32(json.dumps(manifest).encode())


def _write_pieces(output: MultiFileFormat, storage: Storage) -> list[Any]:
    """Write all pieces of a job, and return their details."""
    # In an object store each file takes a request.
    spans = [(0, len(output))] if storage.is_local else output.spans(_REQUESTS)
    with ThreadPoolExecutor(_REQUESTS, "write") as pool:
        written = pool.map(lambda span: output.write_range(storage, *span), spans)
        return output.finish(storage, [*written])


def _packed(boxes: Sequence[Boxes]) -> bytes:
    """Return boxes of all sweeps as a NumPy archive: float64 (n, a, 3), ... by names of fields."""
    # The sizes are in the sweeps.
    return packed(
        {
            "centers": np.stack([boxes_of_sweep.centers for boxes_of_sweep in boxes]),
            "quaternions": np.stack([boxes_of_sweep.quaternions for boxes_of_sweep in boxes]),
            "points": np.stack([boxes_of_sweep.points for boxes_of_sweep in boxes]),
            "there": np.stack([boxes_of_sweep.present for boxes_of_sweep in boxes]),
        }
    )
