"""Open clouds and recordings in any supported format, and read them sweep by sweep."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from lidarsim.columns.cloud import Cloud
from lidarsim.columns.sweep import Sweep
from lidarsim.errors import LidarError, MissingFileError
from lidarsim.io.input_files import read_input
from lidarsim.scene.files.cloud_formats import SCAN_READERS
from lidarsim.schema.checks import check_choice
from lidarsim.schema.vocabulary import UNITS_M
from lidarsim.words import join_names

from ..clouds.format_table import format_of_path, formats_of_endings
from ..clouds.recording import PointCloud, Recording, RecordingInfo
from ..clouds.recording_ref import RecordingRef, SeveralSensorsError
from ..clouds.results import open_cloud
from ..datasets.dataset import INDEX_FILE
from ..datasets.loader import sweeps
from ..parts.parts import StoredCloud

KINDS = (
    "the folder of a result or data set, a .ply, .pcd, .las, .laz, .e57, .parquet, .xyz, .txt, "
    ".asc, .csv, .pts, .ptx, .npy, .bin (KITTI, nuScenes), .pcap, .pcapng (Velodyne, Ouster) or "
    ".osf file, a ROS 2 bag, or a folder in KITTI, nuScenes, WebDataset or range image format"
)
_CONVERSIONS = {  # {ending of an unsupported format: advice}
    ".bag": "It is a ROS 1 bag. Convert it with rosbags-convert --src IN.bag --dst OUT.",
    ".db3": "It is part of a ROS 2 bag. Specify the folder that contains it.",
    **dict.fromkeys(
        (".mcap.zstd", ".mcap.zst", ".db3.zstd", ".db3.zst"),
        "It is a compressed file of a ROS 2 bag. Specify the folder that contains it and the file "
        "metadata.yaml.",
    ),
    ".rrd": "It is a Rerun recording. Open it with the `rerun` command.",
    **dict.fromkeys(
        (".osi", ".osi.gz"), "It is an OSI trace. Use it as the traffic of a scenario."
    ),
    **dict.fromkeys(
        (".glb", ".gltf", ".obj", ".stl"),
        "It is a mesh. Run a survey of it first, "
        "or use `lidarpool compare CLOUD MESH --survey mesh` to compare a cloud with it.",
    ),
}
_MAX_OPENED = 4  # number of recordings that a process keeps open
# Extensions of files for which the user can set the unit.
_UNIT_SUFFIXES = (".las", ".laz", ".ply", *(ending for ending in SCAN_READERS if ending != ".bin"))


class UnknownFormatError(LidarError):
    """Raised when the format of a file or folder is not supported.

    `advice` contains sentences that suggest a remedy. It may be empty.
    """

    def __init__(self, name: str, advice: str) -> None:
        super().__init__(f"The format of {name} is not supported. {advice or f'Specify {KINDS}.'}")
        self.advice = advice


def open_sensors(
    source: str | Path, *, keep_noise: bool = False
) -> dict[str, Recording | PointCloud]:
    """Open the recordings of all sensors or topics as {name: recording}.

    The name is empty if a single sensor has no name. If the source contains several sequences,
    which have different world frames, only the first sequence is opened.

    Raises the same errors as `open_recording`.
    """
    opened = partial(open_recording, source, keep_noise=keep_noise)
    try:
        recording = opened()
        return {recording.info.sensor: recording}
    except SeveralSensorsError as error:
        recordings = {name: opened(sensor=name) for name in error.names}
    sequences = list(dict.fromkeys(opened.info.sequence for opened in recordings.values()))
    if len(sequences) == 1:
        return recordings
    note = f"Only {sequences[0]}, the first of {len(sequences):,} sequences, is shown."
    return {
        name: recording.with_info(notes=(*recording.info.notes, note))
        for name, recording in recordings.items()
        if recording.info.sequence == sequences[0]
    }


def open_recording(
    source: str | Path | Cloud | StoredCloud,
    sensor: str | None = None,
    intensity: str | None = None,
    *,
    name: str = "the cloud",
    unit: str | None = None,
    keep_noise: bool = False,
) -> Recording | PointCloud:
    """Open a recording or cloud in any format, and read it sweep by sweep.

    Parameters
    ----------
    source
        File or folder of a recording, a result or a data set, or a cloud in memory. A cloud in
        memory has sweeps only if it belongs to a result.
    sensor
        Name of the sensor, or topic in a bag. Required if there are several.
    intensity
        Column that contains the intensities. The default is ``intensity``.
    name
        Name used in messages if the source is a cloud in memory.
    unit
        Length unit of a .las, .laz, .ply, .pcd, .ptx, .pts, .npy or text file. Overrides the unit
        stated in the file. By default, files without a unit are read as meters.
    keep_noise
        Whether to include points that the file marks as withheld or classifies as noise.

    Returns
    -------
    Recording or PointCloud
        A sequence of `Sweep` objects, which are read when they are accessed. They are the sweeps
        of a recording, or the parts of a cloud without sweeps. If the source is a file or folder,
        it can be pickled, and each process that receives it opens the file.

    Raises
    ------
    LidarError
        If the source does not exist or is not supported, if it contains several sensors and none is
        selected, or if its coordinate system distorts lengths.
    """
    if unit is not None:
        check_choice("unit", unit, UNITS_M)
    if isinstance(source, Cloud | StoredCloud):
        if unit is not None:
            raise LidarError(f"{name} is always in meters. Remove the unit {unit!r}.")
        info = RecordingInfo(name, intensity_column=intensity)
        return open_cloud(info, source, source.sweeps, sensor)
    path = Path(source)
    return _open(RecordingRef(path, sensor, intensity, unit, keep_noise, name=str(source)))


def open_ref(ref: RecordingRef) -> Recording | PointCloud:
    """Open a file or folder, unless this process has opened it recently.

    A file is opened again if its size or its modification time has changed.

    Raises the same errors as `open_recording`.
    """
    # A forked process must not share open files with its parent.
    process = os.getpid()
    key = process, ref, _file_state(ref.located.path)
    opened = _opened.pop(key, None)
    if opened is None:
        opened = _open(ref)
    _opened[key] = opened
    own = [entry for entry in list(_opened) if entry[0] == process]
    for entry in own[:-_MAX_OPENED]:
        _opened.pop(entry, None)
    return opened


def close_recordings() -> None:
    """Close the recordings that `open_ref` keeps open in this process."""
    for entry in list(_opened):
        if entry[0] == os.getpid():
            _opened.pop(entry, None)


def sensor_refs(ref: RecordingRef) -> tuple[RecordingRef, ...]:
    """Return a reference for each sensor of a recording, or only for the chosen sensor.

    The sequences of a KITTI data set count as sensors.

    Raises
    ------
    LidarError
        If the recording cannot be read.
    """
    try:
        open_ref(ref)
    except SeveralSensorsError as error:
        return tuple(replace(ref, sensor=name) for name in error.names)
    return (ref,)


def as_recording(
    recording: str | Path | Cloud | StoredCloud | Recording | PointCloud,
    sensor: str | None = None,
    intensity: str | None = None,
) -> Recording | PointCloud:
    """Return a recording, or open a source like `open_recording`.

    Raises
    ------
    LidarError
        In the same cases as `open_recording`, or if the recording is open, so that its sensor and
        its intensity column can no longer be chosen.
    """
    if not isinstance(recording, Recording | PointCloud):
        return open_recording(recording, sensor, intensity, name="the recording")
    for name, value in (("sensor", sensor), ("intensity", intensity)):
        if value is not None:
            raise LidarError(
                f"{recording.info.name} is already open. Pass `{name}` to `open_recording` instead."
            )
    return recording


def with_sweeps(source: Recording | PointCloud) -> Recording:
    """Return a recording, or raise LidarError if it contains no sweeps."""
    if isinstance(source, PointCloud) or not len(source):
        raise LidarError(
            f"{source.info.name} contains no sweeps. Use a recording that consists of sweeps."
        )
    return source


_FileState = tuple[int, int] | None  # size and modification time in nanoseconds
_opened: dict[tuple[int, RecordingRef, _FileState], Recording | PointCloud] = {}


def _file_state(path: Path) -> _FileState:
    try:
        status = path.stat()
    except OSError:  # opening it raises the error
        return None
    return status.st_size, status.st_mtime_ns


def _open(ref: RecordingRef) -> Recording | PointCloud:
    located = ref.located
    path, name = located.path, located.name
    if ref.unit is not None and path.suffix.lower() not in _UNIT_SUFFIXES:
        raise LidarError(
            f"{name} is always in meters. Remove the unit {ref.unit!r}, which can only be set for "
            f"{join_names(_UNIT_SUFFIXES)} files."
        )
    opened = _open_path(located)
    if ref.sensor and opened.info.sensor != ref.sensor:
        raise LidarError(
            f"{name} does not name its sensor, so no sensor can be selected. Remove the sensor "
            f"{ref.sensor!r}."
        )
    changes: dict[str, Any] = {"noise_classes": None} if ref.keep_noise else {}
    opened = opened.with_info(world_origin=_world_origin(path), **changes)
    return opened.reopened_by(partial(open_ref, ref))


def _world_origin(path: Path) -> tuple[float, float, float] | None:
    """Return the origin that was added to the points of a result, or None if nothing was added."""
    folder = path if path.is_dir() else path.parent
    try:
        report = json.loads(read_input(folder / "report.json"))
        x, y, z = map(float, report["parameters"]["world_origin"])
    except (OSError, ValueError, TypeError, LookupError, LidarError):
        return None
    return (x, y, z) if any((x, y, z)) else None


def _open_path(ref: RecordingRef) -> Recording | PointCloud:
    path = ref.path
    if not path.exists():
        raise MissingFileError(f"{ref.name} does not exist. Specify {KINDS}.")
    if path.is_file() and not path.stat().st_size:
        raise LidarError(f"{ref.name} is empty (0 bytes). Specify {KINDS}.")
    if (path / INDEX_FILE).exists():
        return _DataSetRecording(ref)
    if (cloud_format := format_of_path(path, ref.name)) is not None:
        return cloud_format.open(ref)
    if path.is_dir() and any(_is_bag_file(file) for file in path.iterdir()):
        raise UnknownFormatError(
            ref.name,
            "It contains files of a ROS 2 bag, but not the file metadata.yaml. Create it with "
            "`ros2 bag reindex`, or specify one of the .mcap files.",
        )
    if path.is_dir() and (endings := sorted({file.suffix.lower() for file in _point_files(path)})):
        raise UnknownFormatError(
            ref.name,
            f"It contains {join_names(endings)} files, which are not read as the sweeps of a "
            "recording. Specify one of the files, or store the sweeps as .pcd files in a folder.",
        )
    file_name = path.name.lower()
    advice = (text for ending, text in _CONVERSIONS.items() if file_name.endswith(ending))
    raise UnknownFormatError(ref.name, next(advice, ""))


def _is_bag_file(file: Path) -> bool:
    return bool({".mcap", ".db3"} & {suffix.lower() for suffix in file.suffixes[-2:]})


def _point_files(folder: Path) -> list[Path]:
    """Return the files in a folder that can be opened one by one."""
    endings = {ending for ending in formats_of_endings() if ending}
    return [file for file in folder.iterdir() if file.suffix.lower() in endings and file.is_file()]


class _DataSetRecording(Recording):
    """The sweeps of a data set of lidarpool."""

    def __init__(self, ref: RecordingRef) -> None:
        self._saved = sweeps(ref.path, sensors=None if ref.sensor is None else [ref.sensor])
        super().__init__(
            ref.info(
                sensor=ref.sensor or "",
                compensated=self._saved.are_compensated(),
                has_firing_poses=self._saved.have_firing_poses(),
                noise_classes=None,
            )
        )

    def __len__(self) -> int:
        return len(self._saved)

    def load(self, number: int) -> Sweep:
        return self._saved[number]

    def load_fired(self, number: int) -> Sweep:
        return self._saved.fired(number)
