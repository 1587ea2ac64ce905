"""Read and write WebDatasets, which are tar files for sequential access to sweeps."""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lidarsim.columns.cloud import Cloud, CloudLike
from lidarsim.columns.sweep import Sweep
from lidarsim.environment.extras import reading
from lidarsim.errors import LidarError
from lidarsim.io.archives import open_archive, pack_arrays, read_npy
from lidarsim.io.input_files import input_size
from lidarsim.io.numbered_files import sort_by_number
from lidarsim.io.storage import Storage
from lidarsim.numerics.arrays import AnyArray, Ints
from lidarsim.sweeps.sweeps import Sweeps, make_identifiers, states_compensation

from .boxes import Boxes, SweepBoxes, json_number
from .job_reader import Entry, JobReader, PointColumns
from .multi_file_format import MultiFileFormat, PieceRange, WrittenRange, as_npy
from .point_field import PointField
from .recording import Recording, RecordingInfo
from .recording_ref import RecordingRef

MAX_SHARD_BYTES = 1_000_000_000  # bytes of a tar file, unless a single sweep has more
_RESERVED = ("points", "pose", "boxes")  # arrays that are not columns


class WebDataset(MultiFileFormat):
    """A folder of tar files with up to a hundred sweeps or one million points each.

    The tar files are named by their first sweep, for example `shards/000000.tar`. Each sweep is a
    sample SENSOR-000000 with these files:

    - `points.npy`: float32 of shape (n, 3), in meters, in the sensor frame at the start of the
      sweep.
    - A file for each column, for example `intensity.npy`.
    - `pose.npy`: transformation of shape (4, 4) from this frame to the world frame.
    - `boxes.npy`: float32 of shape (k, 7), as in `SweepBoxes.rows`.
    - `json`: description of the sweep and the boxes.

    In a data set, the sample is named JOB/SENSOR-000000, and the tar file
    `shards/SPLIT/JOB-000000.tar`. The description also contains the varied values of the job. To
    read single sweeps, `offsets/JOB.npz` contains int64 of shape (sweeps, 3): the first sweep in
    the tar file, and the first byte and the end of the sample in this file.

    Aizman et al., High performance I/O for large scale deep learning, 2019.
    """

    title = "WebDataset"
    by_sweep = True
    fields = tuple(PointField(name, (name,)) for name in ("object", "intensity", "class"))
    actor_boxes = True
    file_pattern = r"shards/([^/]+/)?[^/]+\.tar|offsets/[^/]+\.npz"
    separate_sweeps = True

    def __init__(self, cloud: CloudLike, sweeps: Sweeps, entry: Entry | None = None) -> None:
        super().__init__(cloud, sweeps, entry)
        self.folders = ["shards"]
        self.names = make_identifiers(name or "lidar" for name in sweeps.sensors)
        self.offsets = np.zeros((len(sweeps), 3), np.int64)
        if clash := [column.name for column in cloud.table if column.name in _RESERVED]:
            raise LidarError(
                f"The column name {clash[0]!r} is reserved in WebDataset. Rename the column."
            )

    def spans(self, min_spans: int = 1) -> list[PieceRange]:
        """Divide the sweeps into ranges, each of which has its own tar files.

        The ranges, and therefore the bytes, do not depend on the number of workers.
        """
        return super().spans()

    def write_range(self, storage: Storage, first: int, stop: int) -> WrittenRange:
        """Write the tar files of a range of sweeps, holding one file in memory at a time.

        Each range that `spans` returns is written if it begins in the given range.
        Raises OSError if a file cannot be written.
        """
        count = 0
        boxes_of_sweeps = []
        for begin, end in self.spans():
            tar = io.BytesIO()
            start = begin
            inside = self.read(begin, end) if first <= begin < stop else ()
            for number, points in enumerate(inside, begin):
                boxes = (
                    Boxes.from_points(self.sweeps, number, points) if self.sweeps.actors else None
                )
                sample = b"".join(self.sample_files(number, points, boxes))
                if tar.tell() and tar.tell() + len(sample) > MAX_SHARD_BYTES:
                    self._put(storage, start, tar)
                    tar = io.BytesIO()
                    start = number
                self.offsets[number] = start, tar.tell(), tar.tell() + len(sample)
                tar.write(sample)
                count += len(points)
                boxes_of_sweeps.append(boxes)
            if tar.tell():
                self._put(storage, start, tar)
        return count, boxes_of_sweeps

    def shared_files(self, boxes: Sequence[Boxes | None]) -> dict[str, bytes]:
        """Return the offset file of a job in a data set."""
        if self.entry is None:
            return {}
        return {f"offsets/{self.entry.name}.npz": pack_arrays({"at": self.offsets})}

    def _put(self, storage: Storage, start: int, tar: io.BytesIO) -> None:
        # A tar file ends with at least two empty blocks, and is padded to a full record.
        tar.write(bytes(tarfile.RECORDSIZE - tar.tell() % tarfile.RECORDSIZE))
        name = _shard(self.entry, start)
        storage.prepare(name.rpartition("/")[0])
        storage.write(name, tar.getbuffer())

    def sample_files(self, number: int, points: Cloud, boxes: Boxes | None) -> Iterator[bytes]:
        """Yield the files in the sample of a sweep, including their tar headers."""
        sweeps = self.sweeps
        entry = self.entry
        present = SweepBoxes.select(sweeps, boxes and boxes.to_sensor_frame(sweeps.pose, number))
        columns = sweeps.columns_in_sensor(number, points)
        arrays = {
            "points": sweeps.in_sensor(number, points.positions).astype(np.float32),
            **{column.name: columns[column.name] for column in self.cloud.table},
            "pose": sweeps.pose.matrix(number),
            "boxes": present.rows,
        }
        folder, job = ([], {}) if entry is None else ([entry.name], asdict(entry))
        description = job | {
            "sensor": sweeps.sensors[sweeps.sensor[number]],
            "sweep": int(sweeps.numbers[number]),
            "time_ns": round(sweeps.begins_ns[number]),
            "frame": sweeps.frame_text(compensated=sweeps.coordinates == "world"),
            "box_names": present.names,
            "box_types": present.types,
            "box_objects": present.objects.tolist(),
            "box_points": present.points.tolist(),
            **{
                f"box_{name}": [json_number(value) for value in values.tolist()]
                for name, values in present.visibility.items()
            },
        }
        if "material" in columns:
            description["materials"] = sweeps.materials
        if faults := sweeps.faults_in(number):
            description["faults"] = [fault.to_dict() for fault in faults]
        files = {f"{name}.npy": as_npy(array) for name, array in arrays.items()}
        files["json"] = json.dumps(description).encode()
        key = f"{self.names[sweeps.sensor[number]]}-{sweeps.numbers[number]:06}"
        for name, data in files.items():
            head = tarfile.TarInfo("/".join([*folder, f"{key}.{name}"]))  # date 1970, no owner
            head.size = len(data)
            yield head.tobuf() + data + bytes(-len(data) % tarfile.BLOCKSIZE)

    @classmethod
    def sweep_files(cls, job: JobReader, sweep: int) -> list[str]:
        """Return the name of the tar file that contains a sweep."""
        return [_shard(job.entry, int(_offsets(job)[sweep, 0]))]

    @classmethod
    def read_sweep(cls, job: JobReader, sweep: int) -> PointColumns:
        """Read points with all columns.

        Only the bytes of the sweep are read.
        """
        _, first, stop = _offsets(job)[sweep].tolist()
        sample = job.storage.read(cls.sweep_files(job, sweep)[0], first, stop)
        if len(sample) < stop - first:
            raise ValueError(
                f"it ends {stop - first - len(sample)} bytes before the end of the sweep"
            )
        data = io.BytesIO(sample)
        arrays: dict[str, AnyArray] = {}
        with tarfile.open(fileobj=data, mode="r:") as tar:
            for member in tar:
                name, _, ending = member.name.rpartition("/")[2].partition(".")[2].rpartition(".")
                if ending == "npy" and name not in ("pose", "boxes"):
                    data.seek(member.offset_data)
                    arrays[name] = read_npy(data.read(member.size), name)
        return arrays.pop("points"), arrays

    @classmethod
    def open(cls, ref: RecordingRef) -> Recording:
        """Open the samples in a tar file, or in all tar files in a folder."""
        path = ref.path
        files = sort_by_number(path.rglob("*.tar")) if path.is_dir() else [path]
        with reading(ref.name):
            sensors = _samples_of_sensors(files)
        name, samples = ref.choose_sensor(sensors)
        notes = []
        if not path.is_dir() and (count := len([*path.absolute().parent.glob("*.tar")])) > 1:
            notes.append(
                f"is one of {count} tar files in its folder. Specify the folder to read all sweeps"
            )
        stated = {sample.compensated for sample in samples}
        info = ref.info(
            sensor=name,
            compensated=stated.pop() if len(stated) == 1 else None,
            notes=ref.prefix_notes(notes),
        )
        return _WebRecording(info, samples)


def _offsets(job: JobReader) -> Ints:
    """Return the offset table of a job's sweeps (see `WebDataset`)."""

    def read() -> Ints:
        name = f"offsets/{job.entry.name}.npz"
        with open_archive(job.storage.path(name), partial(job.storage.read, name)) as arrays:
            return arrays["at"]

    return job.get_or_compute("offsets", read)


def _shard(entry: Entry | None, start: int) -> str:
    """Return the name of the tar file that starts with the sweep `start`."""
    if entry is None:
        return f"shards/{start:06}.tar"
    return "/".join(filter(None, ("shards", entry.split, f"{entry.name}-{start:06}.tar")))


# -- reading ---------------------------------------------------------------------------------


class _Sample(NamedTuple):
    """Sample in a tar file."""

    path: Path
    members: dict[str, tuple[int, int]]  # {extension: (offset, size)}
    time_ns: int | None
    compensated: bool | None  # whether the points are motion-compensated

    def read(self) -> Sweep:
        arrays = {
            name.removesuffix(".npy"): read_npy(_slice(self.path, *span), name)
            for name, span in self.members.items()
            if name.endswith(".npy") and name != "boxes.npy"
        }
        pose = arrays.pop("pose", None)
        points = arrays.pop("points")
        return Sweep(points, arrays, pose=pose, time_ns=self.time_ns, compensated=self.compensated)


def _samples_of_sensors(files: list[Path]) -> dict[str, list[_Sample]]:
    """Return the samples in tar files, keyed by sensor.

    A sample consists of ``KEY.points.npy``, and optionally ``KEY.json`` and further arrays. Raises
    LidarError if no sample has points.
    """
    samples_of_sensor: dict[str, list[_Sample]] = {}
    for path in files:
        for members in _samples(path).values():
            if "points.npy" not in members:
                continue
            description = json.loads(_slice(path, *members["json"])) if "json" in members else {}
            compensated = states_compensation(str(description.get("frame")))
            stated_ns = description.get("time_ns")
            time_ns = None if stated_ns is None else round(stated_ns)
            sample = _Sample(path, members, time_ns, compensated)
            samples_of_sensor.setdefault(description.get("sensor", ""), []).append(sample)
    if not samples_of_sensor:
        raise LidarError(
            f"{files[0].name} contains no point samples. A WebDataset with sweeps must contain "
            "files named KEY.points.npy."
        )
    return samples_of_sensor


class _WebRecording(Recording):
    """Samples of one sensor."""

    def __init__(self, info: RecordingInfo, samples: list[_Sample]) -> None:
        super().__init__(info)
        self._samples = samples

    def __len__(self) -> int:
        return len(self._samples)

    def load(self, number: int) -> Sweep:
        return self._samples[number].read()

    def load_stamps(self) -> list[int] | None:
        times_ns = [sample.time_ns for sample in self._samples if sample.time_ns is not None]
        return times_ns if len(times_ns) == len(self) else None


def _samples(path: Path) -> dict[str, dict[str, tuple[int, int]]]:
    """Return the members of each sample in a tar file, as {key: {extension: (offset, size)}}."""
    input_size(path)
    samples: dict[str, dict[str, tuple[int, int]]] = {}
    with tarfile.open(path, "r:") as tar:
        for member in tar:
            folder, _, file = member.name.rpartition("/")
            key, _, ending = file.partition(".")
            samples.setdefault(f"{folder}/{key}", {})[ending] = (member.offset_data, member.size)
    return samples


def _slice(path: Path, offset: int, size: int) -> bytes:
    with path.open("rb") as file:
        file.seek(offset)
        return file.read(size)
