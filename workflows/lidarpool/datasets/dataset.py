"""Data sets of many jobs: each job writes files of its own, `finish` those that all share."""

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
from lidarsim.base.errors import LidarError, explained
from lidarsim.base.storage import Storage
from lidarsim.base.validation import checked_fields
from lidarsim.columns.cloud import CloudLike
from lidarsim.sweeps.sweeps import SWEEPS_FILE, Sweeps

from ..base.sealed import SealedWriter
from ..export.boxes import Boxes
from ..export.folder import local_folder
from ..export.format_table import DATA_SETS, FORMATS, LAYOUTS, FormatRow
from ..export.formats import Format
from ..export.kitti import NAMES_FILE, labels_file
from ..export.nuscenes import merge
from ..export.pieces import Entry, Pieces, pieces_of
from .job_table import TABLE_FILE, JobRow, Tally

T = TypeVar("T")
R = TypeVar("R")

INDEX_FILE = "dataset.json"  # a data set with this file is finished
BOXES_FILE = "boxes.npz"
_MANIFESTS = ".jobs"
VERSION = 2  # of INDEX_FILE
_REQUESTS = 8  # to an object store at a time
_AHEAD = 16  # jobs that are looked at ahead
_LISTED = 32  # folders whose files are known at a time, some of which all jobs share


def _names_in(row: FormatRow) -> str:
    """Pattern of the names of files of jobs in a format."""
    place = re.escape(row.of_job).replace(r"\{name\}", "[^/]+").replace(r"\{number\}", r"\d+")
    return "/".join(filter(None, (place, row.inside and f"({row.inside})")))


# Files of jobs, in all formats.
OF_JOBS = re.compile(
    r"\.jobs/[^/]+\.json|jobs/[^/]+/(sweeps|boxes)\.npz|(sweeps|boxes)/[^/]+\.npz|"
    + "|".join(_names_in(FORMATS[name]) for name in DATA_SETS.values())
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
@checked_fields
class DataSet:
    """The files of many jobs in one place: small when pickled, any process writes a job.

    - kitti: `sequences/07` of job 7, of further sensors `sequences/07_NAME`
    - nuscenes: a scene for each job; `finish` writes the tables
    - webdataset: `shards/SPLIT/NAME-000000.tar`, and `offsets/NAME.npz` for single sweeps
    - mcap: `bags/NAME.mcap`
    - parquet: `points/job=7`, one table of Hive's partitions
    - images: `images/NAME/SENSOR/000000.npz`
    - folder: `jobs/NAME/cloud.ply`

    Beside these are `sweeps/NAME.npz` (`Sweeps`) and, where there are actors, `boxes/NAME.npz`,
    which `lidarpool.sweeps` reads; with `folder` they are in `jobs/NAME`. `.jobs/NAME.json`, the
    job's manifest, is the last file that a job writes: it lists the others with bytes and CRC, and
    the files that the job was made of, and has the job's row and what `finish` needs. The manifest
    of a job that has failed lists no files. Each manifest ends with its own CRC; the table of jobs
    follows from the manifests.

    Parameters
    ----------
    place
        A folder or URL. Without `durable` a power failure may lose jobs that were written.
    format
        kitti, nuscenes, webdataset, mcap, parquet, images or folder.
    layout
        Of points in mcap: velodyne, autoware, ouster or images.
    compensated
        Points in mcap are in the sensor's axes at the start of the sweep, and have no times; else
        at their firing. `lidarpool.sweeps` gives both at the start of the sweep.
    made_with
        What the bytes of all jobs depend on, for JSON; each manifest says it.
    """

    place: Storage
    format: Literal[tuple(DATA_SETS)]  # type: ignore[valid-type]
    layout: Literal[tuple(LAYOUTS)] = "velodyne"  # type: ignore[valid-type]
    compensated: bool = False
    made_with: Mapping[str, Any] = field(default_factory=dict)

    @property
    def _of_jobs(self) -> Format:
        return Format(DATA_SETS[self.format], self.layout, self.compensated)

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns that clouds of jobs must have."""
        return self._of_jobs.needs

    def check_installed(self) -> None:
        """Check that it can be written here; LidarError if a package is missing."""
        self._of_jobs.check_installed()

    def write_job(
        self,
        row: JobRow,
        cloud: CloudLike,
        sweeps: Sweeps,
        made_of: Sequence[Sequence[str]] = (),
        *,
        listing: Listing | None = None,
    ) -> JobRow:
        """Write the files of a job; whoever writes them again writes the same bytes.

        Returns its row, with what is counted of the points.

        Points are read in order, a sweep at a time or, for Parquet, a million. Every file
        appears completely or not at all. `made_of` has names and hashes of the files that the
        job was made of; `listing` gets the files, also if not all are written.

        Raises
        ------
        LidarError
            If a package or column is missing, the cloud is not of these sweeps, or the place
            cannot be written to.
        """
        name = row.name
        one = self._of_jobs
        entry = Entry(row.number, name, row.split, row.values)
        one.check_installed()
        tally = Tally.of(cloud)
        row = replace(row, points=tally.points, sha256=tally.sha256, classes=tally.classes)
        one.check_columns(cloud)
        place = listing or Listing.of(self.place)
        boxes: list[Boxes] = []
        with explained(f"Job {name} cannot be written to {place}"):
            if one.row.in_pieces:
                pieces = pieces_of(one.format, cloud, sweeps, entry)
                made = _write_pieces(pieces, place)
                manifest = pieces.summary(made)
                boxes = made if one.row.boxes else []
            else:
                manifest = {}
                path = entry.place(one.format)
                place.prepare(Path(path).parent)
                with local_folder(place.local() if place.is_local else place) as folder:
                    (folder / path).parent.mkdir(parents=True, exist_ok=True)
                    one.write(folder / path, cloud, sweeps, overwrite=True)
                    place.files[path] = Storage(str(folder)).checksum(path)
                    if not place.is_local:
                        place.put(folder / path, path)
            files = {job_file(self.format, name, SWEEPS_FILE): sweeps.packed()}
            if sweeps.actors:
                boxes = boxes or [
                    Boxes.of(sweeps, sweep, points)
                    for sweep, points in enumerate(sweeps.points(cloud))
                ]
                files[job_file(self.format, name, BOXES_FILE)] = _packed(boxes)
            for file, data in files.items():
                place.write(file, data)
            of_sensors = np.bincount(sweeps.sensor, minlength=len(sweeps.sensors)).tolist()
            manifest |= {"sensors": [*zip(sweeps.sensors, of_sensors, strict=True)]}
            manifest |= {"classes": dict(sweeps.classes)} if sweeps.classes else {}
            manifest |= {"materials": sweeps.materials} if sweeps.materials else {}
            manifest |= {"made_of": made_of, "files": dict(sorted(place.files.items()))}
            self._write_manifest(place, row, manifest)
        return row

    def write_failed(self, rows: Iterable[JobRow]) -> None:
        """Write the manifests of jobs that have failed; LidarError if that fails."""
        with explained(f"{self.place} cannot be written"):
            place = Listing.of(self.place)
            failed = (row for row in rows if not row.done)
            deque(ahead(lambda row: self._write_manifest(place, row, {"files": {}}), failed), 0)

    def _write_manifest(self, place: Listing, row: JobRow, manifest: dict[str, Any]) -> None:
        """Write the manifest of a job, with the part of its row that every run gives."""
        row_of_all_runs = asdict(replace(row, seconds=0.0))
        manifest |= {"made_with": dict(self.made_with), "row": row_of_all_runs}
        manifest["crc"] = _crc(manifest)
        place.write(manifest_file(row.name), json.dumps(manifest).encode())

    def finish(self, jobs: Iterable[JobRow]) -> None:
        """Write the files that hold all jobs, from those that are done, in their order.

        One job is in memory at a time, and its number of sweeps. No job may be written meanwhile.
        `dataset.json` is removed first and written last: it says that the data set is finished.

        Raises
        ------
        LidarError
            If a job's files are not those of its manifest, or the place cannot be written to.
        """
        with explained(f"{self.place} cannot be written"):
            self.place.remove([INDEX_FILE])
            self.place.tidy()
            with self.place.writing(INDEX_FILE) as file:
                index = SealedWriter(file)
                head: dict[str, Any] = {"lidarpool": __version__, "version": VERSION}
                head |= {"format": self.format, "layout": self.layout}
                head |= {"compensated": self.compensated}
                with suppress(FileNotFoundError):
                    head["table"] = self.place.checksum(TABLE_FILE)
                index.write(f'{json.dumps(head)[:-1]}, "jobs": [')
                manifests = self._indexed(jobs, index)
                if self.format == "nuscenes":
                    merge(self.place, manifests)
                else:
                    deque(manifests, maxlen=0)
                index.seal()

    def _indexed(self, jobs: Iterable[JobRow], index: SealedWriter) -> Iterator[dict[str, Any]]:
        """Yield the manifest of each job that is done, and add it to the index, with names."""
        # {class: names that jobs have for it}
        comma = ""
        named = dict[int, dict[str, None]]()
        for job, (manifest, wrong) in self.look(jobs):
            if wrong:
                told = f"Job {job.name} of {self.place} is not whole: its {wrong}."
                raise LidarError(f"{told} Make it again with --resume.")
            row = {"number": job.number, "name": job.name, "sensors": manifest["sensors"]}
            index.write(f"{comma}\n{json.dumps(row)}")
            comma = ","
            for number, name in manifest.get("classes", {}).items():
                named.setdefault(int(number), {})[name] = None
            yield manifest
        classes = {number: "; ".join(names) for number, names in named.items()}
        if classes and self.format == "kitti":
            self.place.write(NAMES_FILE, labels_file(classes))
        more = f', "classes": {json.dumps(classes)}' if classes else ""
        index.write(f"\n]{more}")

    def look(
        self, jobs: Iterable[JobRow], *, contents: bool = False
    ) -> Iterator[tuple[JobRow, tuple[dict[str, Any], str]]]:
        """Yield the jobs that are done, their manifests, and what is wrong with their files.

        The last is a clause, or empty; then the manifest may be, too. Sizes are compared, and with
        `contents` every byte is read. OSError if the place cannot be read.
        """
        look_at = self._looker(contents)
        yield from ahead(lambda job: look_at(job.name), (job for job in jobs if job.done))

    def _looker(self, contents: bool = False) -> Callable[[str], tuple[dict[str, Any], str]]:
        """Return what looks at a job by its name, see `look`."""
        sizes = lru_cache(_LISTED)(lambda folder: self.place.below(folder).sizes())

        def look_at(job: str) -> tuple[dict[str, Any], str]:
            manifest = self._manifest(job)
            if not manifest or "sensors" not in manifest:  # the latter of a job that has failed
                return {}, f"{manifest_file(job)} is missing or damaged"
            for name, (size, crc) in manifest["files"].items():
                folder, _, file = name.rpartition("/")
                same = sizes(folder).get(file) == size
                if not same or (contents and self.place.checksum(name) != [size, crc]):
                    return manifest, f"{name} is missing or damaged"
            return manifest, ""

        return look_at

    def take(self, place: Storage, identity: str) -> Iterator[tuple[str, JobRow | None, str]]:
        """Copy the files of jobs from another data set of this format, which is in `place`.

        Files that are here already are not read again. A job that has failed there stays as the
        job is here. Yields the name of each job of which there is a manifest, the row that the
        manifest has, and the first file there that is missing, damaged or of jobs of another
        `identity`, else "". OSError if a place cannot be read or written to.
        """
        here = self._looker()
        there = replace(self, place=place)

        def take(name: str) -> tuple[JobRow | None, str]:
            manifest = there._manifest(name)
            last = manifest_file(name)
            if not manifest or manifest["made_with"].get("identity") != identity:
                return None, place.path(last)
            row = JobRow.of(manifest["row"])
            if here(name) == (manifest, "") or (not row.done and self._manifest(name)):
                return row, ""
            for file, checksum in (manifest["files"] | {last: None}).items():
                if ".." in Path(file).parts or Path(file).is_absolute():  # of somebody else
                    return row, place.path(last)
                with suppress(FileNotFoundError):
                    self.place.prepare(Path(file).parent)
                    self.place.take(place, file, file)
                    if file == last or self.place.checksum(file) == checksum:
                        continue
                    self.place.remove([file])
                return row, place.path(file)
            return row, ""

        for name, (row, wrong) in ahead(take, iter(there.manifests())):
            yield name, row, wrong

    def _manifest(self, name: str) -> dict[str, Any]:
        """Read the manifest of a job; empty if it is missing, damaged or of another job."""
        try:
            manifest: dict[str, Any] = json.loads(self.place.read(manifest_file(name)))
            whole = manifest.pop("crc") == _crc(manifest)
            whole &= JobRow.of(manifest["row"]).name == name
            whole &= isinstance(manifest["made_with"], dict)
            whole &= all(len(checksum) == 2 for checksum in manifest["files"].values())
        except (FileNotFoundError, ValueError, LookupError, TypeError, AttributeError):
            return {}
        return manifest if whole else {}

    def manifests(self) -> list[str]:
        """Return the names of the jobs of which there is a manifest, by length and letters."""
        files = self.place.below(_MANIFESTS).sizes()
        names = [file.removesuffix(".json") for file in files if file.endswith(".json")]
        return sorted(names, key=lambda name: (len(name), name))

    def rows(self, known: Collection[str] = ()) -> Iterator[tuple[JobRow, Mapping[str, Any]]]:
        """Yield the rows of jobs as their manifests have them, and what the jobs were made with.

        Rows of `known` names and damaged manifests are left out. OSError if the place
        cannot be read.
        """
        unknown = (name for name in self.manifests() if name not in known)
        for _, manifest in ahead(self._manifest, unknown):
            if manifest:
                yield JobRow.of(manifest["row"]), manifest["made_with"]


@dataclass(frozen=True)
class Listing(Storage):
    """A storage that lists the files that are written, {name: [bytes, CRC-32]}."""

    files: dict[str, list[int]] = field(default_factory=dict)

    @classmethod
    def of(cls, place: Storage) -> Listing:
        """List the files that are written to a place from now on."""
        return cls(place.url, place.durable, place.named)

    def write(self, name: str, data: Any) -> None:  # noqa: D102 - as of any
        self.prepare(Path(name).parent)
        super().write(name, data)
        self.files[name] = [len(data), zlib.crc32(data)]


def ahead(read: Callable[[T], R], things: Iterator[T]) -> Iterator[tuple[T, R]]:
    """Yield each thing with what is read for it; several are read at a time."""
    with ThreadPoolExecutor(_REQUESTS, "read") as pool:
        while some := [*islice(things, _AHEAD)]:
            yield from zip(some, pool.map(read, some), strict=True)


def manifest_file(name: str) -> str:
    """Name of the manifest of a job in a data set."""
    return f"{_MANIFESTS}/{name}.json"


def _crc(manifest: Mapping[str, Any]) -> int:
    return zlib.crc32(json.dumps(manifest).encode())


def _write_pieces(pieces: Pieces, place: Storage) -> list[Any]:
    """Write all pieces of a job; returns what was made of them."""
    # Elsewhere each file takes a request.
    spans = [(0, len(pieces))] if place.is_local else pieces.spans(_REQUESTS)
    with ThreadPoolExecutor(_REQUESTS, "write") as pool:
        return pieces.finish(place, [*pool.map(lambda span: pieces.write(place, *span), spans)])


def _packed(boxes: Sequence[Boxes]) -> bytes:
    """Boxes of all sweeps as a NumPy archive: float64 (n, a, 3), ... as the fields of `Boxes`."""
    names = ("centres", "quaternions", "points", "there")  # sizes are those of the sweeps
    return packed({name: np.stack([getattr(one, name) for one in boxes]) for name in names})
